"""Tables to CSV and Parquet, a block of rows after the other; the file appears as a whole or not at all."""

import csv
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import msgspec
import numpy as np

from heliograph.disk.atomic_files import check_writable, format_of, whole_file
from heliograph.disk.quoted_text import quote_for_cell, unquote_cell
from heliograph.files.text.csv_dialects import check_distinct
from heliograph.numerics.times.dates import format_dates

if TYPE_CHECKING:
    import pyarrow as pa

WITH_EXPONENT = 1e-5, 1e-4  # range of absolute values that Python writes with an exponent, and JSON without
LARGE = 1e16  # absolute value from which on Python writes a sign before the exponent
BLOCK = 4096  # rows whose cells are in memory as texts at a time

Append = Callable[[Mapping[str, np.ndarray]], None]  # called with columns by name, all of one length


@contextmanager
def open_table(path: Path) -> Iterator[Append]:
    """Open a CSV or Parquet file; yield a function that appends rows, which must have the same columns each time.

    The file appears once the context ends, and not at all after an error or interrupt.

    Raises:
        ValueError: another format, or a folder that cannot be written.
        ModuleNotFoundError: Parquet without pyarrow (extra "tables").
    """
    check_writable(path)
    open_file = _open_csv if format_of(path) == ".csv" else _open_parquet
    with whole_file(path) as partial, open_file(partial) as append:
        yield append


@contextmanager
def _open_csv(path: Path) -> Iterator[Append]:
    """Open a new CSV file; yield a function that appends rows."""
    with path.open("x", newline="", encoding="utf-8") as file:

        def append(columns: Mapping[str, np.ndarray]) -> None:
            """Append rows to `file`; while it is empty, the names of the columns are written first."""
            if not file.tell():
                check_distinct(f"columns of {path}", [predict_name_read_back(name) for name in columns])
                csv.writer(file).writerow(map(quote_for_cell, columns))
            _write_csv_rows(columns, file)

        yield append


@contextmanager
def _open_parquet(path: Path) -> Iterator[Append]:
    """Open a new Parquet file; yield a function that appends rows. Dates are stored as nanoseconds of UTC."""
    import pyarrow.parquet as pq

    writer: pq.ParquetWriter | None = None

    def append(columns: Mapping[str, np.ndarray]) -> None:
        """Append rows; the first call makes the file's `writer`, with the columns of these rows."""
        nonlocal writer
        rows = _make_arrow_table(columns)
        if writer is None:
            writer = pq.ParquetWriter(path, rows.schema)
        writer.write_table(rows)

    try:
        yield append
    finally:
        if writer is not None:
            writer.close()


def _make_arrow_table(columns: Mapping[str, np.ndarray]) -> "pa.Table":
    """Return columns as a table of Arrow, the form in which Parquet is written; dates are in UTC."""
    import pyarrow as pa

    arrays = {}
    for name, column in columns.items():
        array = pa.array(np.ascontiguousarray(column))
        arrays[name] = array.cast(pa.timestamp("ns", "UTC")) if column.dtype.kind == "M" else array
    return pa.table(arrays)


def _write_csv_rows(columns: Mapping[str, np.ndarray], file: TextIO) -> None:
    """Write rows as lines, BLOCK rows at a time, so that only one block's cells are in memory as texts."""
    for start in range(0, len(next(iter(columns.values()))), BLOCK):
        cells = [_format_cells(column[start : start + BLOCK]) for column in columns.values()]  # they need no quotes
        file.writelines(f"{','.join(row)}\r\n" for row in zip(*cells, strict=True))


def _format_cells(column: np.ndarray) -> list[str]:
    """Return the text of each value as Python writes it; a float has all digits that are needed to read it back.

    Floats are written by a JSON encoder, which takes a tenth of the time and gives the same digits. The text is
    corrected where Python writes it differently: exponents of one digit, numbers for which only one of the two uses an
    exponent, NaN and infinity. WITH_EXPONENT and LARGE are the absolute values between which, and from which on, the
    two differ.
    """
    if column.dtype.kind != "f":
        return list(map(str, _convert_to_plain(column).tolist()))
    values, size = column.tolist(), np.abs(column.astype(np.float64))
    # "[1.5,2.0]" as "[1.5,2.0,": each number is followed by a comma.
    text = msgspec.json.encode(values).decode().replace("]", ",")
    for digit in "6789":  # Python writes two digits of an exponent
        text = text.replace(f"e-{digit},", f"e-0{digit},")
    # JSON and Python write these differently: numbers in a range of exponents, large ones, NaN (`~ <`) and infinity.
    differs = ((size >= WITH_EXPONENT[0]) & (size < WITH_EXPONENT[1])) | ~(size < LARGE)
    texts = text[1:-1].split(",")
    for row in np.flatnonzero(differs).tolist():
        texts[row] = repr(values[row])
    return texts


def predict_name_read_back(name: str) -> str:
    """Return the name that a column has when it is read from the CSV file to which it was written.

    Cells cannot hold every name: characters that cannot be printed are written as codes, blanks at the ends are lost.
    `quote_for_cell` writes it as a spreadsheet may safely show it, `unquote_cell` undoes that.
    """
    return unquote_cell(quote_for_cell(name).strip())


def _convert_to_plain(column: np.ndarray) -> np.ndarray:
    """Return a column with dates as texts and flags as 1 and 0; other numbers stay as they are."""
    if column.dtype.kind == "M":
        return format_dates(column)
    return column.astype(np.int64) if column.dtype == np.bool_ else column
