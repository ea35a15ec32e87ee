"""`heliograph run` over rows in blocks: it writes what it writes of all rows at once, or takes all at once."""

import gzip
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import heliograph.files.tables.table
from heliograph import cli
from heliograph.files import read_table
from heliograph.files.network_file import load_network
from heliograph.numerics.check import InputError
from tests.cli.example import LOSING, NETWORK, contents, run_arguments

STEPS = """
import heliograph as hg

plant = hg.LinearPlant([[1.0, 1.0], [0.0, 0.9]], [[0.0, 0.0], [0.0, 0.1]], [0.0, 0.0], 1.0, [[0.0], [1.0]],
                       states=["p", "v"], inputs=["push"])
sensor = hg.LinearSensor([[1.0, 0.0]], 0.1, outputs=["pos"])
network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(1), {"kf": hg.kalman_filter(plant, sensor)})})
"""
BlockSize = heliograph.files.tables.table.BlockSize
SMALL = BlockSize(rows=8, bytes=60)  # eight rows a block, of text some four lines at a time
ALL = BlockSize()  # more than any of these tables has
random = np.random.default_rng(5)
ROWS = [f"{k},{random.normal():.3f},{random.normal():.3f}" for k in range(43)]


def table(rows, header="time,push,pos") -> str:
    return "\n".join([header, *rows, ""])


def changed(**rows) -> str:
    """The rows with others in the place of those of these numbers, from 1: row9="..."."""
    return table([rows.get(f"row{k}", row) for k, row in enumerate(ROWS, 1)])


def dated(k: int, unit: str = "s") -> str:
    return f"{np.datetime64('2026-03-29T00:59:55') + np.timedelta64(k, unit)}Z"


@cache
def network_of(text: str):
    """The same network for all tests, so that it is compiled once."""
    with TemporaryDirectory() as folder:
        (Path(folder) / "net.py").write_text(text)
        return load_network(str(Path(folder) / "net.py"))


def run_in_blocks(text=NETWORK, name="data.csv", out="out.csv", block=SMALL, progress=lambda *_: None, **options):
    """Run a table in blocks; return the warnings and the summary."""
    most = options.pop("most", 10**6)
    arguments = network_of(text), Path(name), Path(out), cli.ReadingOptions(**options)
    return cli.filter_in_blocks(*arguments, progress, block, most)


def run_both(text=NETWORK, name="data.csv", out="out.csv"):
    """Run a table in small blocks and in one; return what is written of both, and what is said of both."""
    told = list[tuple[str, int, int]]()
    said = run_in_blocks(text, name, out, progress=lambda *of: told.append(of))
    assert told[-1][1] == told[-1][2] and told == sorted(told)
    whole = run_in_blocks(text, name, "whole" + out, ALL)
    return read_table("whole" + out), read_table(out), whole[0], said


def assert_same(whole, blocks) -> None:
    """Rounding alone: programs of other lengths."""
    assert list(whole) == list(blocks)
    for name, values in whole.items():
        assert blocks[name].dtype == values.dtype
        if values.dtype.kind == "f":
            np.testing.assert_allclose(blocks[name], values, rtol=1e-12, atol=1e-12, err_msg=name)
        else:
            np.testing.assert_array_equal(blocks[name], values)


TABLES = {
    "complete": table(ROWS),
    "missing at the edges": changed(row8="7,1,", row9="8,1,", row16="15,1,", row17="16,0,2"),
    "rows that cannot be read at the edges": changed(
        row8="7,x,1", row9="8,1,", row16="15,1,far", row17="16", row18="?"
    ),
    "the first and the last": changed(row1="0,x,1", row2="1,,1", row42="41,1,inf", row43="42,,"),
    "a whole block": changed(**{f"row{k}": f"{k},?,1" for k in range(10, 30)}),
    "out of order within a part": changed(row2="2,1,1", row3="1,1,1"),
    "twice": changed(row8="7,1,1", row9="7,1,1", row10="7,1,1"),
    "dates": table([f"{dated(k)},{k % 3},{k}" for k in range(43)]),
    "dates of which some are missing": table([f"{dated(k) if k % 8 else ''},{k % 3},{k}" for k in range(43)]),
    "an hour apart": table([f"{dated(k, 'h')},{k % 3},{k}" for k in range(43)]),
}


