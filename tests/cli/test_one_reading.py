"""One reading: whatever is done with a file, by whichever command, or through a pipe, the same rows of it are used."""

import asyncio
import gzip
import json
import os
import subprocess
import sys
from datetime import datetime

import numpy as np
import pytest

import heliograph as hg
from heliograph import cli
from heliograph.learning import fitting
from heliograph.numerics.check import InputError
from heliograph.serving import LineReader, Pipe
from heliograph.serving.brokers.source_translator import Translator
from heliograph.serving.message import read_messages
from tests.cli.walk import WALK, kalman
from tests.files.module import load_module

VALUES = [20.1, 20.3, 20.2, 20.6]
SECONDS = [0.0, 60.0, 120.0, 300.0]
DATES = [f"2026-09-27T10:0{minute}:00.000Z" for minute in (0, 1, 2, 5)]
PAIRS = list(zip(DATES, VALUES, strict=True))
TABLE = "".join(f"{t},{v}\n" for t, v in PAIRS)
UPLINK = [json.dumps({"v": v, "at": t}) for t, v in PAIRS]
INFLUX = "#group,false,false,true\n#datatype,string,long,dateTime:RFC3339,double\n#default,mean,,,\n"
HISTORY = [{"entity_id": "s", "state": s, "last_changed": t} for t, s in [*PAIRS[:2], (DATES[1], "gone"), *PAIRS[2:]]]
BY_TIME = '{"log.csv": field("v", node="a", time="at")}'
BY_TOPIC = '{"t": field("v", node="a", time="at")}'
EVENTS = "".join(f"a,{k},{t},{v}\n" for k, (t, v) in enumerate(PAIRS))
NUMBERS = "".join(f"{t},{v}\n" for t, v in zip(SECONDS, VALUES, strict=True))
OWN = "".join(json.dumps(dict(node="a", sequence=k, time=t, values=[v])) + "\n" for k, (t, v) in enumerate(PAIRS))
LEAPS = "".join(f"{t},{v}\n" for t, v in [*zip(SECONDS[:2], VALUES[:2], strict=True), (3e8, 99)]) + "".join(
    f"{t},{v}\n" for t, v in zip(SECONDS[2:], VALUES[2:], strict=True)
)
FAR = json.dumps(dict(node="a", sequence=9, time="2036-01-01T00:00:01Z", values=[99]))
NAMED = "".join(f'{{"node": "a", "sequence": {k}, "time": "{t[:-1]}", "y": {v}}}\n' for k, (t, v) in enumerate(PAIRS))
NO_VALUE = f'{{"node": "a", "sequence": 9, "time": "{DATES[3][:-1]}", "values": [nan]}}\n'
NO_COUNT = '{"node": "a", "time": 0, "values": [1]}\n'
WORDS = "NA", "null", "None", "-", "nan", "-nan(ind)", "1.#QNAN"
FIRST, REST = TABLE.split("\n", 1)
STATE = 'field("state", node="a", time="last_changed")'
DOCUMENT = json.dumps([HISTORY], indent=1)
TWICE = f'{{"node": "a", "sequence": 9, "time": "{DATES[3]}", "values": [99], "values": [98]}}\n'
QUOTED = '{"log.json": field("state", node="a", time="last_changed", quoted=True)}'
FORMS = {
    # name: (name of the file, what is in it, sources of the network, how many rows or messages cannot be read)
    "rows of numbers": ("log.csv", f"time,y\n{NUMBERS}", "{}", 0),
    "rows of dates": ("log.csv", f"time,y\n{TABLE}", "{}", 0),
    "rows with a mark of UTF-8 and lines of Windows": (
        "log.csv", f"\ufefftime,y\r\n{TABLE}".replace("\n", "\r\n"), "{}", 0),
    "rows in UTF-16": ("log.csv", f"time,y\n{TABLE}".encode("utf-16"), "{}", 0),
    "rows in UTF-16 without its mark": ("log.csv", f"time,y\n{TABLE}".encode("utf-16-le"), "{}", 0),
    "rows in UTF-16, high bytes first": ("log.csv", f"time,y\n{TABLE}".encode("utf-16-be"), "{}", 0),
    "rows in a file of text": ("log.txt", f"time,y\n{TABLE}", "{}", 0),
    "events in a file of text, packed": (
        "log.txt.gz", gzip.compress(f"node,sequence,time,y\n{EVENTS}".encode()), "{}", 0),
    "rows of dates without marks": (
        "log.csv", "time,y\n" + "".join(f"20260927T{t[11:19].replace(':', '')}Z,{v}\n" for t, v in PAIRS), "{}", 0),
    "rows that go backwards": ("log.csv", f"time,y\n{REST}{FIRST}\n", "{}", 0),
    "rows with the newest first": (
        "log.csv", "time,y\n" + "".join(f"{t},{v}\n" for t, v in reversed(PAIRS)), "{}", 0),
    "rows of numbers of which one leaps": ("log.csv", f"time,y\n{LEAPS}", "{}", 1),
    "our own messages with the newest first": ("log.jsonl", "".join(OWN.splitlines(True)[::-1]), "{}", 0),
    "our own messages of which some were not set": (
        "log.jsonl",
        json.dumps(dict(node="a", sequence=8, time="1970-01-01T00:00:01Z", values=[99])) + "\n"
        + OWN.replace('{"node": "a", "sequence": 2', f'{FAR}\n{{"node": "a", "sequence": 2'), "{}", 2),
    "our own messages of numbers of which one leaps": (
        "log.jsonl", "".join(
            json.dumps(dict(node="a", sequence=k, time=float(t), values=[float(v)])) + "\n"
            for k, (t, v) in enumerate(line.split(",") for line in LEAPS.split())), "{}", 1),
    "events with the newest first": (
        "log.csv", "node,sequence,time,y\n" + "".join(EVENTS.splitlines(True)[::-1]), "{}", 0),
    "lines of a log with the newest first": (
        "log.jsonl", "".join(json.dumps({"topic": "t", "payload": body}) + "\n" for body in UPLINK[::-1]), BY_TOPIC, 0),
    "rows, packed": ("log.csv.gz", gzip.compress(f"time,y\n{TABLE}".encode()), "{}", 0),
    "rows, packed in two parts": ("log.csv.gz", gzip.compress(b"time,y\n") + gzip.compress(TABLE.encode()), "{}", 0),
    "rows with a line that is none": ("log.csv", f"time,y\n{FIRST}\n%&?!\n{REST}", "{}", 1),
    "rows with bytes that are no text": (
        "log.csv", b"time,y\n" + TABLE.encode().replace(b"20.2\n", b"20.2\n\xff\xfe,\x00\n"), "{}", 1),
    "rows with a quote that is not closed": ("log.csv", f'time,y\n{FIRST}\n"{DATES[1]},20.2\n{REST}', "{}", 1),
    "rows with a date that is none": ("log.csv", f"time,y\n0001-01-01T00:00:00Z,99\n{TABLE}soon,99\n", "{}", 2),
    "rows with an infinite value, and without a time": (
        "log.csv", f"time,y\n,99\n{TABLE}{DATES[3]},inf\n", "{}", 2),
    "rows whose cells say that there is no value": (
        "log.csv", f"time,y\n{TABLE}" + "".join(f"{DATES[3]},{word}\n" for word in WORDS), "{}", 0),
    "rows that sources map, whose cells say that there is no value": (
        "log.csv", f"at,v\n{TABLE}" + "".join(f"{DATES[3]},{word}\n" for word in WORDS), BY_TIME, 0),
    "events whose cells say that there is no value": (
        "log.csv", f"node,sequence,time,y\n{EVENTS}"
        + "".join(f"a,{k},{DATES[3]},{word}\n" for k, word in enumerate(WORDS, 4)), "{}", 0),
    "rows before empty ones of a spreadsheet": ("log.csv", f"time,y\n{TABLE},\n,\n\n", "{}", 0),
    "rows in lines of old computers": ("log.csv", f"time,y\n{TABLE}".replace("\n", "\r"), "{}", 0),
    "rows of dates in small letters, with a comma": (
        "log.csv", f'time,y\n"2026-09-27 10:00:00,000 GMT",20.1\n{REST}'.replace("T", "t").replace("Z", "z"), "{}", 0),
    "rows without an end": ("log.csv", f"time,y\n{TABLE}".rstrip("\n"), "{}", 0),
    "events": ("log.csv", f"node,sequence,time,y\n{EVENTS}", "{}", 0),
    "events of which one is none": ("log.csv", f"node,sequence,time,values\na,none,0,1\n{EVENTS}", "{}", 1),
    "rows that sources map": ("log.csv", f"at,v\n{TABLE}", BY_TIME, 0),
    "rows of history": (
        "log.csv", "id,state,last_changed\n" + "".join(f"s,{h['state']},{h['last_changed']}\n" for h in HISTORY),
        f'{{"log.csv": {STATE}}}', 1),
    "annotated CSV of Influx": (
        "log.csv", "\n".join(f"{INFLUX},result,table,_time,_value\n,,{k},{t},{v}\n" for k, (t, v) in enumerate(PAIRS)),
        '{"log.csv": field("_value", node="a", time="_time")}', 0),
    "rows of a log with payloads": (
        "log.csv", "topic,payload\n" + "".join(f't,"{body}"\n' for body in (u.replace('"', '""') for u in UPLINK)),
        BY_TOPIC, 0),
    "lines of a log in JSON": (
        "log.jsonl", "".join(json.dumps({"topic": "t", "payload": body}) + "\n" for body in UPLINK), BY_TOPIC, 0),
    "lines of a log, packed": (
        "log.log.gz", gzip.compress("".join(f"t {body}\n" for body in UPLINK).encode()), BY_TOPIC, 0),
    "lines of a log with some that are none": ("log.txt", "".join(f"t {body}\n?\n" for body in UPLINK), BY_TOPIC, 4),
    "lines of the topic of their file": (
        "log.jsonl", "".join(f"{body}\n" for body in UPLINK),
        '{"log.jsonl": field("v", node="a", time="at"), "other.jsonl": field("w", node="a", time="at")}', 0),
    "a document of JSON": ("log.json", DOCUMENT, QUOTED, 1),
    "a document of JSON in a line": ("log.json", json.dumps([HISTORY]), QUOTED, 1),
    "a document of JSON with a field twice in one message, and a bare nan": (
        "log.json", DOCUMENT.replace('"entity_id": "s"', '"entity_id": nan', 1).replace('"gone"', '99, "state": 98'),
        QUOTED, 1),
    "our own messages": ("log.jsonl", OWN, "{}", 0),
    "our own messages of which one has its values twice": ("log.jsonl", OWN + TWICE, "{}", 1),
    "a document of our own messages": ("log.json", f"[{','.join(OWN.splitlines())}, {TWICE}]", "{}", 1),
    "our own messages with names, a bare nan, and one without a count": (
        "log.jsonl", NAMED + NO_VALUE + NO_COUNT, "{}", 1),
}  # fmt: skip


