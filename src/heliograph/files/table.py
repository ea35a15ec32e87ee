"""Tables in files: columns of numbers in CSV or Parquet; the file extension selects the format."""

import csv
import os
import re
from collections.abc import Container, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from heliograph.disk.quoting import quote_for_cell, unquote_cell
from heliograph.disk.whole_file import FORMATS, check_writable, format_of, whole_file
from heliograph.files.text.csv_text import CsvRow, parse_cell, read_csv_rows
from heliograph.files.text.dialects import NO_VALUE, check_distinct
from heliograph.files.text.plain_numbers import read_plain_numbers
from heliograph.files.text.text_file import kind_of, yield_until_cut_off
from heliograph.numerics.check import InputError, fail, file_path, show_value, table
from heliograph.numerics.masked import fill_masked, is_absent
from heliograph.numerics.process.plugins import FORMATS as FORMATS_OF_OTHERS
from heliograph.numerics.process.plugins import find_plugin
from heliograph.numerics.times.dates import MISSING as NAT
from heliograph.numerics.times.dates import format_dates, looks_like_date, parse_dates, parse_moment
from heliograph.numerics.types import Shaped

TIME = "time"
EXACT = 2**53  # up to here doubles hold every whole number
WITH_EXPONENT = 1e-5, 1e-4  # sizes of numbers that Python writes with an exponent, and JSON without
LARGE = 1e16  # size from which on Python writes a sign before the exponent
WHOLE = re.compile(r"[+-]?\d{1,18}|[+-]?[1-8]\d{18}")  # numbers that 64 bits hold
BLOCK = 4096  # rows whose cells are in memory as texts at a time


class Rows(NamedTuple):
    """Rows of a table that could be read, as columns; their numbers, from 1; and why others could not be read."""

    columns: dict[str, np.ndarray]
    numbers: np.ndarray
    refused: list[InputError]


def columns_of(table: object, name: str = "table", only: Container[str] | None = None) -> dict[str, np.ndarray]:
    """Return columns by name, missing values NaN or NaT: numbers as float64, dates as datetime64[ns] in UTC.

    Whole numbers that float64 cannot tell apart stay int64. Columns that are not among `only` are left out unread.
    """
    if isinstance(table, str | os.PathLike):
        return read_rows(Path(table), only, strict=True).columns
    if isinstance(table, Mapping):
        named = dict(table)
    elif hasattr(table, "columns") and hasattr(table, "__getitem__"):
        frame: Any = table
        index = getattr(frame, "index", None)
        header = list(getattr(frame, "column_names", frame.columns))  # of pyarrow, whose columns are arrays
        check_distinct(name, header)
        named = {TIME: index} if getattr(index, "name", None) == TIME and TIME not in header else {}
        named |= {column: frame[column] for column in header}
    else:
        raise fail(name, "a file, a DataFrame, or a dictionary of columns", show_value(table))
    for column in named:
        if not isinstance(column, str):
            raise fail(f"{name}, columns", "names that are text", show_value(column))
    kept = {column: values for column, values in named.items() if only is None or column in only}
    return {column: _convert_column(values, f"{name}, column {column!r}") for column, values in kept.items()}


def _convert_column(values: Any, name: str) -> np.ndarray:
    """Return one column as numbers or dates; what its own kind marks as missing becomes NaN or NaT."""
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
    # Converted back, what overflowed or lost a part of a nanosecond is another date.
    wrong = ~np.isnat(column) & (moments.astype(column.dtype) != column)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise fail(f"{name}, row {row + 1}", "a date in whole nanoseconds, from 1678 to 2261", column[row])
    return np.asarray(moments)


def _convert_objects(column: np.ndarray, name: str) -> np.ndarray:
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
        if texts:
            raise TypeError
        return np.array([np.nan if value is None else float(value) for value in column])
    except (TypeError, ValueError, OverflowError):
        got = str(texts[0]) if texts and isinstance(texts[0], str) else first
        raise fail(name, "numbers or dates", show_value(got)) from None


def read_table(path: str | Path) -> dict[str, Shaped[np.ndarray, " rows"]]:
    """Read the columns of a CSV or Parquet file as float64; an empty cell is NaN.

    A column whose first cell is a date of ISO 8601, as 2026-11-21T23:25:00+01:00, is read as dates: datetime64[ns] in
    UTC. Dates without a time zone are not converted.

    Args:
        path: the file, ending in .csv or .parquet, or in the name of an entry point of the group `heliograph.formats`,
            which is called with the path and returns columns.

    Returns:
        Columns by name, each of shape (rows,).

    Raises:
        ValueError: no such file, an empty one, another format, no rows, duplicated columns, a cell that is no number.
            Rows count from 1.
        ModuleNotFoundError: Parquet without pyarrow (extra "tables").
    """
    return read_rows(file_path("table", path), None, strict=True).columns


