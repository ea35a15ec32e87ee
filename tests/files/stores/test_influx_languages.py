"""Flux and SQL of InfluxDB 2 and 3, by answers in the forms that they document: neither server is installable here."""

import json

import numpy as np
import pytest

import heliograph as hg
from tests.files.stores.answering import Answering

FLUX = (
    "#datatype,string,long,dateTime:RFC3339,dateTime:RFC3339,dateTime:RFC3339,double,string,string,string\r\n"
    ",result,table,_start,_stop,_time,_value,_field,_measurement,gate\r\n"
    ",,0,2026-11-29T00:00:00Z,2026-11-30T00:00:00Z,2026-11-29T10:00:00.000000001Z,1.5,level,tank,a\r\n"
    ",,0,2026-11-29T00:00:00Z,2026-11-30T00:00:00Z,2026-11-29T10:02:00Z,2.5,level,tank,a\r\n"
    "\r\n"
    "#datatype,string,long,dateTime:RFC3339,dateTime:RFC3339,dateTime:RFC3339,boolean,string,string,string\r\n"
    ",result,table,_start,_stop,_time,_value,_field,_measurement,gate\r\n"
    ",,1,2026-11-29T00:00:00Z,2026-11-30T00:00:00Z,2026-11-29T10:00:00.000000001Z,true,pump,tank,a\r\n"
    ",,1,2026-11-29T00:00:00Z,2026-11-30T00:00:00Z,2026-11-29T10:01:00Z,false,pump,tank,a\r\n"
)
UNTAGGED = FLUX.replace(",gate", "").replace(",a\r", "\r").replace(",string\r", "\r")
SQL = [
    {"time": "2026-11-29T10:00:00.000000001", "level": 1.5, "pump": True},
    {"time": "2026-11-29T10:01:00", "pump": False},
]
ASKED = 'from(bucket: "plant") |> range(start: -1d) |> filter(fn: (r) => r.gate == "a" & true)'


def test_values_of_flux_are_rows_by_time():
    with Answering(UNTAGGED.encode()) as server:
        columns = hg.files.read_store(f"{server.url}?org=my%20plant&flux={ASKED}")
    times = np.array(["2026-11-29T10:00:00.000000001", "2026-11-29T10:01", "2026-11-29T10:02"], "datetime64[ns]")
    np.testing.assert_array_equal(columns["time"], times)
    np.testing.assert_array_equal(columns["level"], [1.5, np.nan, 2.5])
    np.testing.assert_array_equal(columns["pump"], [1, 0, np.nan])
    ((path, asked, _, body),) = server.asked
    sent = json.loads(body)
    assert (path, asked, sent["type"], sent["query"]) == ("/api/v2/query", {"org": ["my plant"]}, "flux", ASKED)


def test_measurements_of_one_time_are_rows_of_their_own():
    """A field of one name in two measurements: neither value takes the place of the other."""
    both = UNTAGGED + UNTAGGED.replace(",tank", ",well").replace(",1.5,", ",7.5,")
    with Answering(both.encode()) as server:
        columns = hg.files.read_store(f"{server.url}?flux={ASKED}")
    assert sorted(columns["level"][columns["time"] == columns["time"].min()]) == [1.5, 7.5]


def test_two_values_of_a_field_at_one_time_are_refused():
    """A query that yields means and maxima under one name: the last took the place of the first."""
    mean, other = UNTAGGED.replace(",,", ",mean,", 1), UNTAGGED.replace(",1.5,", ",9.5,")
    with (
        Answering((mean + other).encode()) as server,
        pytest.raises(hg.InputError, match=r"one value of a field at a time .* got two of 'level' at 2026-11-29T10:00"),
    ):
        hg.files.read_store(f"{server.url}?flux={ASKED}")


def test_rows_that_a_query_has_pivoted_are_taken_as_they_are():
    pivoted = "#datatype,string,long,dateTime:RFC3339,double,long\n,result,table,_time,level,gate\n"
    with Answering(f"{pivoted},,0,2026-11-29T10:01:00Z,2,\n,,0,2026-11-29T10:00:00Z,1,7\n".encode()) as server:
        columns = hg.files.read_store(f"{server.url}?flux={ASKED}")
    np.testing.assert_array_equal(columns["level"], [1, 2])
    np.testing.assert_array_equal(columns["gate"], [7, np.nan])