class EnoughError(InputError):
    """The rows are known."""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def used(monkeypatch, *arguments):
    """The rows that a command filters or learns from, and what it says first."""
    rows = []

    def stop(_, *recording, **__):
        rows.append(hg.files.Recording(*(recording[0] if isinstance(recording[0], tuple) else recording)))
        raise EnoughError("enough")

    with monkeypatch.context() as patched:
        patched.setattr(hg, "run", stop)
        patched.setattr(fitting, "fit", stop)
        assert cli.main(list(arguments)) == 2
    return seconds_and_values(rows[0].time, rows[0].measurements["a"][:, 0])


def seconds_and_values(times, values):
    """Seconds since the first row, and the values that arrived."""
    there = ~np.isnan(np.asarray(values, dtype=float))
    times = np.asarray(times)
    since = (
        (times - times[0]) / np.timedelta64(1, "s")
        if times.dtype.kind == "M"
        else times.astype(float) - float(times[0])
    )
    return np.stack([since[there], np.asarray(values, dtype=float)[there]])


def of_messages(messages):
    """The same of messages, whose dates are texts or dates of Python."""
    moments = [m["time"] if isinstance(m, dict) else m.time for m in messages]
    moments = [datetime.fromisoformat(t) if isinstance(t, str) else t for t in moments]
    moments = [t.timestamp() if isinstance(t, datetime) else t for t in moments]
    values = [(m["values"] if isinstance(m, dict) else m.values)[0] for m in messages]
    return seconds_and_values(moments, [np.nan if v is None else v for v in values])