def read_rows(path: Path, only: Container[str] | None, strict: bool) -> Rows:
    """Read the rows of a file, or those of its columns that are among `only`.

    Raises:
        ValueError: what `read_table` refuses; where reading is not strict, a row alone is none of that.
    """
    plugin = None if kind_of(path) in FORMATS else find_plugin(FORMATS_OF_OTHERS, path.suffix.lower().removeprefix("."))
    kind = kind_of(path) if plugin is not None or kind_of(path) in FORMATS else format_of(path)
    if not path.is_file():
        raise fail(str(path), "a file", "a folder" if path.is_dir() else "nothing of that name")
    if path.stat().st_size == 0:
        raise fail(str(path), "a table with a header and rows", "an empty file")
    if plugin is not None:
        columns = columns_of(plugin(path), str(path), only)
        rows = Rows(columns, np.arange(1, len(next(iter(columns.values()), ())) + 1), [])
    else:
        rows = _read_csv(path, only, strict) if kind == ".csv" else _read_parquet(path, only)
    if not len(rows.numbers):
        raise rows.refused[0] if rows.refused else fail(str(path), "at least one row", "none")
    return rows


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
    check_writable(path)
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


class CsvColumnReader:
    """Reads rows of CSV as columns, a part of a table at a time; a column is of dates if its first cell is one.

    Args:
        source: the name of the table, for errors.
        path: the file, if it can be read again.
        only: the columns that are read; None for all.
        strict: whether what cannot be read is an error, or is refused alone.
    """

    def __init__(self, source: str, path: Path | None, only: Container[str] | None, strict: bool):
        self.source, self.path, self._only, self._strict = source, path, only, strict
        self.header: list[str] = []
        self._dated = dict[str, bool]()  # by column whether it is of dates, once a cell has said so
        self._zoned = dict[str, bool]()  # whether these have a zone

    def read(self, rows: Iterable[CsvRow | InputError]) -> "Rows":
        """Return the rows that can be read, as columns; why the others cannot.

        Raises:
            ValueError: another header than before; where reading is strict, a row that cannot be read.
        """
        refused, numbers = list[InputError](), list[int]()
        texts, values = list[list[str]](), list[list[float | int]]()
        for row in rows:
            try:
                if isinstance(row, InputError):
                    raise row
                self._check_header(row)
                values.append(self._read_numbers(row))
            except InputError as error:
                if self._strict:
                    raise
                refused.append(error)
            else:
                numbers.append(row.number)
                texts.append(row.cells)
        columns = dict[str, np.ndarray]()
        for i, name in enumerate(self.header):
            if self._only is None or name in self._only:
                columns[name] = self._make_column(name, [row[i] for row in values], [cells[i] for cells in texts])
        return Rows(columns, np.array(numbers, dtype=np.int64), refused)

    def _check_header(self, row: CsvRow) -> None:
        """Raise if a row stands under another header than the rows before it."""
        if not self.header:
            self.header = row.header
        if row.header != self.header:
            raise fail(row.where, f"the columns {', '.join(self.header)}", ", ".join(row.header))

    def _read_numbers(self, row: CsvRow) -> list[float | int]:
        """Return the number of each cell, nanoseconds of dates, NaN or NAT of empty ones and of columns not read.

        The first cell of a column that is not empty says whether all are dates; of a row that is refused none does.
        """
        newly_dated = dict[str, bool]()
        numbers: list[float | int] = []
        for name, cell in zip(row.header, row.cells, strict=True):
            if self._only is not None and name not in self._only:
                numbers.append(np.nan)
                continue
            dated = self._dated.get(name)  # None: not known yet
            if (looks_like_date(cell) if dated is None else dated) and not self._is_missing(cell):
                numbers.append(self._read_moment(row, name, cell))
                newly_dated[name] = True
            elif dated:
                numbers.append(NAT)
            else:
                numbers.append(parse_cell(row.where, name, cell, self.path))
                if cell:
                    newly_dated[name] = False
        self._dated |= newly_dated
        return numbers

    @staticmethod
    def _is_missing(cell: str) -> bool:
        """Return whether a cell is empty, or says that there is no value."""
        return not cell or NO_VALUE.fullmatch(cell) is not None

    def _read_moment(self, row: CsvRow, name: str, cell: str) -> int:
        """Return a date as nanoseconds; raise where dates of one column differ in having a zone."""
        where = f"{row.where}, column {name!r}"
        moment, zoned = parse_moment(cell, where)
        if self._zoned.setdefault(name, zoned) != zoned:
            raise fail(where, "a zone with every date or with none", show_value(cell))
        return moment

    def _make_column(self, name: str, values: list[float | int], cells: list[str]) -> np.ndarray:
        """Return a column as dates, or as int64 if its cells are whole numbers that doubles cannot tell apart."""
        if self._dated.get(name):
            whole = [NAT if value != value else int(value) for value in values]  # before the first date all are empty
            return np.array(whole, dtype=np.int64).view("datetime64[ns]")
        numbers = np.array(values, dtype=np.float64)
        if np.any(np.abs(numbers) >= EXACT) and all(map(WHOLE.fullmatch, cells)):
            return np.array([int(cell) for cell in cells], dtype=np.int64)
        return numbers


