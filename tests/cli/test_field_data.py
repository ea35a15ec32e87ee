"""What arrives in the field: `run`, `replay` and `serve` read the same rows of it, and say what they leave out."""

import json

import numpy as np
import pytest

import heliograph as hg
from heliograph import cli
from heliograph.live.fleet import Fleet
from heliograph.live.fleet_options import Options
from heliograph.live.network_step_program import NetworkProgram
from heliograph.serving import LineReader
from heliograph.serving.brokers.source_translator import Translator
from heliograph.serving.service import Service
from heliograph.serving.storage import InMemoryStore
from tests.cli.walk import WALK, agrees, kalman, run
from tests.files.module import load_module


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def served(folder, lines):
    """Kinds, times and estimates that a service publishes for lines of a pipe."""
    network, module = load_module(str(folder / "net.py"))
    reads = Translator(module["sources"], network)
    service = Service(Fleet(NetworkProgram(network), Options(window=60.0, ahead=0.1)), InMemoryStore())
    payloads = LineReader(network, reads).read([line.encode() for line in lines])
    return [json.loads(output.body) for output in [*service.take(payloads), *service.finish(True)]]


HISTORY = """entity_id,state,last_changed
sensor.attic,20.1,2026-09-27T10:00:00.000Z
sensor.attic,20.2,2026-09-27T10:01:00.000Z
sensor.attic,unavailable,2026-09-27T10:02:00.000Z
sensor.attic,20.4,2026-09-27T10:03:00.000Z
sensor.attic,unknown,2026-09-27T10:04:00.000Z
sensor.attic,20.6,2026-09-27T10:05:00.000Z
"""
OF_HISTORY = '{"history.csv": field("state", node="a", time="last_changed")}'


def test_a_message_that_cannot_be_read_is_refused_alone(folder, capsys):
    out, err, table = run(folder, capsys, "history.csv", HISTORY, OF_HISTORY)
    agrees(table, [0, 60, 180, 300], [20.1, 20.2, 20.4, 20.6])
    assert "could not be read: 2; history.csv, row 3, field 'state': expected a number" in err and "4 used" in out
    _, err, table = run(folder, capsys, "history.csv", HISTORY, OF_HISTORY, "--strict")
    assert table is None and "row 3" in err


def test_a_row_with_too_few_cells_and_a_time_that_is_none_are_refused_alone(folder, capsys):
    text = HISTORY.replace("unavailable,", "").replace("2026-09-27T10:04:00.000Z", "soon").replace("unknown", "20.5")
    _, err, table = run(folder, capsys, "history.csv", text, OF_HISTORY)
    agrees(table, [0, 60, 180, 300], [20.1, 20.2, 20.4, 20.6])
    assert "expected 3 cells" in err and "expected a date of ISO 8601" in err


EQUAL = """time,value
2026-08-09T11:36:28Z,20.10
2026-08-09T11:36:28Z,20.10
2026-08-09T11:36:29Z,20.14
2026-08-09T11:36:29Z,20.11
2026-08-09T11:36:29Z,20.09
2026-08-09T11:36:30Z,20.13
"""
OF_EQUAL = '{"log.csv": field("value", node="a", time="time")}'


@pytest.mark.slow
def test_equal_stamps_are_several_measurements_whatever_is_done_with_them(folder, capsys):
    times, values = [0, 0, 1, 1, 1, 2], [20.10, 20.10, 20.14, 20.11, 20.09, 20.13]
    out, _, plain = run(folder, capsys, "log.csv", EQUAL, OF_EQUAL)
    agrees(plain, times, values)
    assert "6 events have 3 stamps" in out
    for options in (["--smooth", "all"], ["--report", "page"], ["--smooth", "1", "--lag", "1"]):
        agrees(run(folder, capsys, "log.csv", EQUAL, OF_EQUAL, *options)[2], times, values)
    # As messages of a replay, of a file of these, and of a service.
    assert cli.main(["replay", "log.csv", "--network", "net.py"]) == 0
    lines = capsys.readouterr().out
    agrees(run(folder, capsys, "replayed.jsonl", lines, OF_EQUAL)[2], times, values)
    finals = [part for part in served(folder, lines.splitlines()) if part["kind"] == "final"]
    assert len(finals) == 6
    np.testing.assert_allclose(finals[-1]["estimates"]["a"]["k"]["mean"], kalman(times, values)[0], rtol=1e-12)


