"""Tables in files: columns of numbers in CSV or Parquet; the file extension selects the format."""

import os
from collections.abc import Container, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from heliograph.disk.atomic_files import FORMATS, format_of
from heliograph.files.tables.block_size import USUAL_BLOCK, BlockSize
from heliograph.files.tables.csv_columns import read_csv_blocks
from heliograph.files.tables.parquet_columns import convert_integers_of_arrow, read_parquet_blocks
from heliograph.files.tables.table_rows import (
    EXACT,
    TableRows,
    convert_to_doubles,
    convert_to_nanoseconds,
    convert_to_numbers,
    find_missing,
    join_rows,
)
from heliograph.files.tables.table_writer import open_table
from heliograph.files.text.csv_dialects import check_distinct
from heliograph.files.text.text_file import Progress, find_extension
from heliograph.numerics.check import fail, file_path, show_value, table
from heliograph.numerics.masked_arrays import fill_masked, is_absent
from heliograph.numerics.process.plugins import FORMATS as FORMATS_OF_OTHERS
from heliograph.numerics.process.plugins import find_plugin
from heliograph.numerics.times.dates import looks_like_date, parse_dates
from heliograph.numerics.types import Shaped

TIME = "time"


def convert_to_columns(table: object, name: str = "table", only: Container[str] | None = None) -> dict[str, np.ndarray]:
    """Return columns by name, missing values NaN or NaT: numbers as float64, dates as datetime64[ns] in UTC.

    Whole numbers that float64 cannot tell apart stay int64, missing ones MISSING.

    Args:
        table: path of a CSV or Parquet file, a DataFrame (of pandas, polars or pyarrow), or columns by name.
        name: name of a table without a file, for errors.
        only: names of the columns to read; others are left out unread. None for all.
    """
    # A file's columns are read; those of other tables are collected by name.
    if isinstance(table, str | os.PathLike):
        return read_rows(Path(table), only, strict=True).columns
    if isinstance(table, Mapping):
        named = dict(table)
    elif hasattr(table, "columns") and hasattr(table, "__getitem__"):
        frame: Any = table
        index = getattr(frame, "index", None)
        header = list(getattr(frame, "column_names", frame.columns))  # of pyarrow, whose columns are arrays
        check_distinct(name, header)
        # Times may be the index of a DataFrame, where it is called so.
        named = {TIME: index} if getattr(index, "name", None) == TIME and TIME not in header else {}
        named |= {column: frame[column] for column in header}
    else:
        raise fail(name, "a file, a DataFrame, or a dictionary of columns", show_value(table))
    for column in named:
        if not isinstance(column, str):
            raise fail(f"{name}, columns", "names that are text", show_value(column))
    # Wanted columns as arrays, all of one length.
    kept = {column: values for column, values in named.items() if only is None or column in only}
    _check_indexes(name, kept)
    columns = {column: _convert_column(values, f"{name}, column {column!r}") for column, values in kept.items()}
    lengths = {column: len(values) for column, values in columns.items()}
    if len(set(lengths.values())) > 1:
        raise fail(f"{name}, columns", "as many rows in each", lengths)
    return columns


def _check_indexes(name: str, columns: Mapping[str, Any]) -> None:
    """Raise ValueError if columns of pandas have unequal indexes: by position their rows would not belong together."""
    indexed = [(column, values.index) for column, values in columns.items() if _has_index(values)]
    for column, index in indexed[1:]:
        first, expected = indexed[0]
        if not index.equals(expected):
            rows = f"rows with the index of column {first!r} (a DataFrame of both aligns them)"
            raise fail(f"{name}, column {column!r}", rows, show_value(index))


def _has_index(values: object) -> bool:
    """Return whether a column has an index as those of pandas do; the `index` of a list is a function."""
    return hasattr(getattr(values, "index", None), "equals")


