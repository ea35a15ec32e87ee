"""PostgreSQL, by a real server: rows of a query in, estimates out, all or nothing."""

from decimal import Decimal

import numpy as np
import psycopg
import pytest

import heliograph as hg
from tests.files.stores.test_influx import TIMES, record
from tests.junk import SCALAR
from tests.postgres import Postgres

AWAY = "postgresql://me@127.0.0.1:1/db"


@pytest.fixture(scope="module")
def server():
    """One for these tests: it takes a second to make."""
    with Postgres() as server:
        yield server


@pytest.fixture
def url(server):
    """The URL of an empty database, to which `&table=` or `&query=` is appended."""
    return server.database()


def run(url, *statements):
    with psycopg.connect(url) as connection:
        cursors = [connection.execute(statement) for statement in statements]
        return [cursor.fetchall() if cursor.description else None for cursor in cursors][-1]


def test_a_server_that_is_away_is_one_line():
    for call in (lambda: hg.files.read_store(f"{AWAY}?table=t"), lambda: hg.files.store_estimates(record(), AWAY)):
        with pytest.raises(
            ValueError, match=r"^postgresql://127\.0\.0\.1:1/db.*expected a server that answers"
        ) as error:
            call()
        assert "\n" not in str(error.value)


def test_decimals_keep_the_digits_that_doubles_do_not_have(monkeypatch):
    """Of a column numeric: seconds since 1970 with nanoseconds lost theirs, and two messages had one time."""
    seconds = [Decimal("1700000000.000000001"), Decimal("1700000000.000000101")]
    columns = {"at": seconds, "level": [Decimal("1.5"), Decimal(2)]}
    monkeypatch.setattr("heliograph.files.stores.postgres.query_postgres", lambda address: ("db", columns))
    plant = hg.LinearPlant([[1.0]], 0.1, [0.0], 1.0, [[0.0]], inputs=["dt"])
    network = hg.Network(plant, {"tank": hg.Node(hg.LinearSensor([[1.0]], 0.1), hg.perfect(), {})})
    field = hg.files.json_field("level", node="tank", time="at")
    events = hg.files.read_messages(f"{AWAY}?table=t", network, {"db": field})
    assert events.lateness()["tank"].tolist() == [0, 0] and events.date == np.datetime64(
        1_700_000_000_000_000_001, "ns"
    )
    recording = events.recording()
    assert recording.time.tolist() == [0.0, 1e-7] and recording.measurements["tank"].ravel().tolist() == [1.5, 2.0]


@pytest.mark.real("PostgreSQL")
def test_whole_numbers_of_times_keep_their_digits(url):
    """Nanoseconds went into a column of doubles, where they are multiples of 256."""
    times = 1_700_000_000_000_000_000 + np.array([1, 2, 3])
    hg.files.store_estimates(record(times), f"{url}&table=whole")
    assert run(url, "SELECT time FROM whole ORDER BY time") == [(time,) for time in times.tolist()]


@pytest.mark.real("PostgreSQL")
def test_rows_of_a_query_are_columns(url):
    run(
        url,
        "CREATE TABLE tank (time timestamptz, level numeric, pump boolean, word text)",
        "INSERT INTO tank VALUES ('2026-11-29T11:00:00.000001+01', 1.25, true, 'x')",
        "INSERT INTO tank VALUES ('2026-11-29T10:01Z', NULL, false, '')",
    )
    columns = hg.files.read_store(f"{url}&query=SELECT time, level, pump FROM tank WHERE word LIKE '%25' ORDER BY time")
    moments = ["2026-11-29T10:00:00.000001", "2026-11-29T10:01"]
    np.testing.assert_array_equal(columns["time"], np.array(moments, dtype="datetime64[ns]"))
    np.testing.assert_array_equal(columns["level"], [1.25, np.nan])
    np.testing.assert_array_equal(columns["pump"], [1, 0])
    for query, said in {
        "table=tank": "column 'word': expected numbers or dates, got 'x'",
        "table=nowhere": 'got relation "nowhere" does not exist',
        "query=SELECT 1 AS a, 2 AS a": "expected columns of different names, got 'a' more than once",
        "query=SELECT time FROM tank WHERE false": "expected a query with rows, got none",
        "query=DELETE FROM tank": "got cannot execute DELETE in a read-only transaction",
    }.items():
        with pytest.raises(ValueError, match=r"^postgresql:///") as error:
            hg.files.read_store(f"{url}&{query}")
        assert said in str(error.value) and "\n" not in str(error.value)
    assert run(url, "SELECT count(*) FROM tank") == [(2,)]


@pytest.mark.real("PostgreSQL")
def test_a_query_without_a_time_is_one_line(url):
    network = hg.Network(SCALAR[0], {"tank": hg.Node(SCALAR[1], hg.perfect(), {})})
    columns = hg.files.read_store(f"{url}&query=SELECT 1.0 AS z0")
    with pytest.raises(ValueError, match="expected one column 'time', got only"):
        hg.files.read_recording(columns, network, "tank", ignore_unknown=True)


@pytest.mark.real("PostgreSQL")
def test_estimates_are_written_whole_and_again(url):
    for plant in ("a", "b", "b"):
        hg.files.store_estimates(record(), f"{url}&table=tank", plant=plant)
    (state,) = record().states
    found = hg.files.read_store(
        f'{url}&query=SELECT time, "{state}", "{state}.sd", valid FROM tank WHERE plant = \'b\''
    )
    expected = record().estimates["tank"]["kalman"]
    np.testing.assert_array_equal(found["time"], TIMES)
    np.testing.assert_array_equal(found[state], expected.mean[:, 0])  # seventeen digits there and back
    np.testing.assert_array_equal(found[f"{state}.sd"], np.sqrt(expected.covariance[:, 0, 0]))
    assert run(url, "SELECT count(*) FROM tank") == [(6,)]
    # A table of other columns stays as it is.
    run(url, "CREATE TABLE other (plant text, time timestamptz, a text)", "INSERT INTO other VALUES ('', now(), 'x')")
    with pytest.raises(ValueError, match=r"expected what the server accepts, got column .* does not exist"):
        hg.files.store_estimates(record(), f"{url}&table=other")
    assert run(url, "SELECT count(*) FROM other") == [(1,)]


@pytest.mark.real("PostgreSQL")
def test_times_may_be_numbers(url):
    hg.files.store_estimates(record(np.arange(3.0)), url)
    assert run(url, "SELECT time FROM estimates ORDER BY time") == [(0.0,), (1.0,), (2.0,)]
    with pytest.raises(ValueError, match="expected what the server accepts"):
        hg.files.store_estimates(record(), url)
