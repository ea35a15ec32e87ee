import bz2
import csv
import lzma
import os
from decimal import Decimal
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import heliograph.files.tables.table
from heliograph.disk import check_folder_writable, check_writable, name_path_in_errors
from heliograph.files.tables.table import read_table, write_table

MISSING = np.iinfo(np.int64).min  # in a column of whole numbers
convert_to_columns, read_rows = (
    heliograph.files.tables.table.convert_to_columns,
    heliograph.files.tables.table.read_rows,
)

COLUMNS = {
    "time": np.array([0.0, 0.1, 1e-300]),
    "a": np.array([1 / 3, np.nan, -1.7976931348623157e308]),
}


def text_file(folder: Path, text: str, name: str = "data.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def refused(call, *fragments: str) -> None:
    with pytest.raises(ValueError) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    assert ": expected " in message and ", got " in message
    for fragment in fragments:
        assert fragment in message


@pytest.mark.parametrize("name", ["table.csv", "table.parquet", "TABLE.CSV"])
def test_numbers_survive_a_file_bit_by_bit(tmp_path, name):
    write_table(COLUMNS, tmp_path / name)
    read = read_table(tmp_path / name)
    assert list(read) == list(COLUMNS)
    for column, values in COLUMNS.items():
        np.testing.assert_array_equal(read[column], values)


def test_decimals_in_csv_are_those_of_python(tmp_path):
    c = np.random.default_rng(0)
    ends = [0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 1e-5, 1e-4, 1e16, np.nextafter(1e-5, 0), np.nextafter(1e16, 0)]
    any_bits = c.integers(0, 2**64, 20_000, dtype=np.uint64).view(float)
    values = np.concatenate([ends, any_bits, c.standard_normal(20_000) * 10.0 ** c.integers(-12, 18, 20_000)])
    with np.errstate(over="ignore", invalid="ignore"):
        single = values.astype(np.float32)
    write_table({"a": values, "b": single}, tmp_path / "table.csv")
    _, *lines = (tmp_path / "table.csv").read_text().splitlines()
    assert lines == [f"{a!r},{b!r}" for a, b in zip(values.tolist(), single.tolist(), strict=True)]


def test_csv_as_people_write_it(tmp_path):
    path = text_file(tmp_path, "\ufefftime, a\r\n0 , 1\r\n\r\n1,\r\n2,nan\r\n")
    read = read_table(path)
    np.testing.assert_array_equal(read["time"], [0, 1, 2])
    np.testing.assert_array_equal(read["a"], [1, np.nan, np.nan])


def test_parquet_of_integers_and_nulls(tmp_path):
    table = pa.table({"time": pa.array([0, 1], pa.int32()), "a": pa.array([None, 7]), "b": pa.nulls(2)})
    pq.write_table(table, tmp_path / "t.parquet")
    read = read_table(tmp_path / "t.parquet")
    np.testing.assert_array_equal(read["time"], [0, 1])
    np.testing.assert_array_equal(read["a"], [np.nan, 7])
    np.testing.assert_array_equal(read["b"], [np.nan, np.nan])
    assert all(column.dtype == np.float64 for column in read.values())


def test_truth_values_are_one_and_zero_in_csv(tmp_path):
    write_table({"valid": np.array([True, False])}, tmp_path / "t.csv")
    assert (tmp_path / "t.csv").read_text().split() == ["valid", "1", "0"]


def test_flags_are_one_and_zero_in_every_format(tmp_path):
    """As pandas writes them to CSV; they were refused there, and read from Parquet and from a DataFrame."""
    path = text_file(tmp_path, "valid,x\nTrue,1\nfalse,2\nTRUE,\n,3\n")
    flags = pa.array([True, False, True, None])
    pq.write_table(pa.table({"valid": flags}), tmp_path / "t.parquet")
    frame = pd.DataFrame({"valid": pd.array([True, False, True, None], pd.ArrowDtype(pa.bool_()))})
    tables = (path, tmp_path / "t.parquet", frame, pa.table({"valid": flags}))
    for table in tables:
        np.testing.assert_array_equal(convert_to_columns(table)["valid"], [1, 0, 1, np.nan])
    refused(lambda: read_table(text_file(tmp_path, "valid\nTrue\nyes\n")), "row 2, column 'valid'", "'yes'")


def test_decimals_and_categories_of_parquet_are_numbers(tmp_path):
    """As databases and pandas write them; whole decimals keep every digit."""
    stamps = [1_700_000_000_000_000_001, None, 1_700_000_000_000_000_003]
    columns = {
        "price": pa.array([Decimal("1.10"), None, Decimal("-3.07")], pa.decimal128(5, 2)),
        "time": pa.array([stamp and Decimal(stamp) for stamp in stamps], pa.decimal128(20, 0)),
        "level": pa.array([5.5, None, 5.5]).dictionary_encode(),
    }
    pq.write_table(pa.table(columns), tmp_path / "t.parquet")
    rows = read_rows(tmp_path / "t.parquet", None, strict=True).columns
    np.testing.assert_array_equal(rows["price"], [1.1, np.nan, -3.07])
    np.testing.assert_array_equal(rows["level"], [5.5, np.nan, 5.5])
    assert rows["time"].tolist() == [stamps[0], MISSING, stamps[2]]


def test_the_least_whole_number_is_none_that_is_missing(tmp_path):
    """-2^63 stands for a missing one among whole numbers: then these are doubles. It was read as missing."""
    pq.write_table(pa.table({"a": pa.array([-(2**63), None, 2**60 + 1])}), tmp_path / "t.parquet")
    np.testing.assert_array_equal(read_table(tmp_path / "t.parquet")["a"], [-(2.0**63), np.nan, 2.0**60])


def test_whole_numbers_keep_their_digits_beside_one_that_is_missing():
    stamps = [1_700_000_000_000_000_001, None, 1_700_000_000_000_000_003]
    kept = [stamps[0], MISSING, stamps[2]]
    for column in (stamps, tuple(stamps), np.array(stamps, dtype=object), pd.array(stamps, "Int64")):
        assert convert_to_columns({"time": column})["time"].tolist() == kept
    assert convert_to_columns(pa.table({"time": pa.array(stamps)}))["time"].tolist() == kept
    np.testing.assert_array_equal(convert_to_columns({"x": [1e300, None, 0.5]})["x"], [1e300, np.nan, 0.5])


def test_columns_that_do_not_belong_together_are_one_line():
    """Of unlike lengths, of several axes, and of pandas by another index, whose rows were joined by their places."""
    shuffled = {"time": pd.Series([0.0, 1, 2], index=[2, 1, 0]), "x": pd.Series([5.0, 6, 7], index=[0, 1, 2])}
    refused(lambda: convert_to_columns(shuffled), "column 'x'", "the index of column 'time'")
    assert list(convert_to_columns({"time": [0.0, 1, 2], "x": shuffled["x"]})["x"]) == [5, 6, 7]
    refused(lambda: convert_to_columns({"time": [0.0, 1], "x": [1.0]}), "as many rows in each", "{'time': 2, 'x': 1}")
    for x in (np.ones((2, 2)), 1.0):
        refused(lambda x=x: convert_to_columns({"x": x}), "column 'x'", "one number or date in each row")


@pytest.mark.parametrize(
    ("text", "fragments"),
    [
        ("", ["data.csv", "an empty file"]),
        ("time,a\n", ["data.csv", "at least one row", "none"]),
        ("time,a\n0,1_000\n", ["data.csv, row 1, column 'a': expected a number or an empty cell, got '1_000'"]),
        ("time;a\n0;1\n", ["data.csv, header: expected names separated by commas, got semicolons in 'time;a'"]),
        ("time\ta\n0\t1\n", ["data.csv, header: expected names separated by commas, got tabs in"]),
        ("time,a\n0,1,5\n", ["row 1: expected 2 cells, one for each column, got 3: numbers have a decimal point"]),
        ('time,a\n0,"1,5"\n', ["column 'a': expected a number or an empty cell, got '1,5': numbers have a decimal"]),
        ("# made by hand\ntime,a\n0,1\n", ["data.csv, header: expected names of columns, got a comment, '# made"]),
        ("time,a\n# a pause\n0,1\n", ["data.csv, row 1: expected numbers, got a comment, '# a pause'"]),
        ("\n\n", ["data.csv", "at least one row"]),
        ("time,a,a\n0,1,2\n", ["header", "distinct columns", "'a'"]),
        ("time,a\n0,1\n1,abc\n", ["row 2, column 'a'", "a number", "'abc'"]),
        ("time,a\n0,1\n1\n", ["row 2", "2 cells", "got 1"]),
        ('time,a\n0,"1\n', ["data.csv, row 1", "a row of CSV", "unexpected end of data"]),
    ],
)
def test_csv_that_is_no_table_of_numbers(tmp_path, text, fragments):
    path = text_file(tmp_path, text)
    refused(lambda: read_table(path), *fragments)


def test_bytes_that_are_no_utf8(tmp_path):
    (tmp_path / "data.csv").write_bytes(b"time,a\n0,\xff\n")
    refused(lambda: read_table(tmp_path / "data.csv"), "data.csv", "UTF-8")


def test_a_table_without_names_is_refused(tmp_path):
    """Its first row was taken for the names, and was gone."""
    path = text_file(tmp_path, "0,1.5\n1,-2e-3\n2,3\n")
    refused(lambda: read_table(path), "header", "names of columns", "numbers alone, '0,1.5'", "header=None")


@pytest.mark.parametrize(
    "text", [",time,a,,\n7,0,1,,\n8,1,2,,\n", "time,a,,\n0,1,7,\n1,2,8,\n", "time,,a,\n0,7,1,\n1,8,2,x\n"]
)
def test_columns_without_a_name_do_not_replace_each_other(tmp_path, text):
    """As an index of pandas beside commas at the ends of lines: the last of them was read, and others were gone."""
    path = text_file(tmp_path, text.replace(",x", ","))
    read = read_table(path)
    np.testing.assert_array_equal(read[""], [7, 8])
    np.testing.assert_array_equal(read["a"], [1, 2])
    refused(lambda: read_table(text_file(tmp_path, "time,,\n0,7,1\n1,8,2\n")), "a name for each column that has values")
    refused(
        lambda: read_table(text_file(tmp_path, "time,,\n0,7,1\n1,8, 2\n")), "a name for each column that has values"
    )


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (bz2.compress(b"time,a\n0,1\n"), "a file of bzip2"),
        (lzma.compress(b"time,a\n0,1\n"), "a file of xz"),
        (b"PK\x03\x04\x14\x00", "a file of zip"),
        (b"PAR1\x15\x04", "a Parquet file"),
    ],
)
def test_a_file_of_another_kind_is_called_by_it(tmp_path, content, kind):
    """It was called a text in another encoding, with a call that would not have rewritten it."""
    (tmp_path / "data.csv").write_bytes(content)
    refused(lambda: read_table(tmp_path / "data.csv"), "data.csv: expected a text, as it is or packed by gzip", kind)


