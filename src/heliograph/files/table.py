"""Tables in files: columns of numbers in CSV or Parquet; the file extension selects the format."""

import csv
import gzip
import os
import re
from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import msgspec
import numpy as np

from heliograph.disk.quoting import quote_for_cell, unquote_cell
from heliograph.disk.whole_file import FORMATS, check_output, format_of, whole_file
from heliograph.numerics.check import InputError, fail, file_path, show_value, table
from heliograph.numerics.masked import fill_masked, is_absent
from heliograph.numerics.times.dates import dates, format_dates, looks_like_date
from heliograph.numerics.types import Shaped

TIME = "time"
PACKED = ".gz"
EXACT = 2**53  # up to here doubles hold every whole number
WITH_EXPONENT = 1e-5, 1e-4  # sizes of numbers that Python writes with an exponent, and JSON without
LARGE = 1e16  # size from which on Python writes a sign before the exponent
BLOCK = 4096  # rows whose cells are in memory as texts at a time


def columns_of(table: object, name: str = "table", only: Container[str] | None = None) -> dict[str, np.ndarray]:
    """Return columns by name, missing values NaN or NaT: numbers as float64, dates as datetime64[ns] in UTC.

    Whole numbers that float64 cannot tell apart stay int64. Columns that are not among `only` are left out unread.
    """
    if isinstance(table, str | os.PathLike):
        return _read_table(Path(table), only)
    if isinstance(table, Mapping):
        named = dict(table)
    elif hasattr(table, "columns") and hasattr(table, "__getitem__"):
        frame: Any = table
        index = getattr(frame, "index", None)
        header = list(getattr(frame, "column_names", frame.columns))  # of pyarrow, whose columns are arrays
        _check_distinct(name, header)
        named = {TIME: index} if getattr(index, "name", None) == TIME and TIME not in header else {}
        named |= {column: frame[column] for column in header}
    else:
        raise fail(name, "a file, a DataFrame, or a dictionary of columns", show_value(table))
    for column in [column for column in named if not isinstance(column, str)]:
        raise fail(f"{name}, columns", "names that are text", show_value(column))
    kept = {column: values for column, values in named.items() if only is None or column in only}
    return {column: _convert_column(values, f"{name}, column {column!r}") for column, values in kept.items()}


def _convert_column(values: Any, name: str) -> np.ndarray:
    """Convert one column, which may have a missing value other than NaN."""
    missing = values.isna() if hasattr(values, "isna") else None
    if missing is not None and values.dtype.kind in "iufb":  # pandas's own kinds of number have a mask
        return np.asarray(values.to_numpy(dtype=np.float64, na_value=np.nan))
    column = values.to_numpy() if hasattr(values, "to_numpy") else np.asarray(fill_masked(values))
    if column.dtype.kind == "M":
        return convert_to_nanoseconds(column, name)
    if column.dtype.kind in "fiub":
        return numbers_of(column)
    if column.dtype.kind in "OUT":
        return _convert_objects(column, name)
    raise fail(name, "numbers or dates", f"{column.dtype}")


def numbers_of(column: np.ndarray) -> np.ndarray:
    """Return numbers as float64, or as int64 where that alone tells them apart."""
    whole = column.dtype.kind in "iu" and column.size and np.abs(column.astype(np.float64)).max() >= EXACT
    return np.asarray(column, dtype=np.int64 if whole and column.dtype != np.uint64 else np.float64)


def convert_to_nanoseconds(column: np.ndarray, name: str) -> np.ndarray:
    """Return dates as datetime64[ns].

    Raises:
        ValueError: a date that 64 bits of nanoseconds cannot say, or a part of a nanosecond; one line with its row.
    """
    moments = column.astype("datetime64[ns]")
    # There and back: what wraps or is cut is another date then.
    wrong = ~np.isnat(column) & (moments.astype(column.dtype) != column)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise fail(f"{name}, row {row + 1}", "a date in whole nanoseconds, from 1678 to 2261", column[row])
    return np.asarray(moments)


def _convert_objects(column: np.ndarray, name: str) -> np.ndarray:
    """Convert numbers with None among them, or dates; refuse text, even if it reads as a number."""
    column = np.array([None if is_absent(value) else value for value in column], dtype=object)
    some = next((value for value in column if value is not None), None)
    if hasattr(some, "to_timestamp"):  # a period of pandas: its first moment
        return dates([None if value is None else value.to_timestamp() for value in column], name)
    if (isinstance(some, str) and looks_like_date(some)) or hasattr(some, "isoformat"):
        return dates(column, name)
    texts = [x for x in column if isinstance(x, str | bytes)]  # text is no number, though it may read as one
    try:
        if texts:
            raise TypeError
        return np.array([np.nan if value is None else float(value) for value in column])
    except (TypeError, ValueError, OverflowError):
        came = str(texts[0]) if texts and isinstance(texts[0], str) else some
        raise fail(name, "numbers or dates", show_value(came)) from None


SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars"}
COMMENTS = ("#", "%")
MISSING = ("na", "n/a", "null", "none", "nil", "-", "?")


def read_table(path: str | Path) -> dict[str, Shaped[np.ndarray, " rows"]]:
    """Read the columns of a CSV or Parquet file as float64; an empty cell is NaN.

    A column whose first cell is a date of ISO 8601, as 2026-11-21T23:25:00+01:00, is read as dates: datetime64[ns] in
    UTC. Dates without a time zone are not converted.

    Args:
        path: the file, ending in .csv or .parquet.

    Returns:
        Columns by name, each of shape (rows,).

    Raises:
        ValueError: no such file, an empty one, another format, no rows, duplicated columns, a cell that is no number.
            Rows count from 1.
        ModuleNotFoundError: Parquet without pyarrow (extra "tables").
    """
    return _read_table(file_path("table", path), None)


def _read_table(path: Path, only: Container[str] | None) -> dict[str, np.ndarray]:
    """Read the columns of a file, or those of them that are among `only`."""
    kind = kind_of(path) if kind_of(path) in FORMATS else format_of(path)
    if not path.is_file():
        raise fail(str(path), "a file", "a folder" if path.is_dir() else "nothing of that name")
    if path.stat().st_size == 0:
        raise fail(str(path), "a table with a header and rows", "an empty file")
    columns = _read_csv(path, only) if kind == ".csv" else _read_parquet(path, only)
    if not columns or not len(next(iter(columns.values()))):
        raise fail(str(path), "at least one row", "none")
    return columns


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
    check_output(path)
    with whole_file(path) as partial:
        (_write_csv if format_of(path) == ".csv" else _write_parquet)(columns, partial)


