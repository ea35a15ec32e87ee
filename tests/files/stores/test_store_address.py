"""URLs of stores: what they ask for, and what is never printed."""

import pytest

from heliograph import files


def test_secrets_are_not_printed():
    for url in (
        "influx://me:se%26cret@127.0.0.1:1/db?query=SELECT a",
        "postgresql://me:se%26cret@127.0.0.1:1/db?table=a",
    ):
        with pytest.raises(ValueError, match=rf"^{url.split(':')[0]}://127\.0\.0\.1:1/db") as error:
            files.read_store(url)
        assert "cret" not in str(error.value) and "SELECT" not in str(error.value)


@pytest.mark.parametrize(
    "url",
    [
        "mysql://host/db?table=t", "influx:///db", "influx://host", "postgresql://host", "influx://host/db?orga=me",
        "influx://host/db?table=t&query=SELECT", "influx://host/db?table=t&flux=from()", "influx://host/db?sql=",
        "postgresql://host/db?flux=from()", "postgresql://host/db?sql=SELECT 1",
        "influx://host/db?query=", "influx://host:port/db", "tank",
        "postgresql://host/db?table=a&table=b",
    ],
)  # fmt: skip
def test_what_is_no_address_is_one_line(url):
    with pytest.raises(ValueError, match=r"^store") as error:
        files.read_store(url)
    assert "\n" not in str(error.value)


def test_what_is_asked_must_be_said():
    with pytest.raises(ValueError, match=r"expected \?query=SELECT\.\.\. or \?table=NAME behind it, got neither"):
        files.read_store("influx://host/db")


@pytest.mark.parametrize("password", ["se/cret", "12/cret", "12#cret", "12?cret"])
def test_a_slash_in_a_password_does_not_end_the_host(password):
    """The user would be taken for the host, the password's beginning for a port, and its end for the database."""
    for kind in ("influx", "postgresql"):
        with pytest.raises(ValueError, match=r"^store") as error:
            files.read_store(f"{kind}://me:{password}@127.0.0.1:1/db?table=t")
        assert "cret" not in str(error.value) and ("%2F" in str(error.value) or password[2] in "#?")