def log(stamps, arrivals, values):
    """Lines as `mosquitto_sub -F %j` prints them."""
    return "".join(
        json.dumps(
            {"tst": f"{came}+0000", "topic": "t", "qos": 0, "retain": 0, "payload": json.dumps(dict(v=v, at=at))}
        )
        + "\n"
        for at, came, v in zip(stamps, arrivals, values, strict=True)
    )


NIGHT = [f"2026-09-27T10:{m}0:00.000000Z" for m in range(4)]
WARM = [20.0, 20.5, 21.0, 21.5]


def test_what_a_line_says_of_its_arrival_is_used(folder, capsys):
    """A night's log of messages without a time: of the moments when they arrived, in a file and in a service."""
    text, source = log(NIGHT, NIGHT, WARM), '{"t": field("v", node="a")}'
    agrees(run(folder, capsys, "log.jsonl", text, source)[2], [0, 600, 1200, 1800], WARM)
    finals = [part for part in served(folder, text.splitlines()) if part["kind"] == "final"]
    assert [part["time"] for part in finals] == [f"2026-09-27T10:{m}0:00+00:00" for m in range(4)]
    m, sd = kalman([0, 600, 1200, 1800], WARM)
    last = finals[-1]["estimates"]["a"]["k"]
    np.testing.assert_allclose([last["mean"][0], last["covariance"][0][0]], [m, sd**2], rtol=1e-12)
    # As plain text, which other options of the same client print.
    plain = "".join(f"{came} t {json.dumps({'v': v})}\n" for came, v in zip(NIGHT, WARM, strict=True))
    agrees(run(folder, capsys, "log.txt", plain, source)[2], [0, 600, 1200, 1800], WARM)


def test_a_stamp_some_milliseconds_ahead_is_used_and_one_of_years_is_not(folder, capsys):
    stamps = ["2026-09-27T10:00:00.05Z", "2033-01-01T00:00:00Z", "1999-01-01T00:00:00Z", "2026-09-27T10:30:00Z"]
    text, source = log(stamps, NIGHT, WARM), '{"t": field("v", node="a", time="at")}'
    out, err, table = run(folder, capsys, "log.jsonl", text, source)
    agrees(table, [0, 1799.95], [20.0, 21.5])
    assert "a: 2 used, 1 future" in out and "a time that was set, near that of arrival" in err
    out, *_ = run(folder, capsys, "log.jsonl", text, source, "--ahead", "0")
    assert "a: 1 used, 2 future" in out
    kinds = [(p["kind"], p.get("reason")) for p in served(folder, text.splitlines()) if p["kind"] != "provisional"]
    assert sorted(kinds, key=str) == [("final", None)] * 2 + [("refused", "future"), ("refused", "malformed")]


def uplink(device, at, count, payload):
    frame = {"f_port": 1, "decoded_payload": payload} | ({} if count is None else {"f_cnt": count})
    body = {"end_device_ids": {"device_id": device}, "received_at": f"2026-09-01T{at}Z", "uplink_message": frame}
    return json.dumps({"topic": f"v3/farm@ttn/devices/{device}/up", "payload": json.dumps(body)})


UPLINKS = [
    uplink("a", "10:00:00", None, {"t": 20.0}),  # protobuf leaves out a count of 0
    uplink("a", "10:01:00", 1, {"t": 20.1}),
    uplink("a", "10:01:00.08", 1, {"t": 20.1}),  # by a second gateway
    uplink("a", "10:02:00", 5, {"t": 20.2}),
    uplink("a", "10:03:00", None, {"t": 20.3}),  # joined again
    uplink("b", "10:00:00", 65534, {"t": 20.0}),
    uplink("b", "10:01:00", 65535, {}),
    uplink("b", "10:02:00", 1, {"t": 20.2}),  # 0 was lost
    uplink("b", "10:03:00", 2, {"t": "21.5"}),
]