def _check_columns(columns: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError unless all columns are arrays of one axis and one length."""
    for name, column in table("columns of a table", columns, "arrays").items():
        if not isinstance(column, np.ndarray) or column.ndim != 1 or column.dtype.kind not in "fiubM":
            raise fail(f"column {name!r}", "an array of numbers or dates", show_value(column))
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) != 1:
        raise fail("columns of a table", "at least one, all of one length", lengths)


def _check_distinct(source: object, header: Sequence[object]) -> None:
    if twice := [name for name, count in Counter(header).items() if count > 1]:
        raise fail(f"{source}, header", "distinct columns", f"{twice[0]!r} more than once")


def kind_of(path: Path) -> str:
    """Return the extension of a file in small letters, without .gz where it is packed."""
    return (path.with_suffix("") if path.suffix.lower() == PACKED else path).suffix.lower()


@contextmanager
def open_text(path: Path) -> Iterator[TextIO]:
    """Open a file of text in UTF-8, packed or not; ValueError for what is none."""
    try:
        if path.suffix.lower() == PACKED:
            with gzip.open(path, "rt", newline="", encoding="utf-8-sig") as file:
                yield file
        else:
            with path.open(newline="", encoding="utf-8-sig") as file:
                yield file
    except (UnicodeDecodeError, gzip.BadGzipFile, EOFError) as error:
        raise fail(str(path), "a text in UTF-8", str(error)) from None


@contextmanager
def csv_lines(path: Path) -> Iterator[Iterator[list[str]]]:
    """Return the lines of a CSV file that are not empty; ValueError for text that is no CSV in UTF-8."""
    try:
        with open_text(path) as file:
            yield (line for line in csv.reader(file, strict=True) if line)
    except csv.Error as error:
        raise fail(str(path), "a CSV file in UTF-8", str(error)) from None


def read_csv_header(path: Path) -> list[str]:
    """Return the names of the columns of a CSV file; none of a file that is none."""
    try:
        with csv_lines(path) as lines:
            return [name.strip() for name in next(lines, [])]
    except InputError:
        return []


def _read_csv(path: Path, only: Container[str] | None) -> dict[str, np.ndarray]:
    """Read a table of CSV: numbers by column (NaN where a cell is empty), or dates where the first row has one."""
    # Cells as text; every row must have as many as the header.
    with csv_lines(path) as lines:
        header = [unquote_cell(name.strip()) for name in next(lines, [])]
        _check_header(path, header)
        rows = [_split_row(path, header, number, line) for number, line in enumerate(lines, 1)]
    if only is not None:
        kept = [i for i, name in enumerate(header) if name in only]
        header, rows = [header[i] for i in kept], [[cells[i] for i in kept] for cells in rows]
    # The first row decides which columns are dates; all others are numbers.
    dated = {i for i, cell in enumerate(rows[0] if rows else []) if looks_like_date(cell)}
    numbers = [
        [np.nan if i in dated else _parse_number(path, header[i], row, cell) for i, cell in enumerate(cells)]
        for row, cells in enumerate(rows, 1)
    ]
    values = np.array(numbers, dtype=np.float64).reshape(len(rows), len(header))
    columns = {name: _keep_exact(values[:, i].copy(), [cells[i] for cells in rows]) for i, name in enumerate(header)}
    return columns | {header[i]: dates((cells[i] for cells in rows), f"{path}, column {header[i]!r}") for i in dated}


def _keep_exact(values: np.ndarray, cells: Sequence[str]) -> np.ndarray:
    """Return a column as int64 if its cells are whole numbers that doubles cannot tell apart."""
    if not np.any(np.abs(values) >= EXACT) or not all(
        re.fullmatch(r"[+-]?\d{1,18}|[+-]?[1-8]\d{18}", c) for c in cells
    ):
        return values
    return np.array([int(cell) for cell in cells], dtype=np.int64)


def _split_row(path: Path, header: list[str], number: int, line: list[str]) -> list[str]:
    """Return the cells of a row; raise one line if it is a comment or has more or fewer than the header."""
    if line[0].lstrip().startswith("#"):
        remedy = _rewriting(path, comment="#")
        raise fail(f"{path}, row {number}", "numbers", f"a comment, {show_value(line[0])}: {remedy}")
    if len(line) != len(header):
        hint = ": numbers have a decimal point" if len(line) > len(header) else ""
        raise fail(f"{path}, row {number}", f"{len(header)} cells, one for each column", f"{len(line)}{hint}")
    return [cell.strip() for cell in line]


def _parse_number(path: Path, name: str, number: int, cell: str) -> float:
    """Return the number of a cell, NaN if it is empty; else raise one line that says how to write it."""
    try:
        if "_" in cell:  # Python's own way to write a number, and nobody else's
            raise ValueError
        return float(cell) if cell else np.nan
    except ValueError:
        hint = ""
        if re.fullmatch(r"[+-]?\d{1,3}(,\d{3})+(\.\d*)?", cell):
            hint = f": thousands have no comma: {_rewriting(path, thousands=',')}"
        elif re.fullmatch(r"[+-]?\d+,\d+", cell):
            hint = f": numbers have a decimal point: {_rewriting(path, decimal=',')}"
        if re.fullmatch(r"[-+.\de]+(?: +[-+.\de]+)+", cell):
            hint = ": several numbers: " + _rewriting(path, sep="\\s+")
        if cell.lower() in MISSING:
            hint = ": a cell is empty where nothing arrived"
        expected = "a number or an empty cell"
        raise fail(f"{path}, row {number}, column {name!r}", expected, f"{show_value(cell)}{hint}") from None


def _check_header(path: Path, header: Sequence[str]) -> None:
    """Raise one line if the header is a comment, has other separators, or a name twice."""
    line = ",".join(header)
    if line.startswith(COMMENTS):
        remedy = _suggest_without_comments(path)
        raise fail(f"{path}, header", "names of columns", f"a comment, {show_value(line)}: {remedy}")
    check_separators(path, header)
    _check_distinct(path, header)


def check_separators(path: Path, header: Sequence[str]) -> None:
    """Raise ValueError, with what rewrites the file, where the only column is several names with other separators."""
    line = ",".join(header)
    for mark, name in SEPARATORS.items() if len(header) == 1 else ():
        if mark in line:
            with open_text(path) as file:
                commas = re.search(r"\d,\d", file.read(10_000))
            remedy = _rewriting(path, sep=mark, decimal=",") if commas else _rewriting(path, sep=mark)
            raise fail(f"{path}, header", "names separated by commas", f"{name} in {show_value(line)}: {remedy}")


def _suggest_without_comments(path: Path) -> str:
    """Return the pandas call that converts a table whose first lines are comments, the last maybe its header."""
    with open_text(path) as file:
        lines = [line.strip() for line in file.read(100_000).splitlines() if line.strip()]
    comments = next((i for i, line in enumerate(lines) if not line.startswith(COMMENTS)), len(lines))
    following = lines[comments] if comments < len(lines) else "0"
    mark = next((mark for mark in (",", *SEPARATORS) if mark in following), r"\s+")
    first = re.split(mark if mark == r"\s+" else re.escape(mark), following)[0]
    sep = {} if mark == "," else {"sep": mark}
    if not re.match(r"[-+.\d]", first):  # names of their own
        return _rewriting(path, comment=lines[0][0], **sep)
    title = lines[comments - 1].lstrip("".join(COMMENTS) + " ")
    split = [part.strip() for part in re.split(mark if mark == r"\s+" else re.escape(mark), title) if part.strip()]
    return _rewriting(path, skiprows=comments, names=split, **sep)


def _rewriting(path: Path, **how: object) -> str:
    """Return the pandas call that converts a table written in another dialect."""
    given = "".join(f", {name}={value!r}" for name, value in how.items())
    return f"pandas.read_csv({str(path)!r}{given}).to_csv({str(path)!r}, index=False) rewrites it"


def _read_parquet(path: Path, only: Container[str] | None) -> dict[str, np.ndarray]:
    """Read a Parquet table: numbers by column (NaN where null), times in nanoseconds."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    # The whole table; names must be distinct.
    try:
        table = pq.ParquetFile(path).read()
    except pa.ArrowInvalid as error:
        raise fail(str(path), "a Parquet file", str(error).splitlines()[0]) from None
    _check_distinct(path, table.column_names)
    columns = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        if only is not None and name not in only:
            continue
        # Timestamps keep their nanoseconds; other temporal types and nested ones are refused.
        kind = column.type
        if pa.types.is_timestamp(kind):
            moments = np.array(column.cast(pa.timestamp(kind.unit)).to_numpy(), dtype=f"datetime64[{kind.unit}]")
            columns[name] = convert_to_nanoseconds(moments, f"{path}, column {name!r}")
            continue
        if pa.types.is_date(kind):
            columns[name] = convert_to_nanoseconds(column.cast(pa.date32()).to_numpy(), f"{path}, column {name!r}")
            continue
        if pa.types.is_integer(kind) and not column.null_count:
            columns[name] = numbers_of(column.to_numpy())
            continue
        if not ((pa.types.is_primitive(kind) and not pa.types.is_temporal(kind)) or pa.types.is_null(kind)):
            raise fail(f"{path}, row 1, column {name!r}", "numbers", f"{kind} {column[:1].to_pylist()}")
        columns[name] = np.array(column.cast(pa.float64(), safe=False).to_numpy(), dtype=np.float64)
    return columns


def _write_csv(columns: Mapping[str, np.ndarray], path: Path) -> None:
    with path.open("x", newline="", encoding="utf-8") as file:
        _check_distinct(f"columns of {path}", [read_back_name(name) for name in columns])
        csv.writer(file).writerow(map(quote_for_cell, columns))
        for start in range(0, len(next(iter(columns.values()))), BLOCK):
            cells = [_format_cells(column[start : start + BLOCK]) for column in columns.values()]  # they need no quotes
            file.writelines(f"{','.join(row)}\r\n" for row in zip(*cells, strict=True))


def _format_cells(column: np.ndarray) -> list[str]:
    """Write each value as Python does, a float with all digits that it takes to read it back.

    JSON has the same digits, and is written in a tenth of the time; what it says otherwise is written by Python.
    """
    if column.dtype.kind != "f":
        return list(map(str, _plain(column).tolist()))
    values, size = column.tolist(), np.abs(column.astype(np.float64))
    text = msgspec.json.encode(values).decode().replace("]", ",")
    for digit in "6789":  # of an exponent Python writes two digits
        text = text.replace(f"e-{digit},", f"e-0{digit},")
    otherwise = (size >= WITH_EXPONENT[0]) & (size < WITH_EXPONENT[1]) | ~(size < LARGE)
    texts = text[1:-1].split(",")
    for row in np.flatnonzero(otherwise).tolist():
        texts[row] = repr(values[row])
    return texts


def read_back_name(name: str) -> str:
    """Return the name of a column as it reads from a CSV file to which it was written: in one line, without margins."""
    return unquote_cell(quote_for_cell(name).strip())


def _plain(column: np.ndarray) -> np.ndarray:
    if column.dtype.kind == "M":
        return format_dates(column)
    return column.astype(np.int64) if column.dtype == np.bool_ else column  # true is 1 in a CSV file


def _write_parquet(columns: Mapping[str, np.ndarray], path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    arrays = {name: pa.array(np.ascontiguousarray(c)) for name, c in columns.items()}
    dated = {name: a.cast(pa.timestamp("ns", "UTC")) for name, a in arrays.items() if columns[name].dtype.kind == "M"}
    pq.write_table(pa.table(arrays | dated), path)