@pytest.mark.parametrize("case", TABLES)
@pytest.mark.parametrize("network", [NETWORK, STEPS], ids=["time", "steps"])
def test_blocks_are_the_whole(folder, network, case):
    """Time steps, held inputs, the steps of rows that did not arrive and what is refused go on across blocks."""
    (folder / "data.csv").write_text(TABLES[case])
    whole, blocks, expected, (doubts, summary) = run_both(network)
    assert_same(whole, blocks)
    assert summary[0].startswith(f"out.csv: {len(whole['time'])} rows of ")
    assert counts_in(doubts) == counts_in(expected)


def counts_in(lines) -> list[str]:
    """How many rows were refused, and put in order; which of them are shown first may differ."""
    found = [line.partition(";")[0] for line in lines]
    return [line for line in found if "could not be read" in line or "in the order" in line]


@pytest.mark.parametrize("size", [60, 120, 10**6])
@pytest.mark.parametrize("network", [NETWORK, STEPS], ids=["time", "steps"])
def test_a_clock_that_was_set_back_is_refused_wherever_blocks_end(folder, network, size):
    """By an hour at the end of summer time: put in order, rows of two hours were mixed."""
    minutes = [*range(60, 180, 10), *range(120, 240, 10)]
    rows = [f"2026-10-25T0{minute // 60}:{minute % 60:02}:00,0,1" for minute in minutes]
    (folder / "data.csv").write_text(table(rows))
    with pytest.raises(InputError, match=r"row 13, column .time.: expected dates in UTC.* when summer time ends"):
        run_in_blocks(network, block=BlockSize(rows=8, bytes=size))


@pytest.mark.parametrize("size", [1, 10, 60])
@pytest.mark.parametrize("text", [
    table(["0,1,x", "x,1,1", *ROWS[2:9]]),  # the first two rows, of times 0 and 1
    table(["0,1,x", "1,1,x", ROWS[2], "3,1,x", "4,1,x", *ROWS[5:9]]),  # and two behind the first that is read
    table([f"{dated(0)},1,x", f"{dated(10)},1,x", *(f"{dated(10 * k)},0,1" for k in (2, 3, 4))]),
    table(["0,1,x", "1,1,x", "2,1,1"]),  # the times of what is ahead of the only row are not known: its own
], ids=["ahead", "alone", "dates", "one row"])  # fmt: skip
def test_rows_ahead_of_the_first_that_is_read_have_times_of_their_own(folder, text, size):
    """They had its time; in blocks of single lines too, of which the first does not know how long a step is."""
    (folder / "data.csv").write_text(text)
    run_in_blocks(STEPS, block=BlockSize(rows=8, bytes=size))
    run_in_blocks(STEPS, out="whole.csv", block=ALL)
    blocks, whole = read_table("out.csv"), read_table("whole.csv")
    assert_same(whole, blocks)
    length = np.diff(whole["time"])
    assert (length == length[-1]).all()  # exactly: whole numbers


def test_parquet_and_packed_tables_in_blocks(folder):
    """Of Parquet as of CSV; whole numbers beyond doubles and dates stay what they are."""
    (folder / "data.csv.gz").write_bytes(gzip.compress(TABLES["missing at the edges"].encode()))
    assert_same(*run_both(name="data.csv.gz")[:2])
    for unit, start in {"ns": 2**60, "s": 0}.items():
        time = start + np.arange(43)
        stamps = pa.array(time.astype("datetime64[s]")) if unit == "s" else pa.array(time)
        values = pa.array([None if k % 8 in (0, 7) else float(k) for k in range(43)])
        pq.write_table(pa.table({"time": stamps, "push": np.zeros(43), "pos": values}), folder / "data.parquet")
        whole, blocks, *_ = run_both(name="data.parquet", out="out.parquet")
        assert_same(whole, blocks)
        assert whole["time"].dtype == ("datetime64[ns]" if unit == "s" else np.int64)
        assert pq.read_schema(folder / "out.parquet").equals(pq.read_schema(folder / "wholeout.parquet"))
        assert pq.ParquetFile(folder / "out.parquet").num_row_groups == 6  # 43 rows in blocks of 8