@pytest.mark.parametrize(
    "source",
    [
        'hg.files.the_things_stack("t", node="a")',
        '{"v3/+/devices/+/up": field("uplink_message.decoded_payload.t", node="a", time="received_at", '
        'sequence=hg.files.Count("uplink_message.f_cnt", bits=16), plant=hg.files.Level(3))}',
    ],
)
def test_counts_of_devices_are_absent_at_0_wrap_and_begin_again(folder, capsys, source):
    out, err, table = run(folder, capsys, "up.jsonl", "\n".join(UPLINKS), source, "--plant", "a")
    agrees(table, [0, 60, 120, 180], [20.0, 20.1, 20.2, 20.3])
    assert "a, a: 4 used, 1 duplicate, 3 lost" in out and "expected a number" in err
    out, _, table = run(folder, capsys, "up.jsonl", "\n".join(UPLINKS), source, "--plant", "b")
    assert "b, a: 2 used, 1 without a value, 1 lost" in out and len(table["x"]) == 3
    finals = [p for p in served(folder, UPLINKS) if p["kind"] == "final"]
    assert [p["plant"] for p in finals].count("a") == 4 and [p["plant"] for p in finals].count("b") == 3


def chirpstack_uplink(device, at, count, measured):
    body = {"time": f"2026-09-01T{at}.000+00:00", "deviceInfo": {"devEui": device}, "fPort": 2, "object": measured}
    body |= {} if count is None else {"fCnt": count}
    return json.dumps({"topic": f"application/7/device/{device}/event/up", "payload": json.dumps(body)})


def test_uplinks_of_chirpstack(folder, capsys):
    """A count that is absent at 0 and wraps; a device that joined again, and a frame of it without a value."""
    counts = {"70b3": [65535, None, 1], "a840": [700, None, 1]}
    lines = [
        chirpstack_uplink(device, f"10:0{k}:00", count, {"t": start + k / 10})
        for start, device in enumerate(counts, 20)
        for k, count in enumerate(counts[device])
    ]
    lines.append(chirpstack_uplink("a840", "10:04:00", 2, {"battery": 3.1}))
    source = 'hg.files.chirpstack("t", node="a")'
    out, _, table = run(folder, capsys, "up.jsonl", "\n".join(lines), source, "--plant", "70b3")
    agrees(table, [0, 60, 120], [20.0, 20.1, 20.2])
    assert "70b3, a: 3 used\n" in out
    out, _, table = run(folder, capsys, "up.jsonl", "\n".join(lines), source, "--plant", "a840")
    agrees(table, [0, 60, 120, 240], [21.0, 21.1, 21.2, np.nan])
    assert "a840, a: 3 used, 1 without a value\n" in out


@pytest.mark.slow
def test_each_plant_has_estimates_of_its_own(folder, capsys):
    (folder / "net.py").write_text(f"{WALK}\nsources = hg.files.the_things_stack('t', node='a')\n")
    (folder / "up.jsonl").write_text("\n".join(UPLINKS))
    command = ["run", "net.py", "--measurements", "up.jsonl"]
    assert cli.main([*command, "--out", "out.csv"]) == 0
    agrees(hg.files.read_table("out.a.csv"), [0, 60, 120, 180], [20.0, 20.1, 20.2, 20.3])
    assert len(hg.files.read_table("out.b.csv")["x"]) == 3 and not (folder / "out.csv").exists()
    capsys.readouterr()
    # The report is an overview of all plants, which leads to a page of each; of one that is named it is its page.
    assert cli.main([*command, "--report", "page"]) == 0
    overview = (folder / "page" / "report.html").read_text()
    for plant, rows in (("a", 4), ("b", 3)):
        assert f'<a href="plant.{plant}/report.html">{plant}</a>' in overview and f"<td>{rows}</td>" in overview
        assert f"{plant}" in (folder / "page" / f"plant.{plant}" / "report.html").read_text()
    assert json.loads((folder / "page" / "summary.json").read_text()).keys() == {"a", "b"}
    assert cli.main([*command, "--report", "page", "--plant", "a"]) == 0
    assert not (folder / "page" / "plant.a").exists()
    capsys.readouterr()
    assert cli.main(["fit", *command[1:], "--out", "fit"]) == 2
    said = capsys.readouterr().err
    assert "expected one plant here, which --plant names (--plant a), got 'a', 'b'" in said
    assert cli.main([*command, "--out", "one.csv", "--plant", "c"]) == 2
    assert "plant: expected one of 'a', 'b', got 'c'" in capsys.readouterr().err


