"""InfluxDB: by a server of the tests' own that answers as it does, and by a real one where there is one."""

import numpy as np
import pytest

import heliograph as hg
from tests.files.stores.answering import Answering
from tests.influx import Influx
from tests.junk import SCALAR

ROWS = {
    "name": "tank",
    "columns": ["time", "level", "pump"],
    "values": [[1700000000000000001, 1.5, True], [1700000001000000000, None, False]],
}
TIMES = np.array(["2026-11-29T10:00", "2026-11-29T10:01", "2026-11-29T10:02"], dtype="datetime64[ns]")


def record(times=TIMES):
    """Estimates of three rows, of which the second is no number."""
    plant, sensor = SCALAR
    network = hg.Network(plant, {"tank": hg.Node(sensor, hg.perfect(), {"kalman": hg.kalman_filter(plant, sensor)})})
    z = np.array([[1.0], [np.nan], [2.0]])
    return hg.run(network, {"tank": z}, np.zeros((3, len(plant.inputs))), times)


def test_a_query_gives_columns_with_every_digit_of_time():
    with Answering([ROWS]) as server:
        columns = hg.files.read_store(f"{server.url}?query=SELECT level, pump FROM tank WHERE level > 1 & level < 2")
    np.testing.assert_array_equal(columns["time"].astype(int), [1700000000000000001, 1700000001000000000])
    np.testing.assert_array_equal(columns["level"], [1.5, np.nan])
    np.testing.assert_array_equal(columns["pump"], [1, 0])
    ((path, asked, user_and_password, _),) = server.asked
    assert (path, user_and_password) == ("/query", None)
    assert asked == {
        "db": ["plant"],
        "q": ["SELECT level, pump FROM tank WHERE level > 1 & level < 2"],
        "epoch": ["ns"],
    }


def test_series_are_one_table_in_the_order_of_time():
    """As GROUP BY answers: tags beside each series; they name plants here, which sources say."""
    parts = [
        {
            "name": "tank",
            "tags": {"gate": gate},
            "columns": ["time", "level"],
            "values": [[10**9 * t, t / 2] for t in of],
        }
        for gate, of in {"a": (1, 5), "b": (2, 4)}.items()
    ]
    network = hg.Network(SCALAR[0], {"tank": hg.Node(SCALAR[1], hg.perfect(), {})})
    plant = hg.files.Field("gate")
    sources = {"tank": hg.files.json_field("level", node="tank", plant=plant, time="time", step=1)}
    with Answering(parts) as server:
        events = hg.files.read_messages(f"{server.url}?table=tank", network, sources)
    assert server.asked[0][1]["q"] == ['SELECT * FROM "tank"']
    assert [
        (plant, [float(v[0]) for v in events.of(plant).rows(100.0, 1.0)[0].measurements["tank"] if v == v])
        for plant in events.plants
    ] == [
        ("a", [0.5, 2.5]),
        ("b", [1.0, 2.0]),
    ]