def test_a_given_dt_and_columns_nobody_knows(folder):
    rows = [f"{row},{0.1 * (k % 4)}" for k, row in enumerate(ROWS)]
    (folder / "data.csv").write_text(table(rows, "time,push,pos,dt"))
    whole, blocks, *_ = run_both()
    assert_same(whole, blocks)
    (folder / "data.csv").write_text(table([f"{row},7" for row in rows], "time,push,pos,dt,x"))
    run_in_blocks(ignore_unknown=True)
    assert_same(whole, read_table("out.csv"))


ALL_AT_ONCE = {
    "backwards in the third block": (changed(row20="3,1,1"), "row 20, column 'time': .* got 3 after 1[67]"),
    "out of order across parts": (changed(row12="40,1,1"), "row 1[3-9], .* got 1[2-8] after 40"),
    "unset, and a year without rows": (
        changed(row2="1e9,1,1", **{f"row{k}": f"{1e8 + k},1,1" for k in range(30, 44)}), "steps of more than a year"),
    "from numbers to larger ones": (
        table([f"{2**53 - 20 + k},1,1" for k in range(43)]), "of the kind before, float64, got int64"),
    "the truth": (table([f"{row},0" for row in ROWS], "time,push,pos,truth.p"), "errors are of the truth"),
}  # fmt: skip


@pytest.mark.parametrize("case", ALL_AT_ONCE)
def test_what_only_all_rows_say_is_no_block(folder, case):
    """Nothing is written; of very many rows the error says what to do."""
    text, why = ALL_AT_ONCE[case]
    (folder / "data.csv").write_text(text)
    before = contents(folder)
    with pytest.raises(cli.AllRowsNeededError, match=why):
        run_in_blocks()
    if case != "the truth":
        with pytest.raises(InputError, match=f"({why}).*more than 40 rows.* blocks of 8,.*sort the file by time"):
            run_in_blocks(most=40)
    assert contents(folder) == before


def test_filters_that_weigh_are_judged_by_all_rows(folder):
    (folder / "data.csv").write_text(table(ROWS))
    with pytest.raises(cli.AllRowsNeededError, match="what a/kf weighs is judged by all of them"):
        run_in_blocks(STEPS.replace("kalman_filter(plant, sensor)", "robust_filter(plant, sensor, hg.perfect(1))"))
    assert not (folder / "out.csv").exists()


def test_a_stamp_that_only_a_block_calls_unset(folder):
    """A year back of its block, but among the stamps of the first."""
    far = {f"row{k}": f"{1e6 * k},1,1" for k in range(1, 44)}
    (folder / "data.csv").write_text(changed(**far | {"row42": "2e6,1,1"}))
    with pytest.raises(cli.AllRowsNeededError, match=r"row 42, .* expected times in order, got 2000000 after"):
        run_in_blocks()
    assert not (folder / "out.csv").exists()


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device"), MemoryError()])
def test_an_end_in_the_second_block_leaves_nothing(folder, error):
    """Nor does it change what was there."""
    (folder / "data.csv").write_text(table(ROWS))
    (folder / "out.parquet").write_text("before")
    before = contents(folder)

    def stop(_: str, done: int, total: int) -> None:
        if done > total / 2:
            raise error

    with pytest.raises(type(error)):
        run_in_blocks(out="out.parquet", progress=stop)
    assert contents(folder) == before


def test_a_row_that_cannot_be_read_ends_a_strict_run(folder):
    (folder / "data.csv").write_text(changed(row20="19,far,1"))
    before = contents(folder)
    with pytest.raises(InputError, match="row 20, column 'push': expected a number or an empty cell, got 'far'"):
        run_in_blocks(strict=True)
    assert contents(folder) == before