TEXTS = {
    "a condition": (
        "log.csv",
        "time,v,status\n2026-09-27T10:00:00Z,20.1,Good\n2026-09-27T10:01:00Z,99,Bad\n2026-09-27T10:04:00Z,20.5,Uncertain\n",
        'field("v", node="a", time="time", where={"status": ["Good", "Uncertain"]})',
        ([0, 240], [20.1, 20.5]),
    ),
    "numbers in quotes": (
        "log.jsonl",
        '{"at": "1790503200", "v": "20.1"}\n{"at": "1790503260", "v": "20.2"}\n',
        'field("v", node="a", time="at", quoted=True)',
        ([0, 60], [20.1, 20.2]),
    ),
    "annotated CSV of Influx": (
        "log.csv",
        "#group,false,false,true\n#datatype,string,long,dateTime:RFC3339,double\n#default,mean,,,\n"
        ",result,table,_time,_value\n,,0,2026-09-27T10:00:00Z,20.1\n,,0,2026-09-27T10:01:00Z,20.2\n\n"
        "#group,false,false,true\n#datatype,string,long,dateTime:RFC3339,double\n#default,mean,,,\n"
        ",result,table,_time,_value\n,,1,2026-09-27T10:02:00Z,20.3\n",
        'field("_value", node="a", time="_time")',
        ([0, 60, 120], [20.1, 20.2, 20.3]),
    ),
    "a bare nan beside it": (
        "log.jsonl",
        '{"at": 0.0, "v": 20.5, "h": nan}\n{"at": 60, "v": 20.6, "h": -nan(ind), "note": "a nan"}\n',
        'field("v", node="a", time="at")',
        ([0, 60], [20.5, 20.6]),
    ),
    "seconds from 0, and a delay": (
        "log.csv",
        "t,v\n0.0,20.1\n0.5,20.2\n1.0,20.3\n",
        'field("v", node="a", time=hg.files.Stamp("t", offset=-0.25))',
        ([0, 0.5, 1.0], [20.1, 20.2, 20.3]),
    ),
    "a heading of a quaternion": (
        "log.jsonl",
        '{"t": 0, "q": {"x": 0, "y": 0, "z": 0.479425538604203, "w": 0.8775825618903728}}\n',
        'field(hg.files.Yaw("q"), node="a", time="t", scale=20.0)',
        ([0], [20.0]),  # sin and cos of half a radian: 1 radian
    ),
}


@pytest.mark.parametrize("case", TEXTS)
def test_ways_to_say_what_a_file_has(folder, capsys, case):
    name, text, source, expected = TEXTS[case]
    agrees(run(folder, capsys, name, text, f'{{"{name}": {source}}}')[2], *expected)


def test_a_zero_among_dates_was_not_set(folder, capsys):
    text = '{"at": 1790503200, "v": 20.1}\n{"at": 0, "v": 99}\n{"at": 1790503260, "v": 20.2}\n'
    out, err, table = run(folder, capsys, "log.jsonl", text, '{"log.jsonl": field("v", node="a", time="at")}')
    agrees(table, [0, 60], [20.1, 20.2])
    assert "expected a time that was set" in err and "2 used" in out


def test_a_message_without_a_value_is_not_counted_as_used(folder, capsys):
    """Of our own form and of a table that is mapped: its moment is a row, and its value did not arrive."""
    rows = ["a,0,0,20.1", "a,1,60,", "a,2,120,20.2"]
    own = "node,sequence,time,y\n" + "\n".join(rows)
    out, _, table = run(folder, capsys, "events.csv", own)
    agrees(table, [0, 60, 120], [20.1, np.nan, 20.2])
    assert "a: 2 used, 1 without a value\n" in out  # and none is lost
    mapped = "n,t,v\n" + "\n".join(row.removeprefix("a,") for row in rows)
    source = '{"log.csv": field("v", node="a", time="t", sequence="n")}'
    assert "a: 2 used, 1 without a value\n" in run(folder, capsys, "log.csv", mapped, source)[0]


def test_the_option_for_messages_that_come_late(folder, capsys):
    """The third event came half a minute after it was measured, and after one that had been final for long."""
    rows = [("10:00:00", "10:00:00", 20.0), ("10:00:20", "10:00:20", 20.2), ("10:00:01", "10:00:31", 20.1)]
    text = "at,arrival,v\n" + "".join(f"2026-09-27T{at}Z,2026-09-27T{came}Z,{v}\n" for at, came, v in rows)
    source = '{"log.csv": field("v", node="a", time="at")}'
    out, _, table = run(folder, capsys, "log.csv", text, source)
    agrees(table, [0, 20], [20.0, 20.2])
    assert "a: 2 used, 1 late" in out
    for options in ((), ("--smooth", "all")):
        table = run(folder, capsys, "log.csv", text, source, "--window", "60", *options)[2]
        agrees(table, [0, 1, 20], [20.0, 20.1, 20.2])


