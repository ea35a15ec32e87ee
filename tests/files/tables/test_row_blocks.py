"""Tables that are read in blocks say what they say as a whole, wherever the blocks end."""

import gzip

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import heliograph.files.tables.table

tables = heliograph.files.tables.table

TEXTS = {
    "plain": "time,a,b\n0,1,2\n1,,3\n2,4,\n3,,\n4,5e-3,-6\n",
    "one column": "a\n1\n2\n3\n4\n",
    "no newline at the end": "time,a\n0,1\n1,2",
    "ends of lines of DOS": "time,a\r\n0,1\r\n1,\r\n2,-0\r\n",
    "ends of lines of old": "time,a\r0,1\r1,2\r2,3\r",
    "empty lines": "\n\ntime,a\n\n0,1\n\n\n1,2\n2,3\n\n",
    "cells of a kind": "time,a\n0,1\n1, .5\n2,007\n3,NaN\n4,1.#QNAN\n5,n/a\n6,7\n",
    "quotes over lines": 'time,"a\nb"\n0,1\n1,"2"\n2,"\n3\n"\n3,4\n4,5\n',
    "rows that are none": "time,a\n0,1\n1,x\n2\n3,4,5\n# 4,5\n5,6\n6,1 2\n",
    "a quote that is not closed": 'time,a\n0,1\n1,"2\n2,3\n3,4\n',
    "dates": "time,a\n2026-11-21T23:25:00+01:00,1\n2026-11-21T23:25:01+01:00,2\n\n,3\n2026-11-22T00:00:00+01:00,\n",
    "dates behind empty cells": "time,a\n,1\n,2\n,\n,3\n2026-11-21,4\n2026-11-22,5\n,6\n,7\n8,8\n",
    "whole numbers beyond doubles": "time,a\n1,1\n9007199254740991,2\n9007199254740993,3\n9007199254740995,4\n",
    "whole numbers beyond doubles and empty cells": "time,a\n,1\n9007199254740993,2\n-,3\n9007199254740995.0,4\n1,5\n",
    "large numbers and a fraction": "time,a\n9007199254740993,1\n9007199254740995,2\n1.5,3\n",
    "zeros with a sign": "time,a\n-0,1\n1,-0.0\n2,-0\n",
    "another table": "#group,false\ntime,a\n0,1\n1,2\n\n#group,false\ntime,b\n2,3\n3,4\n",
    "nothing": "time,a\n",
    "nothing that can be read": "time,a\nx,y\nz,w\n",
    "wide": "time," + ",".join(f"a{i}" for i in range(50)) + "\n" + 3 * ("0," + ",".join(["1.25"] * 50) + "\n"),
    "names that are not ASCII": "time,Höhe (m),°\n0,1,2\n1,3,4\n",
}


def outcome(path, block=None, strict=False):
    """The columns, the numbers of rows and the refusals of a table, or why it is none."""
    try:
        if block is None:
            rows = tables.read_rows(path, None, strict)
        else:
            rows = tables.join_rows(tables.read_row_blocks(path, None, strict, block))
            if not len(rows.numbers):
                raise rows.refused[0] if rows.refused else ValueError("none")
    except ValueError as error:
        return "none" if str(error).endswith("at least one row, got none") else str(error)
    kinds = {name: (values.dtype.str, values.tobytes()) for name, values in rows.columns.items()}
    return kinds, rows.numbers.tolist(), [str(error) for error in rows.refused]


@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize("case", TEXTS)
def test_csv_in_blocks_of_any_size(tmp_path, case, strict):
    """Also packed, with a mark, and in UTF-16; one byte at a time is one line at a time."""
    text = TEXTS[case]
    forms = {"data.csv": text.encode(), "marked.csv": text.encode("utf-8-sig")}
    forms["wide.csv"] = text.encode("utf-16")
    forms["data.csv.gz"] = gzip.compress(text.encode())
    for name, content in forms.items():
        path = tmp_path / name
        path.write_bytes(content)
        whole = outcome(path, strict=strict)
        for size in (1, 7, 20, 64):
            assert outcome(path, tables.BlockSize(bytes=size), strict) == whole, (name, size)


