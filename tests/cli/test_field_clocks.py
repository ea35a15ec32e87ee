"""Senders and clocks of files: several that are read as one, and stamps that nobody set."""

import json

import pytest

from tests.cli.walk import agrees, run


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def rows(*fields):
    """Eight messages of two senders that differ in the last field."""
    stamps = [f"2026-09-27T10:0{k}:00Z" for k in range(8)]
    return [[stamp, 20 + k / 10, *(f[k % 2] for f in fields)] for k, stamp in enumerate(stamps)]


@pytest.mark.parametrize("name", ["entity_id", "_field", "devEui", "id"])
def test_several_senders_that_are_read_as_one_sensor_are_said(folder, capsys, name):
    """A field that names a sender and has several values, of a table and of a topic's payloads."""
    senders = (7, 12) if name == "id" else ("attic", "cellar")
    table = "\n".join([f"t,v,{name},note", *(",".join(map(str, row)) for row in rows(senders, ("ok", "low")))])
    said = f"field {name!r} of log.csv has 2 values ({senders[0]}, {senders[1]}) in what is read as one sensor"
    assert said in run(folder, capsys, "log.csv", table, '{"log.csv": field("v", node="a", time="t")}')[0]
    lines = [
        json.dumps({"topic": "rtl_433/events", "payload": json.dumps({"t": t, "v": v, name: sender})})
        for t, v, sender in rows(senders)
    ]
    source = '{"rtl_433/events": field("v", node="a", time="t")}'
    assert (
        f"field {name!r} of rtl_433/events has 2 values"
        in run(folder, capsys, "log.jsonl", "\n".join(lines), source)[0]
    )


@pytest.mark.parametrize("how", ['where={"id": 7}', 'where={"id": [7, 12]}', 'plant="id"'])
def test_senders_that_are_told_apart_are_not(folder, capsys, how):
    table = "\n".join(["t,v,id", *(",".join(map(str, row)) for row in rows((7, 12)))])
    source = f'{{"log.csv": field("v", node="a", time="t", {how})}}'
    options = ("--plant", "7") if "plant" in how else ()
    assert "one sensor" not in run(folder, capsys, "log.csv", table, source, *options)[0]


def test_a_field_that_names_each_message_names_no_senders(folder, capsys):
    table = "\n".join(["t,v,id", *(f"{t},{v},{k}" for k, (t, v) in enumerate(rows()))])
    assert "one sensor" not in run(folder, capsys, "log.csv", table, '{"log.csv": field("v", node="a", time="t")}')[0]


MINUTES = [f"2026-09-27T10:0{k}:00Z" for k in range(3)]


@pytest.mark.parametrize(
    ("stamps", "kept"),
    [
        ([MINUTES[0], "1970-01-01T00:00:05Z", *MINUTES[1:]], [0, 2, 3]),  # a clock that counts since it began
        ([MINUTES[0], "2000-01-01T00:00:00Z", "2000-01-01T00:01:00Z", *MINUTES[1:]], [0, 3, 4]),
        ([*MINUTES[:2], "2036-02-07T06:28:16Z", MINUTES[2]], [0, 1, 3]),
        (["1970-01-01T00:00:05Z", "1970-01-01T00:01:05Z", *MINUTES], [2, 3, 4]),
    ],
    ids=["1970", "2000", "2036", "at the start"],
)
def test_stamps_of_a_clock_that_was_not_set_are_refused_where_arrivals_are_not_known(folder, capsys, stamps, kept):
    text = "t,v\n" + "".join(f"{stamp},{20 + k / 10}\n" for k, stamp in enumerate(stamps))
    out, err, table = run(folder, capsys, "log.csv", text, '{"log.csv": field("v", node="a", time="t")}')
    agrees(table, [0, 60, 120], [20 + k / 10 for k in kept])
    assert "a: 3 used\n" in out and "a time that was set, near the others in order" in err
    counted = "n,t,v\n" + "".join(f"{k},{stamp},{20 + k / 10}\n" for k, stamp in enumerate(stamps))
    source = '{"log.csv": field("v", node="a", time="t", sequence="n")}'
    assert "a: 3 used\n" in run(folder, capsys, "log.csv", counted, source)[0]  # and none lost


@pytest.mark.parametrize(
    "stamps",
    [
        [f"{year}-07-01T00:00:00Z" for year in range(1970, 1990)],  # once a year, from 1970 on
        ["2010-01-01T00:00:00Z", "2020-01-01T00:00:00Z", "2026-01-01T00:00:00Z", "2026-01-02T00:00:00Z"],
        [f"20{10 + 7 * k % 16}-0{1 + k % 9}-01T00:00:00Z" for k in range(40)],  # in no order
        ["1970-01-01T00:00:01Z", "1970-01-01T00:00:02Z"],
    ],
    ids=["each year", "rare", "in no order", "since it began"],
)
def test_rare_stamps_are_used(folder, capsys, stamps):
    text = "t,v\n" + "".join(f"{stamp},{20 + k / 10}\n" for k, stamp in enumerate(stamps))
    out, err, table = run(folder, capsys, "log.csv", text, '{"log.csv": field("v", node="a", time="t")}')
    assert f"a: {len(stamps)} used\n" in out and not err and len(table["x"]) == len(stamps)