def test_tags_of_flux_name_plants():
    """Each series has its tags; sources say which of them is the plant."""
    network = hg.Network(*_tank())
    sources = {"tank": hg.files.json_field("level", "tank", plant=hg.files.Field("gate"), time="time", step=1)}
    with Answering(FLUX.encode()) as server:
        events = hg.files.read_messages(f"{server.url}?flux={ASKED}", network, sources)
    assert list(events.plants) == ["a"]
    (rows, *_) = events.of("a").rows(100.0, 1.0)
    assert [float(v[0]) for v in rows.measurements["tank"] if v == v] == [1.5, 2.5]


def _tank():
    plant, sensor = hg.LinearPlant([[1.0]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
    return plant, {"tank": hg.Node(sensor, hg.perfect(), {"kalman": hg.kalman_filter(plant, sensor)})}


def test_rows_of_sql_are_columns():
    with Answering(json.dumps(SQL).encode()) as server:
        url = server.url.replace("//", "//:to%26ken@")
        columns = hg.files.read_store(f"{url}?sql=SELECT time, level, pump FROM tank WHERE level < 2 & TRUE")
    np.testing.assert_array_equal(
        columns["time"].astype(str), ["2026-11-29T10:00:00.000000001", "2026-11-29T10:01:00.000000000"]
    )
    np.testing.assert_array_equal(columns["level"], [1.5, np.nan])
    np.testing.assert_array_equal(columns["pump"], [1, 0])
    ((path, asked, user_and_password, _),) = server.asked
    statement = "SELECT time, level, pump FROM tank WHERE level < 2 & TRUE"
    assert (path, user_and_password) == ("/api/v3/query_sql", "Bearer to&ken")
    assert asked == {"db": ["plant"], "q": [statement], "format": ["json"]}


@pytest.mark.parametrize(
    ("user_and_password", "sent"), [("", None), (":to%26ken@", "Token to&ken"), ("me:secret@", "Token me:secret")]
)
def test_flux_is_asked_by_a_token(user_and_password, sent):
    with Answering(UNTAGGED.encode()) as server:
        hg.files.read_store(f"{server.url.replace('//', f'//{user_and_password}')}?flux={ASKED}")
    assert server.asked[0][2] == sent


@pytest.mark.parametrize(
    ("language", "answer", "said"),
    [
        ("flux", b"\r\n", "expected a query with rows, got none"),
        ("flux", b"<html>\n<p>\n", "expected a query that returns time, got the columns <html>"),
        ("flux", b"#datatype,string,string\n,error,reference\n,\"no column\nx\",897\n", "a query that it answers, got"),
        ("flux", b"#datatype,string,double\n,_time,level\n,2026-11-29T10:00:00Z,high\n", "in annotated CSV"),
        ("flux", b"#datatype,string,double\n,_time,level\n,2026-11-29T10:00:00Z\n", "in annotated CSV"),
        ("flux", b"\xff\xfe", "in annotated CSV"),
        ("flux", b",_time,level\n,morning,1\n", "expected a time in each row, got one that is none"),
        ("flux", (404, b'{"code":"not found","message":"organization name \"x\" not found"}'), 'organization name "x"'),
        ("flux", FLUX.encode(), "column 'gate': expected numbers or dates, got 'a'"),
        ("sql", b"[]", "expected a query with rows, got none"),
        ("sql", b'{"results": 1}', "expected rows of InfluxDB 3 in JSON"),
        ("sql", b'[{"level": 1}]', "expected a query that returns time, got the columns level"),
        ("sql", b'[{"time": "2026-11-29T10:00:00"}, {"level": 1}]', "expected a time in each row"),
        ("sql", (400, b'{"error":"table tank not found"}'), "got 400 table tank not found"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_one_line_without_the_password(language, answer, said):
    with Answering(answer) as server, pytest.raises(ValueError, match=r"influx://127\.0\.0\.1") as error:
        hg.files.read_store(server.url.replace("//", "//me:secret@") + f"?{language}=SELECT level FROM tank")
    assert said in str(error.value) and "secret" not in str(error.value) and "\n" not in str(error.value)