def test_blocks_are_small(tmp_path):
    """A table of a hundred lines of ten bytes in blocks of some hundred bytes, and what of it is read is told."""
    (tmp_path / "data.csv").write_text("time,a\n" + "".join(f"{k:04},{k:04}\n" for k in range(1000, 1100)))
    told = list[tuple[int, int]]()
    parts = list(
        tables.read_row_blocks(
            tmp_path / "data.csv", None, False, tables.BlockSize(bytes=100), lambda *of: told.append(of)
        )
    )
    assert max(len(part.numbers) for part in parts) <= 20
    assert told[-1] == (1007, 1007) and told == sorted(told) and len(told) >= 10
    assert [n for part in parts for n in part.numbers] == list(range(1, 101))


def test_a_packed_file_that_was_cut_off(tmp_path):
    """What came before is read, whatever the blocks; as the first of all lines it is an error."""
    random = np.random.default_rng(0).integers(0, 10**9, (3000, 2))
    packed = gzip.compress(("time,a\n" + "".join(f"{a},{b}\n" for a, b in random)).encode())
    (tmp_path / "data.csv.gz").write_bytes(packed[:-5000])
    whole = outcome(tmp_path / "data.csv.gz")
    assert 1000 < len(whole[1]) < 3000 and "one that was cut off" in whole[2][0]
    assert outcome(tmp_path / "data.csv.gz", tables.BlockSize(bytes=500)) == whole
    assert "one that was cut off" in outcome(tmp_path / "data.csv.gz", tables.BlockSize(bytes=500), strict=True)
    (tmp_path / "data.csv.gz").write_bytes(packed[:20])
    assert "one that was cut off" in outcome(tmp_path / "data.csv.gz", tables.BlockSize(bytes=500))


def test_parquet_in_blocks_of_any_size(tmp_path):
    """Nulls, dates, whole numbers beyond doubles in some blocks alone, and a date that nanoseconds cannot say."""
    columns = {
        "time": pa.array([1, 2, 2**53 + 1, 2**53 + 3, 2**60]),
        "at": pa.array(np.arange(5).astype("datetime64[s]")),
        "a": pa.array([None, None, 3.5, None, 4], pa.float64()),
        "b": pa.array([1, None, 3, 4, 5]),
        "d": pa.array([1, None, 2**60 + 1, None, 2**60 + 3]),
        "e": pa.array([1, 2, 3, 4, 2**60 + 1], pa.uint64()),
        "c": pa.array([None] * 5),
    }
    path = tmp_path / "data.parquet"
    pq.write_table(pa.table(columns), path, row_group_size=3)
    whole = outcome(path)
    assert whole[0]["time"][0] == "<i8" and whole[0]["b"][0] == "<f8"
    assert whole[0]["d"][0] == whole[0]["e"][0] == "<i8"
    for rows in (1, 2, 3, 4):
        assert outcome(path, tables.BlockSize(rows=rows)) == whole
    far = pa.array(np.array([0, 1, 2, 10**12], dtype="datetime64[s]"))
    pq.write_table(pa.table({"time": far}), path)
    assert "row 4: expected a date" in outcome(path, tables.BlockSize(rows=1)) == outcome(path)
    told = list[tuple[int, int]]()
    pq.write_table(pa.table({"time": [1.0, 2, 3]}), path)
    list(tables.read_row_blocks(path, None, False, tables.BlockSize(rows=2), lambda *of: told.append(of)))
    assert told == [(2, 3), (3, 3)]


def test_row_groups_that_were_read_are_let_go(tmp_path):
    """Of 40 groups of 80 kB at most a few are in memory at a time; all of them were, where Arrow buffers ahead."""
    groups, rows = 40, 10_000
    table = pa.table({"time": np.arange(groups * rows, dtype=float)})
    pq.write_table(table, tmp_path / "data.parquet", row_group_size=rows, compression="none", use_dictionary=False)
    del table
    before, most = pa.total_allocated_bytes(), 0
    for _ in tables.read_row_blocks(tmp_path / "data.parquet", None, False, tables.BlockSize(rows=rows)):
        most = max(most, pa.total_allocated_bytes() - before)
    assert most < groups / 4 * rows * 8