def _read_csv(path: Path, only: Container[str] | None, strict: bool) -> "Rows":
    """Return rows of a CSV file: of plain numbers all at once, else cell by cell, which names what is wrong."""
    plain = read_plain_numbers(path)
    if plain is not None and np.nanmax(np.abs(plain[1]), initial=0.0) < EXACT:
        header, numbers = plain
        named = {name: numbers[:, i].copy() for i, name in enumerate(header) if only is None or name in only}
        return Rows(named, np.arange(1, len(numbers) + 1), [])
    columns = CsvColumnReader(str(path), path, only, strict)
    rows = read_csv_rows(path, marked=False)
    return columns.read(rows if strict else yield_until_cut_off(rows))


def _read_parquet(path: Path, only: Container[str] | None) -> Rows:
    """Return the rows of a Parquet file: numbers, NaN where null, and dates in nanoseconds."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    # The whole table; names must be distinct.
    try:
        table = pq.ParquetFile(path).read()
    except pa.ArrowInvalid as error:
        raise fail(str(path), "a Parquet file", str(error).splitlines()[0]) from None
    check_distinct(path, table.column_names)
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
    return Rows(columns, np.arange(1, table.num_rows + 1), [])


def _write_csv(columns: Mapping[str, np.ndarray], path: Path) -> None:
    """Write columns as CSV, a block of rows at a time."""
    with path.open("x", newline="", encoding="utf-8") as file:
        check_distinct(f"columns of {path}", [read_back_name(name) for name in columns])
        csv.writer(file).writerow(map(quote_for_cell, columns))
        for start in range(0, len(next(iter(columns.values()))), BLOCK):
            cells = [_format_cells(column[start : start + BLOCK]) for column in columns.values()]  # they need no quotes
            file.writelines(f"{','.join(row)}\r\n" for row in zip(*cells, strict=True))


def _format_cells(column: np.ndarray) -> list[str]:
    """Write each value as Python does, a float with all digits that it takes to read it back.

    Floats are written as JSON, in a tenth of the time and with the same digits, and made what Python writes where the
    two differ: in exponents of one digit, where only one of them has an exponent at all, of NaN and of infinity.
    """
    if column.dtype.kind != "f":
        return list(map(str, _plain(column).tolist()))
    values, size = column.tolist(), np.abs(column.astype(np.float64))
    text = msgspec.json.encode(values).decode().replace("]", ",")
    for digit in "6789":  # of an exponent Python writes two digits
        text = text.replace(f"e-{digit},", f"e-0{digit},")
    # JSON and Python write these differently: numbers in a range of exponents, large ones, NaN (`~ <`) and infinity.
    differs = ((size >= WITH_EXPONENT[0]) & (size < WITH_EXPONENT[1])) | ~(size < LARGE)
    texts = text[1:-1].split(",")
    for row in np.flatnonzero(differs).tolist():
        texts[row] = repr(values[row])
    return texts


def read_back_name(name: str) -> str:
    """Return the name of a column as it reads from a CSV file to which it was written: in one line, without margins."""
    return unquote_cell(quote_for_cell(name).strip())


def _plain(column: np.ndarray) -> np.ndarray:
    """Return dates as texts, and true and false as 1 and 0; other numbers as they are."""
    if column.dtype.kind == "M":
        return format_dates(column)
    return column.astype(np.int64) if column.dtype == np.bool_ else column


def _write_parquet(columns: Mapping[str, np.ndarray], path: Path) -> None:
    """Write columns as Parquet, dates as nanoseconds of UTC."""

    import pyarrow as pa
    import pyarrow.parquet as pq

    arrays = {name: pa.array(np.ascontiguousarray(c)) for name, c in columns.items()}
    dated = {name: a.cast(pa.timestamp("ns", "UTC")) for name, a in arrays.items() if columns[name].dtype.kind == "M"}
    pq.write_table(pa.table(arrays | dated), path)