def piped(file, path):
    """Messages that a service reads of a file, whose path it knows or not, and those that it refuses."""
    network, module = load_module("net.py")
    reads = Translator(module["sources"], network) if module["sources"] else None
    payloads = []

    async def receive():
        with file.open("rb") as source:
            pipe = Pipe(
                source.fileno(), reader=LineReader(network, reads, file.relative_to(os.getcwd()) if path else None)
            )
            while (batch := await pipe.receive()) is not None:
                payloads.extend(batch.payloads)

    asyncio.run(receive())
    read = read_messages(payloads)
    messages = [message for message in read if hasattr(message, "values")]
    return messages, [message for message in read if message not in messages]


@pytest.mark.parametrize("form", FORMS)
def test_the_same_rows_are_used_whatever_is_done_with_them(folder, monkeypatch, capsys, form):
    name, text, sources, unread = FORMS[form]
    (folder / "net.py").write_text(f"{WALK}\nsources = {sources}\n")
    (folder / name).write_bytes(text.encode() if isinstance(text, str) else text)
    expected = np.stack([SECONDS, VALUES])
    run = ["run", "net.py", "--measurements", name]
    for command in (
        [*run, "--out", "out.csv"],
        [*run, "--report", "page"],
        [*run, "--out", "out.csv", "--smooth", "all"],
        ["fit", "net.py", "--measurements", name, "--out", "fit", "--held-out", "0"],
    ):
        np.testing.assert_allclose(used(monkeypatch, *command), expected, rtol=0, atol=1e-9)
    capsys.readouterr()
    assert cli.main(["replay", name, "--network", "net.py"]) == 0
    said = capsys.readouterr()
    np.testing.assert_allclose(
        of_messages([json.loads(line) for line in said.out.splitlines()]), expected, rtol=0, atol=1e-6
    )
    assert (f"that could not be read: {unread};" in said.err) == (unread > 0)
    # As a file that is redirected; through a pipe, which knows no later rows, where one topic alone is known.
    messages, refused = piped(folder / name, path=True)
    np.testing.assert_allclose(of_messages(messages), expected, rtol=0, atol=1e-6)
    assert len(refused) == unread
    if "other" not in sources and not any(word in form for word in ("newest first", "backwards", "leaps", "not set")):
        messages, refused = piped(folder / name, path=False)
        np.testing.assert_allclose(of_messages(messages), expected, rtol=0, atol=1e-6)
        assert len(refused) == unread
    # The first that cannot be read ends it on request.
    if unread:
        assert cli.main([*run, "--out", "out.csv", "--strict"]) == 2
        assert name in capsys.readouterr().err and not (folder / "out.csv").exists()


