"""`heliograph run`, `replay` and `inspect` on a folder of files, each with a clock of its own: topics of one log."""

import gzip
import json

import numpy as np
import pytest

import heliograph as hg
from heliograph import cli
from tests.cli.walk import WALK, agrees

FAST = [(0.25 * k, 20.0 + 0.01 * k) for k in range(9)]  # four a second, of a clock that counts from its start
SLOW = [(0.1 + 1.0 * k, 20.2 - 0.01 * k) for k in range(3)]  # one a second
DATES = [f"2026-09-27T10:00:{t:09.6f}Z" for t, _ in SLOW]
START = 'time=hg.files.Stamp("t_ms", start="2026-09-27T10:00:00Z"), time_unit="ms"'
BOTH = '{{"fast.csv": field("v", node="a", {}), "slow.csv": field("w", node="a", time={})}}'


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log").mkdir()
    (tmp_path / "log/fast.csv").write_text("t_ms,v\n" + "".join(f"{1000 * t:g},{v}\n" for t, v in FAST))
    slow = "".join(f"{date},{v}\n" for date, (_, v) in zip(DATES, SLOW, strict=True))
    (tmp_path / "log/slow.csv.gz").write_bytes(gzip.compress(f"at,w\n{slow}".encode()))
    (tmp_path / "log/notes.txt").write_text("a rainy day\n")
    return tmp_path


def run(folder, capsys, sources, out="out.csv"):
    """What `heliograph run` says, and its table; None where it refuses."""
    (folder / "net.py").write_text(f"{WALK}\nsources = {sources}\n")
    code = cli.main(["run", "net.py", "--measurements", "log", "--out", out])
    said = capsys.readouterr()
    return said.out, said.err, hg.files.read_table(out) if code == 0 else None


def merge(offset):
    """Times and values of both files by hand, those of the second later by an offset."""
    rows = sorted([*FAST, *((t + offset, v) for t, v in SLOW)])
    begin = rows[0][0]
    return [t - begin for t, _ in rows], [v for _, v in rows]


@pytest.mark.parametrize("offset", [0.0, -0.5])
def test_rows_of_several_files_are_merged_by_time(folder, capsys, offset):
    """Rates, kinds of times and latencies of their own; estimates are those of the rows in order by hand."""
    slow = "'at'" if offset == 0 else f'hg.files.Stamp("at", offset={offset})'
    out, err, table = run(folder, capsys, BOTH.format(START, slow))
    agrees(table, *merge(offset))
    assert err == "" and "a: 12 used" in out and "log: not among the sources: notes.txt" in out