def test_who_asks_is_named_as_each_version_wants(monkeypatch):
    with Answering([ROWS]) as server:
        at = server.url.removeprefix("influx://")
        hg.files.read_store(f"influx://:to%40ken@{at}?table=tank")
        hg.files.read_store(f"influx://me:secret@{at}?table=tank")
        monkeypatch.setenv("HELIOGRAPH_STORE_PASSWORD", "hidden")
        hg.files.read_store(f"influx://{at}?table=tank")
    assert [asked[2] for asked in server.asked] == ["Token to@ken", "Basic bWU6c2VjcmV0", "Token hidden"]


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ([{"name": "t", "columns": ["level"], "values": [[1.0]]}], "returns time, got the columns level"),
        ([{"name": "t", "columns": ["time", "a"], "values": [[1, "x"]]}], "'a': expected numbers or dates, got 'x'"),
        ([], "expected a query with rows, got none"),
        ([ROWS | {"partial": True}], "expected all rows of the query, got a part of them"),
        ((401, b'{"code":"unauthorized","message":"unauthorized\\naccess"}'), "got 401 unauthorized access"),
        ((400, b'{"error":"error parsing query: found FORM"}'), "got 400 error parsing query: found FORM"),
        ((200, b'{"results":[{"statement_id":0,"error":"database not found: plant"}]}'), "database not found: plant"),
        ((200, b"<html>"), "expected an answer of InfluxDB in JSON"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_one_line_without_the_password(answer, said):
    with Answering(answer) as server, pytest.raises(ValueError, match=r"influx://127\.0\.0\.1") as error:
        hg.files.read_store(server.url.replace("//", "//me:secret@") + "?query=SELECT level FROM tank")
    assert said in str(error.value) and "secret" not in str(error.value) and "\n" not in str(error.value)


def test_a_store_that_is_away_is_one_line():
    with Answering() as server:
        url = server.url
    with pytest.raises(ValueError, match="expected a server that answers, got Connection refused"):
        hg.files.read_store(f"{url}?table=tank")
    with pytest.raises(ValueError, match="expected a server that answers, got Connection refused"):
        hg.files.store_estimates(record(), url)


def test_estimates_are_points_of_the_line_protocol():
    with Answering() as server:
        hg.files.store_estimates(record(), f"{server.url}?table=my tank", plant="a,b")
    (_, ping), (path, asked, _, body) = server.asked[0][:2], server.asked[-1]
    assert not ping and (path, asked) == ("/write", {"db": ["plant"], "precision": ["ns"]})
    estimate = record().estimates["tank"]["kalman"]
    lines = body.decode().splitlines()
    assert len(lines) == 3
    head, fields, time = lines[0].replace("\\ ", "_").split(" ")
    assert (head, int(time)) == (r"my_tank,plant=a\,b", TIMES.astype(int)[0])
    values = dict(field.split("=") for field in fields.split(","))
    assert values.pop("valid") == "true"
    state, deviation = (float(value) for value in values.values())
    assert state == estimate.mean[0, 0] and deviation == np.sqrt(estimate.covariance[0, 0, 0])


def test_rows_of_one_time_that_would_replace_each_other_are_said():
    """InfluxDB keeps one point of a moment: of two rows of one time the first was gone, and "3 rows" were written."""
    times = TIMES[[0, 1, 1]]
    with (
        Answering() as server,
        pytest.warns(UserWarning, match="1 of 3 rows are replaced by a later row of the same time"),
    ):
        hg.files.store_estimates(record(times), server.url)


def test_what_is_refused_half_way_says_how_much_is_there(monkeypatch):
    monkeypatch.setattr("heliograph.files.stores.influx.BATCH", 1)
    writes = [(204, b""), (400, b'{"error":"partial write: field type conflict"}')]
    with Answering(writes=writes) as server, pytest.raises(ValueError, match="field type conflict") as error:
        hg.files.store_estimates(record(), server.url)
    assert str(error.value).endswith("; 1 rows of 3 are written: the same again replaces them")


def test_times_without_dates_are_refused_before_anything_is_written():
    with Answering() as server, pytest.raises(ValueError, match="expected times that are dates, got the number 0"):
        hg.files.store_estimates(record(np.arange(3.0)), server.url)
    assert [asked[0] for asked in server.asked] == ["/ping"]
    with Answering() as server:
        hg.files.store_estimates(record(np.arange(3.0)), server.url, origin=TIMES[0])
    last = server.asked[-1][3].decode().splitlines()[-1]
    assert int(last.split(" ")[-1]) == TIMES.astype(int)[0] + 2 * 10**9


@pytest.mark.real("InfluxDB")
def test_a_real_server_gives_back_what_it_was_given():
    """Version 1.6 of Debian; its /query and /write are those that versions 2 and 3 document."""
    with Influx() as server:
        server.write('tank,gate=a level=1.5 1700000000000000001\ntank,gate=b level=2.5,word="x" 1700000001000000000\n')
        columns = hg.files.read_store(f"{server.url}?query=SELECT level FROM tank")
        np.testing.assert_array_equal(columns["time"].astype(int), [1700000000000000001, 1700000001000000000])
        np.testing.assert_array_equal(columns["level"], [1.5, 2.5])
        with pytest.raises(ValueError, match="column 'gate': expected numbers or dates, got 'a'"):
            hg.files.read_store(f"{server.url}?table=tank")
        with pytest.raises(ValueError, match="got database not found: other"):
            hg.files.read_store(f"{server.url.replace('/plant', '/other')}?table=tank")
        # Estimates, twice: points of the same moments are replaced, and numbers keep every digit.
        for _ in range(2):
            hg.files.store_estimates(record(), f"{server.url}?table=of tank")
        written = hg.files.read_store(f"{server.url}?table=of tank")
        expected = record().estimates["tank"]["kalman"]
        np.testing.assert_array_equal(written["time"], TIMES)
        (state,) = record().states
        np.testing.assert_array_equal(written[state], expected.mean[:, 0])
        np.testing.assert_array_equal(written[f"{state}.sd"], np.sqrt(expected.covariance[:, 0, 0]))
        np.testing.assert_array_equal(written["valid"], [1, 1, 1])


@pytest.mark.parametrize(("value", "refused"), [("a", False), ("b", True)])
def test_a_tag_of_a_columns_name_is_no_column(value, refused):
    """One of the two would be lost; where both say the same nothing is."""
    parts = [
        {"name": "t", "tags": {"gate": "a"}, "columns": ["time", "gate", "level"], "values": [[10**9, value, 1.0]]}
    ]
    network = hg.Network(SCALAR[0], {"tank": hg.Node(SCALAR[1], hg.perfect(), {})})
    sources = {"t": hg.files.json_field("level", node="tank", time="time", step=1)}
    with Answering(parts) as server:
        address = f"{server.url}?table=t"
        if refused:
            with pytest.raises(ValueError, match=r"tags and columns of different names .*, got 'gate' for both"):
                hg.files.read_messages(address, network, sources)
        else:
            assert len(hg.files.read_messages(address, network, sources)) == 1