def test_parquet_that_is_no_table_of_numbers(tmp_path):
    path = text_file(tmp_path, "time,a\n0,1\n", "data.parquet")
    refused(lambda: read_table(path), "data.parquet", "a Parquet file")
    pq.write_table(pa.table({"time": ["noon"]}), path)
    refused(lambda: read_table(path), "row 1, column 'time'", "numbers", "string ['noon']")
    pq.write_table(pa.table([[1.0], [2.0]], names=["a", "a"]), path)
    refused(lambda: read_table(path), "distinct columns", "'a'")
    pq.write_table(pa.table({"time": pa.array([], pa.float64())}), path)
    refused(lambda: read_table(path), "at least one row", "none")


def test_files_that_are_not_there(tmp_path):
    refused(lambda: read_table(tmp_path / "no.csv"), "no.csv", "a file", "nothing of that name")
    (tmp_path / "folder.csv").mkdir()
    refused(lambda: read_table(tmp_path / "folder.csv"), "a folder")
    refused(lambda: read_table(tmp_path / "data.xlsx"), ".csv or .parquet", "'.xlsx'")


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError("disk full")])
@pytest.mark.parametrize("name", ["out.csv", "out.parquet"])
def test_interrupted_writing_leaves_what_was_there(tmp_path, monkeypatch, name, error):
    (tmp_path / name).write_text("before")

    def stop(*_):
        assert len(list(tmp_path.iterdir())) == 2  # written in full beside the old file
        raise error

    monkeypatch.setattr(os, "replace", stop)
    with pytest.raises(type(error) if isinstance(error, OSError) else error):
        write_table(COLUMNS, tmp_path / name)
    assert [p.name for p in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "before"


def test_error_between_rows_leaves_nothing(tmp_path, monkeypatch):
    format_cells = heliograph.files.tables.table_writer._format_cells

    def breaks_at_the_end(column):
        if column[-1] == 99_999:
            assert [path.stat().st_size > 0 for path in tmp_path.iterdir()] == [True]  # rows are in a partial file
            raise RuntimeError("between rows")
        return format_cells(column)

    monkeypatch.setattr("heliograph.files.tables.table_writer._format_cells", breaks_at_the_end)
    with pytest.raises(RuntimeError, match="between rows"):
        write_table({"time": np.arange(100_000.0)}, tmp_path / "out.csv")
    assert not list(tmp_path.iterdir())


def test_columns_of_unlike_lengths_write_nothing(tmp_path):
    ragged = {"time": np.arange(3.0), "a": np.arange(2.0)}
    with pytest.raises(ValueError, match="all of one length"):
        write_table(ragged, tmp_path / "out.csv")
    assert not list(tmp_path.iterdir())


def test_permissions_are_those_of_any_new_file(tmp_path):
    write_table(COLUMNS, tmp_path / "out.csv")
    (tmp_path / "plain").touch()
    assert (tmp_path / "out.csv").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_places_that_cannot_be_written(tmp_path):
    (tmp_path / "file").touch()
    refused(lambda: check_writable(tmp_path / "file" / "out.csv"), "output folder", "file", "a folder")
    refused(lambda: check_writable(tmp_path / "no" / "out.csv"), "existing folder", "nothing of that name")
    (tmp_path / "out.csv").mkdir()
    refused(lambda: check_writable(tmp_path / "out.csv"), "output file", "a folder")
    refused(lambda: check_folder_writable(tmp_path / "file"), "output folder", "a file")
    refused(lambda: check_folder_writable(tmp_path / "file" / "new"), "output folder", "on its path")
    check_folder_writable(tmp_path / "new" / "newer")
    assert not (tmp_path / "new").exists()
    check_writable(tmp_path / "fine.parquet")
    assert not (tmp_path / "fine.parquet").exists()


def test_a_folder_without_permission(tmp_path, monkeypatch):
    def deny(**_):  # the system's own refusal does not bind a superuser
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.TemporaryFile", deny)
    refused(lambda: check_writable(tmp_path / "out.csv"), str(tmp_path), "can be written", "Permission denied")


def test_estimates_are_readable_by_others(tmp_path):
    write_table(COLUMNS, tmp_path / "out.csv")
    with (tmp_path / "out.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert float(rows[0]["a"]) == 1 / 3


def test_a_full_disk_names_the_file(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("heliograph.files.tables.table_writer._write_csv_rows", full)
    with pytest.raises(OSError, match="No space left on device") as caught:
        write_table(COLUMNS, tmp_path / "out.csv")
    assert caught.value.filename == str(tmp_path / "out.csv") and not list(tmp_path.iterdir())


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device that is always full")
def test_a_disk_that_is_really_full(tmp_path):
    columns = {"a": np.arange(1e5)}
    with pytest.raises(OSError, match="No space left on device") as caught:
        (tmp_path / ".out.csv.partial").symlink_to("/dev/full")
        with name_path_in_errors(tmp_path / "out.csv"), (tmp_path / ".out.csv.partial").open("w") as file:
            file.writelines(f"{v}\n" for v in columns["a"])
    assert caught.value.filename == str(tmp_path / "out.csv")


def test_a_header_is_no_formula_in_a_spreadsheet_and_is_read_as_it_was(tmp_path):
    write_table({"=cmd|'!A0": np.ones(1), "-x": np.ones(1)}, tmp_path / "t.csv")
    assert (tmp_path / "t.csv").read_text().startswith("'=cmd|'!A0,'-x")
    assert list(read_table(tmp_path / "t.csv")) == ["=cmd|'!A0", "-x"]


def test_a_table_of_numbers_alone_reads_as_row_by_row(tmp_path):
    """A column of "nan" beside it makes a table one that is read cell by cell."""
    rng = np.random.default_rng(2)
    cells = ["1", "-2.5", "", "1e3", "3E-2", "0.1", "-0", ".5", "007", "1e-400", "9007199254740993"]
    for _ in range(60):
        drawn = [",".join(rng.choice(cells[: rng.integers(6, 12)], size=2)) for _ in range(4)]
        lines, end = [line for line in ["1,2", *drawn] if line != ","], rng.choice(["", "\n", "\r\n"])
        plain = text_file(tmp_path, "a,b\r\n" + "\r\n".join(lines) + end, "plain.csv")
        beside = text_file(tmp_path, "a,b,c\n" + "".join(f"{line},nan\n" for line in lines), "beside.csv")
        one, other = read_table(plain), read_table(beside)
        for name in ("a", "b"):
            assert one[name].dtype == other[name].dtype
            assert one[name].tobytes() == other[name].tobytes()


@pytest.mark.parametrize(
    "header", ['"a","b"', '"a",b', '"a\n","b"', '"a ""b""",b'], ids=["both", "one", "line", "quotes"]
)
def test_names_in_quotes_stand_above_a_table_of_numbers_alone(tmp_path, header):
    """As pyarrow writes them; a name of two lines is for the reader of rows."""
    lines = "\n".join(["1,2", "3,", ",4"])
    plain = read_table(text_file(tmp_path, f"{header}\n{lines}\n", "plain.csv"))
    beside = read_table(text_file(tmp_path, f"{header}\n{lines}\n".replace("3,", '"3",'), "beside.csv"))
    assert list(plain) == list(beside)
    for name, values in plain.items():
        assert values.tobytes() == beside[name].tobytes()


@pytest.mark.parametrize("row", ["1", "1,2,3", "1,x", "1,1-2", '1,"2', "# 1,2"])
def test_a_row_of_a_table_of_numbers_that_is_none_is_named(tmp_path, row):
    with pytest.raises(ValueError, match="row 2"):
        read_table(text_file(tmp_path, f"a,b\n1,2\n{row}\n3,4\n"))