REFUSED = {
    "doubled columns": ("node,sequence,time,y,y\na,0,0,20.1,25\n", "expected distinct columns, got 'y' more than once"),
    "zones in one column only": (
        "node,sequence,time,arrival,y\na,0,2026-09-27T10:00:00Z,2026-09-27T05:00:00.1,20.1\n",
        "row 1, column 'arrival': expected a zone with every date or with none",
    ),
    "the year 1": ("time,y\n0001-01-01,20.1\n", "row 1, column 'time': expected a date as"),
    "ten digits of a second": (
        "time,y\n2026-01-01T00:00:00.0123456789Z,20.1\n",
        "row 1, column 'time': expected a date",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused_as_a_whole(folder, capsys, case):
    text, line = REFUSED[case]
    _, err, table = run(folder, capsys, "data.csv", text)
    assert table is None and line in err and err.count("\n") == 1


def test_columns_that_the_network_does_not_know_are_left_out_on_request(folder, capsys):
    text = "time,y,note\n0,20.1,warm\n60,20.2,\n"
    assert run(folder, capsys, "data.csv", text)[2] is None
    agrees(run(folder, capsys, "data.csv", text, "{}", "--ignore-unknown")[2], [0, 60], [20.1, 20.2])
    events = "node,sequence,time,y,note\na,0,0,20.1,warm\na,1,60,20.2,\n"
    assert run(folder, capsys, "data.csv", events)[2] is None
    agrees(run(folder, capsys, "data.csv", events, "{}", "--ignore-unknown")[2], [0, 60], [20.1, 20.2])


COMMENTED = {
    "names behind a mark": ("#time,y\n0,20.1\n60,20.2\n", True),
    "names behind two lines": ("# a logger\n# time, y\n0,20.1\n60,20.2\n", True),
    "columns between spaces": ("% time y\n0 20.1\n60 20.2\n", True),
    "names of their own": ("# a logger\ntime;y\n0;20.1\n60;20.2\n", True),
    "another decimal point": ("time;y\n0;20,1\n60;20,2\n", True),
}


@pytest.mark.parametrize("case", COMMENTED)
def test_the_remedies_for_tables_of_other_dialects_mend_them(folder, capsys, case):
    pd = pytest.importorskip("pandas")
    text, _ = COMMENTED[case]
    _, err, table = run(folder, capsys, "data.csv", text)
    assert table is None
    remedy = err[err.index("pandas.") : err.rindex(" rewrites it")]
    exec(remedy, {"pandas": pd})
    agrees(run(folder, capsys, "data.csv", (folder / "data.csv").read_text())[2], [0, 60], [20.1, 20.2])


def test_packed_files_and_documents_of_several_messages(folder, capsys):
    import gzip

    (folder / "net.py").write_text(f'{WALK}\nsources = {{"log.csv": field("value", node="a", time="time")}}\n')
    with gzip.open(folder / "log.csv.gz", "wt") as file:
        file.write(EQUAL)
    command = ["run", "net.py", "--out", "out.csv", "--measurements"]
    assert cli.main([*command, "log.csv.gz"]) == 0
    assert len(hg.files.read_table("out.csv")["x"]) == 6
    # History of Home Assistant, as its interface returns it: lists of lists.
    states = [{"entity_id": "s", "state": s, "last_changed": f"2026-09-27T10:0{i}:00+00:00"} for i, s in enumerate(
        ["20.1", "unavailable", "20.3"])]  # fmt: skip
    source = '{"history.json": field("state", node="a", time="last_changed", quoted=True)}'
    table = run(folder, capsys, "history.json", json.dumps([states]), source)[2]
    agrees(table, [0, 120], [20.1, 20.3])


def test_a_pipe_of_a_service_has_lines_of_text_too(folder):
    (folder / "net.py").write_text(f'{WALK}\nsources = {{"t": field("", node="a")}}\n')
    bodies = served(folder, [f"2026-09-27T10:00:0{k}Z t {20 + k}" for k in range(3)])
    assert next(b for b in bodies if b["kind"] == "final")["estimates"]["a"]["k"]["mean"] == [20.0]