def test_commands_read_a_folder_alike(folder, capsys):
    """What is replayed are the events of the run, and a fit has its rows."""
    run(folder, capsys, BOTH.format(START, "'at'"))
    assert cli.main(["replay", "log", "--network", "net.py"]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [event["values"][0] for event in events] == merge(0.0)[1]
    sources = {
        "fast.csv": hg.files.json_field(
            "v", node="a", time=hg.files.Stamp("t_ms", start="2026-09-27T10:00:00Z"), time_unit="ms"
        ),
        "slow.csv": hg.files.json_field("w", node="a", time="at"),
    }
    recording = hg.files.read_messages("log", hg.files.load_network("net.py"), sources).recording()
    np.testing.assert_allclose(recording.measurements["a"][:, 0], merge(0.0)[1], rtol=0)
    np.testing.assert_allclose(recording.time, merge(0.0)[0], rtol=0, atol=1e-9)  # seconds to the nanosecond


def test_clocks_that_cannot_be_joined_are_refused(folder, capsys):
    """One file has dates and the other numbers from its start: the line names file, field and remedy."""
    own = 'time="t_ms", time_unit="ms"'
    _, err, table = run(folder, capsys, BOTH.format(own, "'at'"))
    assert table is None and err.count("\n") == 1
    assert "log, fast.csv, field 't_ms': expected dates as in slow.csv, from 2026-09-27T10:00:00Z" in err
    assert "Stamp('t_ms', start='2026-09-27T10:00:00Z')" in err and "got numbers from 0 s" in err
    # A start is of numbers.
    late = 'hg.files.Stamp("at", start="2026-09-27T10:00:00Z")'
    _, err, _ = run(folder, capsys, f'{{"slow.csv": field("w", node="a", time={late})}}')
    assert "field 'at': expected a number, which counts from start='2026-09-27T10:00:00Z', got" in err
    with pytest.raises(ValueError, match=r"^Stamp, start: expected a date of ISO 8601 with its zone, .*got 5$"):
        hg.files.Stamp("t", start=5)
    with pytest.raises(ValueError, match=r"^Stamp, start: expected a date of ISO 8601 with its zone, got 'noon'$"):
        hg.files.Stamp("t", start="noon")
    # Two that both count from 0 are taken as one, which is said.
    (folder / "log/slow.csv.gz").unlink()
    (folder / "log/slow.csv").write_text("at,w\n" + "".join(f"{t},{v}\n" for t, v in SLOW))
    out, _, table = run(folder, capsys, BOTH.format(own, "'at'"))
    agrees(table, *merge(0.0))
    assert "log: times from 0 are taken as of one clock: fast.csv, slow.csv (start= or offset=" in out


def test_a_folder_without_what_the_sources_name(folder, capsys):
    _, err, _ = run(folder, capsys, '{"imu.csv": field("v", node="a", time="t")}')
    assert "log: expected a file that the sources name, imu.csv, got only fast.csv, notes.txt, slow.csv.gz" in err
    out, _, table = run(
        folder, capsys, f'{{"fast.csv": field("v", node="a", {START}), "imu.csv": field("v", node="a")}}'
    )
    assert len(table["x"]) == len(FAST) and "log: not in the folder: imu.csv" in out
    (folder / "empty").mkdir()
    for command in (["run", "net.py", "--measurements", "empty", "--out", "none.csv"], ["inspect", "empty"]):
        assert cli.main(command) == 2
        assert "empty: expected a bag, or a folder with tables or files of lines, got" in capsys.readouterr().err
    # A file of the folder is not written over.
    before = (folder / "log/fast.csv").read_text()
    _, err, _ = run(folder, capsys, BOTH.format(START, "'at'"), out="log/fast.csv")
    assert "output file log/fast.csv: expected another file than the measurements" in err
    assert (folder / "log/fast.csv").read_text() == before


def test_inspect_lists_the_files_of_a_folder(folder, capsys):
    """With rate and gap of a clock that its name tells, and sources to paste."""
    (folder / "log/notes.txt").unlink()
    assert cli.main(["inspect", "log"]) == 0
    said = capsys.readouterr().out
    rows = {line.split()[0]: line.split()[2:] for line in said.splitlines() if line.startswith(" ")}
    assert rows["fast.csv"] == ["9", "4", "Hz", "0.25", "s", "-"] and rows["slow.csv"] == [
        "3",
        "1",
        "Hz",
        "1",
        "s",
        "-",
    ]
    scope = {"hg": hg}
    exec(said[said.index("sources = {") :].replace("DATE", "2026-09-27T10:00:00Z"), scope)
    fast = hg.files.json_field(
        "v", "NODE", "OUTPUT", time=hg.files.Stamp("t_ms", start="2026-09-27T10:00:00Z"), time_unit="ms"
    )
    slow = hg.files.json_field("w", "NODE", "OUTPUT", time="at")
    assert scope["sources"] == {"fast.csv": fast, "slow.csv": slow}
    # Alone it counts from 0, and a column that goes back is no clock.
    (folder / "log/back.csv").write_text("time,v\n3,1\n2,1\n4,1\n")
    (folder / "log/slow.csv.gz").unlink()
    assert cli.main(["inspect", "log"]) == 0
    said = capsys.readouterr().out
    assert "json_field('v', node='NODE', output='OUTPUT', time='t_ms', time_unit='ms')" in said
    assert "'back.csv': hg.files.json_field('time', node='NODE', output='OUTPUT')," in said