def _convert_column(values: Any, name: str) -> np.ndarray:
    """Return one column as numbers or dates; what its own kind marks as missing becomes NaN or NaT.

    Tables may be pandas, Arrow, NumPy or plain lists; each kind marks missing values in its own way. Whole numbers keep
    all digits, also those that doubles do not have. `name`: of the column, for errors. In the type codes of NumPy, M is
    a date, f i u b are numbers and O U T objects and texts.
    """
    numbers = _convert_masked_numbers(values)
    if numbers is not None:
        return numbers
    # Convert by the type of the array: dates, numbers, or objects one by one.
    column = _make_array(values)
    if column.ndim != 1:
        raise fail(name, "one number or date in each row", f"shape {column.shape}")
    if column.dtype.kind == "M":
        return convert_to_nanoseconds(column, name)
    if column.dtype.kind in "fiub":
        return convert_to_numbers(column)
    if column.dtype.kind in "OUT":
        return _convert_object_column(column, name)
    raise fail(name, "numbers or dates", f"{column.dtype}")


def _convert_masked_numbers(values: Any) -> np.ndarray | None:
    """Return the numbers of a column that has a mask of missing values beside them; None for any other column.

    Such are numbers of pandas, integers of Arrow and masked integers of NumPy. Missing numbers become NaN (MISSING in a
    column of int64).
    """
    if hasattr(values, "isna") and values.dtype.kind in "iufb":  # pandas
        kind = {"i": np.int64, "u": np.uint64, "b": np.bool_}.get(values.dtype.kind, np.float64)
        absent = np.asarray(values.isna(), dtype=bool)
        return convert_to_numbers(values.to_numpy(dtype=kind, na_value=kind(0)), absent)
    if hasattr(values, "null_count") and hasattr(values, "chunks") and str(values.type).startswith(("int", "uint")):
        return convert_integers_of_arrow(values)
    if isinstance(values, np.ma.MaskedArray) and values.dtype.kind in "iu":
        return convert_to_numbers(np.asarray(values), np.ma.getmaskarray(values))
    return None


def _make_array(values: Any) -> np.ndarray:
    """Return a column as a NumPy array; of objects if it is a list with integers that doubles cannot hold.

    Doubles hold integers up to EXACT, 2^53.
    """
    if hasattr(values, "to_numpy"):
        return np.asarray(values.to_numpy())
    if type(values) is np.ndarray and values.dtype.kind == "O":
        return values
    column = np.asarray(fill_masked(values))
    is_list_of_floats = isinstance(values, list | tuple) and column.dtype.kind == "f"
    if is_list_of_floats and np.nanmax(np.abs(column), initial=0) >= EXACT:
        return np.array(values, dtype=object)
    return column


def _convert_object_column(column: np.ndarray, name: str) -> np.ndarray:
    """Return a column of objects as numbers, NaN for None, or as dates; the first value says which.

    Text is no number, though it may read as one.
    """
    column = np.array([None if is_absent(value) else value for value in column], dtype=object)
    first = next((value for value in column if value is not None), None)
    if hasattr(first, "to_timestamp"):  # a period of pandas: its first moment
        return parse_dates([None if value is None else value.to_timestamp() for value in column], name)
    if (isinstance(first, str) and looks_like_date(first)) or hasattr(first, "isoformat"):
        return parse_dates(column, name)
    texts = [x for x in column if isinstance(x, str | bytes)]
    try:
        if texts:  # a text is an error, although `float` would accept some
            raise TypeError
        absent = np.array([value is None for value in column], dtype=bool)
        numbers = [0.0 if value is None else value for value in column]
        doubles = np.array([float(value) for value in numbers])
        if np.all(np.isfinite(doubles)) and all(int(value) == value for value in numbers):
            return convert_to_numbers(np.array([int(value) for value in numbers]), absent)
        return np.where(absent, np.nan, doubles)
    except (TypeError, ValueError, OverflowError):
        got = str(texts[0]) if texts and isinstance(texts[0], str) else first
        raise fail(name, "numbers or dates", show_value(got)) from None