@pytest.mark.parametrize("kind", ["log.csv.gz", "log.jsonl.gz"])
def test_what_came_before_the_end_of_a_file_that_was_cut_off_is_used(folder, monkeypatch, capsys, caplog, kind):
    rows = 400
    table = "time,y\n" + "".join(f"{k},{20 + k % 7}\n" for k in range(rows))
    lines = "".join(json.dumps(dict(node="a", sequence=k, time=k, values=[20 + k % 7])) + "\n" for k in range(rows))
    packed = gzip.compress((table if "csv" in kind else lines).encode(), 1)
    (folder / "net.py").write_text(f"{WALK}\nsources = {{}}\n")
    (folder / kind).write_bytes(packed[: len(packed) // 2])
    found = used(monkeypatch, "run", "net.py", "--measurements", kind, "--out", "out.csv")
    assert 100 < found.shape[1] < rows
    np.testing.assert_array_equal(found[0], np.arange(found.shape[1]))
    assert cli.main(["replay", kind, "--network", "net.py"]) == 0
    said = capsys.readouterr().err
    assert f"{kind}: expected a packed file without damage, got one that was cut off" in said
    messages, _ = piped(folder / kind, path=True)
    assert abs(len(messages) - found.shape[1]) <= 1  # the last line may have lost its end
    assert caplog.messages == [f"{kind}: expected a packed file without damage, got one that was cut off"]


REFUSED = {
    "doubled columns": ("time,y,y\n0,1,2\n", "log.csv, header: expected distinct columns, got 'y' more than once"),
    "other separators": ("time;y\n0;20,1\n", "log.csv, header: expected names separated by commas, got semicolons"),
    "names in a comment": ("#time,y\n0,20.1\n", "log.csv, header: expected names of columns, got a comment"),
    "an unknown column": ("time,y,note\n0,20.1,\n", "log.csv, header: expected only the columns time, dt, y, tru"),
    "another encoding": ("time,y,°C\n0,20.1,\n".encode("latin-1"), "log.csv, header: expected a text in UTF-8"),
    "a bag": (b"\x89MCAP0\r\n", "expected text: CSV, lines of JSON, a log, got a bag: heliograph replay sends it"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_table_is_one_line_at_every_door(folder, capsys, case):
    text, line = REFUSED[case]
    (folder / "net.py").write_text(f"{WALK}\nsources = {{}}\n")
    (folder / "log.csv").write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(InputError) as error:
        piped(folder / "log.csv", path=True)
    assert line in str(error.value) and "\n" not in str(error.value)
    assert cli.main(["run", "net.py", "--measurements", "log.csv", "--out", "out.csv"]) == 2
    said = capsys.readouterr().err
    assert case == "a bag" or (line in said and said.count("\n") == 1)


REMEDIES = {
    "the day first": "time,y\n27.09.2026 10:00,20.1\n27.09.2026 10:01,20.3\n",
    "the month first": "time,y\n09/27/2026 10:00:00,20.1\n09/27/2026 10:01:00,20.3\n",
    "a header in Latin-1": "# °C\ntime,y\n0,20.1\n60,20.3\n".encode("latin-1"),
}


@pytest.mark.parametrize("case", REMEDIES)
def test_the_remedies_for_dates_and_encodings_mend_them(folder, monkeypatch, capsys, case):
    pd = pytest.importorskip("pandas")
    text = REMEDIES[case]
    (folder / "net.py").write_text(f"{WALK}\nsources = {{}}\n")
    (folder / "log.csv").write_bytes(text.encode() if isinstance(text, str) else text)
    run = ["run", "net.py", "--measurements", "log.csv", "--out", "out.csv"]
    for _ in range(3):  # a table may need several
        if cli.main(run) == 0:
            break
        said = capsys.readouterr().err
        exec(said[said.index("pandas.") : said.rindex(" rewrites it")], {"pandas": pd})
    np.testing.assert_allclose(used(monkeypatch, *run), [[0, 60], [20.1, 20.3]], rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["rows of dates", "annotated CSV of Influx", "lines of a log, packed"])
def test_a_service_that_is_sent_a_file_estimates_what_a_run_does(folder, form):
    name, text, sources, _ = FORMS[form]
    (folder / "net.py").write_text(f"{WALK}\nsources = {sources}\n")
    (folder / name).write_bytes(text.encode() if isinstance(text, str) else text)
    command = [sys.executable, "-m", "heliograph", "serve", "net.py", "--store", "none"]
    with (folder / name).open("rb") as source:
        done = subprocess.run(command, stdin=source, capture_output=True, text=True, env=os.environ)
    assert done.returncode == 0, done.stderr
    finals = [body for body in map(json.loads, done.stdout.splitlines()) if body["kind"] == "final"]
    mean, sd = kalman(SECONDS, VALUES)
    last = finals[-1]["estimates"]["a"]["k"]
    assert len(finals) == 4
    np.testing.assert_allclose([last["mean"][0], last["covariance"][0][0]], [mean, sd**2], rtol=1e-9)


def test_a_replay_says_where_messages_have_fewer_digits_than_the_file(folder, capsys):
    (folder / "net.py").write_text(f"{WALK}\nsources = {{}}\n")
    (folder / "log.csv").write_text("time,y\n2026-09-27T10:00:00.123456789Z,20.1\n2026-09-27T10:00:01.123456Z,20.3\n")
    assert cli.main(["replay", "log.csv", "--network", "net.py"]) == 0
    assert "heliograph: log.csv: times that messages have to the microsecond only: 1" in capsys.readouterr().err