def test_warnings_are_told_once(folder):
    """With the rows of the first block that has them; of a single block as of all rows."""
    bounded = STEPS.replace("hg.perfect(1), {", "hg.perfect(1), limits=(-5, 5), filters={")
    (folder / "data.csv").write_text(changed(row12="11,1,6", row20="19,1,6", row21="20,1,7", row40="39,1,-8"))
    _, _, whole, (doubts, _) = run_both(bounded)
    assert len(doubts) == 1 and whole[0].startswith("node 'a': 4 of 43 values count as not arrived")
    assert doubts[0].startswith("of the rows 9 to 16, counted from 1: node 'a': 1 of 8 values count as not arrived")
    assert "row 4: pos 6" in doubts[0] and doubts[0].endswith(" (likewise in 2 later blocks)")


def test_lost_covariances_are_counted_over_all_blocks(folder):
    (folder / "data.csv").write_text(table(ROWS))
    _, _, whole, (doubts, summary) = run_both(NETWORK + LOSING)
    assert summary[0].endswith("43 rows of remote/losing (nominal, none of 41 rows)")
    assert doubts == [f"of the rows 1 to 8, counted from 1: {whole[0]} (likewise in 5 later blocks)"]


def test_a_table_is_long_beyond_a_limit(tmp_path):
    (tmp_path / "data.csv").write_text("time,a\n0,1\n")
    assert not cli.is_long(tmp_path / "data.csv") and cli.is_long(tmp_path / "data.csv", BlockSize(bytes=10))
    pq.write_table(pa.table({"a": [1, 2, 3]}), tmp_path / "data.parquet")
    assert not cli.is_long(tmp_path / "data.parquet", BlockSize(rows=3))
    assert cli.is_long(tmp_path / "data.parquet", BlockSize(rows=2))
    (tmp_path / "none.parquet").write_text("none")
    assert not any(cli.is_long(tmp_path / name) for name in ("none.parquet", "nothing.csv", "data.jsonl"))


@pytest.fixture(scope="module")
def long_table(tmp_path_factory):
    """A table of 17 MiB, of which one column says nothing."""
    path = tmp_path_factory.mktemp("long") / "long.csv"
    rows = (f"{k},0.5,{k % 7},{0:0255}\n" for k in range(67_000))
    path.write_text("time,push,pos,filling\n" + "".join(rows))
    return path


@pytest.mark.slow
def test_long_tables_are_run_in_blocks_by_the_command(folder, capsys, long_table):
    """And one that the command reads as a whole, for what needs all rows, says so in a line."""
    (folder / "net.py").write_text(STEPS)
    arguments = [*run_arguments(measurements=str(long_table), out="out.parquet"), "--ignore-unknown"]
    assert cli.main(arguments) == 0
    said = capsys.readouterr()
    assert said.out == "out.parquet: 67000 rows of a/kf (exact)\n" and said.err == ""
    more = ["out2.parquet", "--ignore-unknown", "--forecast", "2", "--predicted"]
    assert cli.main([*arguments[:-2], *more]) == 0
    expected = f"heliograph: {long_table}: all rows are held in memory at once: --forecast and --predicted need them\n"
    assert capsys.readouterr().err == expected
    blocks, whole = read_table("out.parquet"), read_table("out2.parquet")
    np.testing.assert_allclose(blocks["p"], whole["p"][: len(blocks["p"])], rtol=1e-12, atol=1e-12)


FUSED = """
node = hg.Node(sensor, hg.perfect(1), {"kf": hg.kalman_filter(plant, sensor)})
reported = hg.Fusion("kf", hg.fusion.AllReports(), uplink=hg.fusion.ReportLink())
network = hg.Network(plant, {"a": node, "b": node}, fused={"all": reported})
"""


@pytest.mark.slow
@pytest.mark.parametrize(("more", "out", "network", "why"), [
    (["--smooth", "1"], "out.csv", STEPS, "--smooth needs them"),
    ([], "out.mcap", STEPS, "blocks go to .csv or .parquet alone, not to out.mcap"),
    ([], "out.csv", STEPS + FUSED, "messages of the fusion all may come rows later"),
])  # fmt: skip
def test_what_needs_all_rows_is_said_before_they_are_read(folder, capsys, long_table, more, out, network, why):
    """Which then ends at the column that no network knows."""
    (folder / "net.py").write_text(network)
    assert cli.main([*run_arguments(measurements=str(long_table), out=out), *more]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert first == f"heliograph: {long_table}: all rows are held in memory at once: {why}"
    assert f"{long_table}, header: expected only the columns" in second