def read_table(path: str | Path) -> dict[str, Shaped[np.ndarray, " rows"]]:
    """Read the columns of a CSV or Parquet file as float64; an empty cell is NaN, and true and false are 1 and 0.

    A column whose first cell is a date of ISO 8601, as 2026-11-21T23:25:00+01:00, is read as dates: datetime64[ns] in
    UTC. Dates without a time zone are not converted.

    Args:
        path: the file, ending in .csv or .parquet, or in the name of an entry point of the group `heliograph.formats`,
            which is called with the path and returns columns.

    Returns:
        Columns by name, each of shape (rows,).

    Raises:
        ValueError: the file is missing or empty, has another format or no rows, has two columns of one name, or a cell
            is no number. Errors number rows from 1.
        ModuleNotFoundError: Parquet without pyarrow (extra "tables").
    """
    columns = read_rows(file_path("table", path), only=None, strict=True).columns
    # int64 has no NaN: a column of integers in which one is missing becomes float64, with NaN.
    return {
        name: convert_to_doubles(column) if column.dtype.kind == "i" and np.any(find_missing(column)) else column
        for name, column in columns.items()
    }


def read_rows(path: Path, only: Container[str] | None, strict: bool) -> TableRows:
    """Return the rows of a file, of all columns or of those among `only`.

    Raises:
        ValueError: `read_table` would refuse the file; unless `strict`, a bad row alone is no reason.
    """
    rows = join_rows(read_row_blocks(path, only, strict))
    if not len(rows.numbers):
        raise rows.refused[0] if rows.refused else fail(str(path), "at least one row", "none")
    return rows


def read_row_blocks(
    path: Path,
    only: Container[str] | None,
    strict: bool,
    block: BlockSize = USUAL_BLOCK,
    progress: Progress | None = None,
) -> Iterator[TableRows]:
    """Yield the rows of a file in parts, with only the columns that are named in `only`.

    Parts bound the memory that a long file needs. The extension of its name says how the file is read: as CSV, as
    Parquet, or by a package that offers this extension.

    Args:
        path: the file.
        only: the columns that are read; None for all.
        strict: whether a row that cannot be read is an error, or is refused alone.
        block: how much is read at a time; a format that another package reads is read as a whole.
        progress: called with how much of the file is read, and of how much (default none).

    Raises:
        ValueError: what `read_table` refuses, but for a table without rows.
    """
    # CSV and Parquet (`kind`), or a format that another installed package reads; `format_of` raises for any other.
    kind, plugin = find_extension(path), None
    if kind not in FORMATS:
        plugin = find_plugin(FORMATS_OF_OTHERS, path.suffix.lower().removeprefix("."))
        if plugin is None:
            kind = format_of(path)
    if not path.is_file():
        raise fail(str(path), "a file", "a folder" if path.is_dir() else "nothing of that name")
    if path.stat().st_size == 0:
        raise fail(str(path), "a table with a header and rows", "an empty file")
    if plugin is not None:
        columns = convert_to_columns(plugin(path), str(path), only)
        yield TableRows(columns, np.arange(1, len(next(iter(columns.values()), ())) + 1), [])
    elif kind == ".csv":
        yield from read_csv_blocks(path, only, strict, block.bytes, progress)
    else:
        yield from read_parquet_blocks(path, only, block.rows, progress)


def write_table(columns: Mapping[str, Shaped[np.ndarray, "..."]], path: str | Path) -> None:
    """Write columns of equal length to a CSV or Parquet file; the file appears as a whole or not at all.

    Args:
        columns: arrays by name, each of shape (rows,), of numbers, booleans or dates.
        path: the file, ending in .csv or .parquet.

    Raises:
        ValueError: another format, columns that are not arrays of one axis and length, or a folder that cannot be
            written.
        ModuleNotFoundError: Parquet without pyarrow (extra "tables").
    """
    path = file_path("table", path)
    _check_columns(columns)
    with open_table(path) as append:
        append(columns)


def _check_columns(columns: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError unless all columns are arrays of one axis and one length."""
    for name, column in table("columns of a table", columns, "arrays").items():
        if not isinstance(column, np.ndarray) or column.ndim != 1 or column.dtype.kind not in "fiubM":
            raise fail(f"column {name!r}", "an array of numbers or dates", show_value(column))
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) != 1:
        raise fail("columns of a table", "at least one, all of one length", lengths)
