"""Rows of CSV as columns, a block of lines at a time: of plain numbers all at once, else cell by cell."""

import re
from collections.abc import Container, Iterable, Iterator
from pathlib import Path

import numpy as np

from heliograph.files.tables.table_rows import EXACT, TableRows, find_missing
from heliograph.files.text.csv_dialects import NO_VALUE
from heliograph.files.text.csv_text import CsvReader, CsvRow, parse_cell
from heliograph.files.text.numeric_csv_lines import parse_numeric_lines
from heliograph.files.text.text_file import CutOffError, Progress, read_line_blocks, split_lines, yield_until_cut_off
from heliograph.numerics.check import InputError, fail, show_value
from heliograph.numerics.times.dates import MISSING as NAT
from heliograph.numerics.times.dates import looks_like_date, parse_moment
from heliograph.numerics.types import Float

WHOLE = re.compile(r"([+-]?\d{1,18}|[+-]?[1-8]\d{18})(?:\.0*)?")  # numbers that 64 bits hold, also as 7.0


def read_csv_blocks(
    path: Path, only: Container[str] | None, strict: bool, size: int, progress: Progress | None = None
) -> Iterator[TableRows]:
    """Yield the rows of a CSV file in parts of about `size` bytes, with the reasons why some rows cannot be read.

    Args:
        path: the file.
        only: the columns that are read; None for all.
        strict: whether a row that cannot be read is an error. Otherwise only this row is refused.
        size: bytes of lines in a part.
        progress: called with the number of bytes that were read, and the number of all bytes; None by default.

    Raises:
        ValueError: the header names no columns, or reading is strict and a row cannot be read.
    """
    text = CsvReader(str(path), path, marked=False)  # splits lines into cells
    columns = CsvColumnReader(str(path), path, only, strict)  # makes columns of the cells
    blocks: Iterator[bytes | CutOffError] = read_line_blocks(path, size, progress)
    if not strict:  # a file that was cut off is read up to there, and the error comes last
        blocks = yield_until_cut_off(blocks)
    for lines in blocks:
        if isinstance(lines, CutOffError):
            yield columns.read([lines])
        else:
            yield _read_csv_lines(text, columns, lines)
    yield columns.read(text.end())  # rows of a quote that was never closed


def _read_csv_lines(text: CsvReader, columns: "CsvColumnReader", lines: bytes) -> TableRows:
    """Return the rows in a block of whole lines: fast, all at once, if they are plain numbers, else cell by cell.

    `text.header` has the names of the columns, [] before the header came; `text.number` counts the rows.
    `parse_numeric_lines` returns None unless all cells are plain numbers.

    Args:
        text: splits lines into cells and knows the header; it is open while a quoted cell goes on in the next line.
        columns: makes columns of the cells, and refuses rows that cannot be read.
        lines: bytes of the lines.
    """
    # Line by line until the header, with the names of the columns, has come.
    rows, begin = list[CsvRow | InputError](), 0
    while begin < len(lines) and not text.header:
        end = lines.find(b"\n", begin) + 1 or len(lines)
        rows += [row for line in split_lines(lines[begin:end]) for row in text.add(line)]
        begin = end
    rest = lines[begin:] if begin else lines
    if not rows and text.header and not text.is_open:
        numbers = parse_numeric_lines(rest, len(text.header))
        if numbers is not None and columns.accepts_numbers(text.header, numbers):
            first = text.number + 1
            text.number += len(numbers)
            return columns.make_rows_of_numbers(text.header, numbers, first)
    return columns.read([*rows, *(row for line in split_lines(rest) for row in text.add(line))])


class CsvColumnReader:
    """Reads rows of CSV as columns, a part of a table at a time; a column is of dates if its first cell is one.

    Args:
        source: the name of the table, for errors.
        path: the file, if it can be read again.
        only: the columns that are read; None for all.
        strict: whether what cannot be read is an error, or is refused alone.
    """

    def __init__(self, source: str, path: Path | None, only: Container[str] | None, strict: bool):
        """Begin without a header; the first row brings it.

        `only`: the columns to read, None for all. `strict`: whether a row that cannot be read is an error.
        """
        self.source = source
        self.path = path
        self._only = only
        self._strict = strict
        self.header: list[str] = []
        self._dated = dict[str, bool]()  # for each column whether it holds dates, as soon as a cell tells it
        self._zoned = dict[str, bool]()  # for each column of dates whether these have a time zone

    def read(self, rows: Iterable[CsvRow | InputError]) -> TableRows:
        """Return the rows that can be read, as columns, and the errors of the others.

        Args:
            rows: for each row of the file its number and its cells, or the error why it could not be split into cells.

        Raises:
            ValueError: another header than before; where reading is strict, a row that cannot be read.
        """
        refused = list[InputError]()
        # Of each row that can be read: its number in the file, its cells, and these as numbers.
        numbers = list[int]()
        texts = list[list[str]]()
        values = list[list[float | int]]()
        for row in rows:
            try:
                if isinstance(row, InputError):
                    raise row
                self._check_header(row)
                values.append(self._parse_cells(row))
            except InputError as error:
                if self._strict:
                    raise
                refused.append(error)
            else:
                numbers.append(row.number)
                texts.append(row.cells)
        # Columns of the names in `_only`, or of all if that is None.
        columns = dict[str, np.ndarray]()
        for i, name in enumerate(self.header):
            if self._only is None or name in self._only:
                column = self._make_column(name, [row[i] for row in values], [cells[i] for cells in texts])
                self._add_column(columns, name, column)
        return TableRows(columns, np.array(numbers, dtype=np.int64), refused)

    def accepts_numbers(self, header: list[str], numbers: Float[np.ndarray, "rows columns"]) -> bool:
        """Return whether doubles, parsed from the text without looking at the cells, lose nothing of the cells.

        They do not if the header is another one, if a number reaches EXACT (2^53, from where doubles skip integers), or
        if there is a number in a column of dates.
        """
        if self.header not in ([], header) or np.nanmax(np.abs(numbers), initial=0.0) >= EXACT:
            return False
        dated = [i for i, name in enumerate(header) if self._dated.get(name)]
        return bool(np.isnan(numbers[:, dated]).all())

    def make_rows_of_numbers(
        self, header: list[str], numbers: Float[np.ndarray, "rows columns"], first: int
    ) -> TableRows:
        """Return rows, numbered from `first`, from their numbers (rows, columns) under a header; NaN is an empty cell.

        `self._dated` says by column whether it is of dates. A number decides that it is not; an empty column nothing.
        """
        self.header = header
        columns = dict[str, np.ndarray]()
        for name, values in zip(header, numbers.T, strict=True):
            if self._only is not None and name not in self._only:
                continue
            if self._dated.get(name):  # plain lines have no dates: its cells are empty here
                self._add_column(columns, name, np.full(len(values), "NaT", "datetime64[ns]"))
                continue
            self._add_column(columns, name, values.copy())
            if name not in self._dated and not np.isnan(values).all():
                self._dated[name] = False
        return TableRows(columns, np.arange(first, first + len(numbers)), [])

    def _add_column(self, columns: dict[str, np.ndarray], name: str, values: np.ndarray) -> None:
        """Add a column `values` under its name to `columns`.

        Only columns without a name ("") may come twice, as commas at the ends of lines make them: of these the one that
        has values is kept.

        Raises:
            ValueError: there are values in several columns without a name.
        """
        if name in columns:
            earlier = columns[name]
            if not (_is_empty(earlier) or _is_empty(values)):
                raise fail(f"{self.source}, header", "a name for each column that has values", "several without")
            values = earlier if _is_empty(values) else values
        columns[name] = values

    def _check_header(self, row: CsvRow) -> None:
        """Raise if a row stands under another header than the rows before it."""
        if not self.header:
            self.header = row.header
        if row.header != self.header:
            raise fail(row.where, f"the columns {', '.join(self.header)}", ", ".join(row.header))

    def _parse_cells(self, row: CsvRow) -> list[float | int]:
        """Return a number for each cell: of a date its nanoseconds; of an empty one NaN, or NAT among dates.

        Cells of columns that are not read are NaN. The first cell of a column that is not empty decides whether all
        are dates. A row that is refused decides nothing: what its cells say is noted only once all are read.
        """
        newly_dated = dict[str, bool]()
        numbers: list[float | int] = []
        for name, cell in zip(row.header, row.cells, strict=True):
            if self._only is not None and name not in self._only:
                numbers.append(np.nan)
                continue
            has_dates = self._dated.get(name)  # None: not decided yet
            if (looks_like_date(cell) if has_dates is None else has_dates) and not self._is_missing(cell):
                numbers.append(self._parse_date(row, name, cell))
                newly_dated[name] = True
            elif has_dates:
                numbers.append(NAT)
            else:
                numbers.append(self._parse_number(row, name, cell))
                if cell:
                    newly_dated[name] = False
        self._dated |= newly_dated
        return numbers

    def _parse_number(self, row: CsvRow, name: str, cell: str) -> float:
        """Return the number in a cell, NaN if it is empty.

        Unless reading is strict, infinity is an error: it would make the column one of doubles, in which large integers
        lose their last digits. `row`, `name`: place of the cell, for errors.
        """
        number = parse_cell(row.where, name, cell, self.path)
        if not self._strict and np.isinf(number):
            expected = "a finite number, or none where it did not arrive"
            raise fail(f"{row.where}, column {name!r}", expected, show_value(cell))
        return number

    @property
    def local(self) -> bool:
        """Return whether a column has dates without a zone, which are taken as UTC and may be local time."""
        return False in self._zoned.values()

    @staticmethod
    def _is_missing(cell: str) -> bool:
        """Return whether a cell is empty, or is a word for no value, such as "nan", "null" or "n/a" (NO_VALUE)."""
        return not cell or NO_VALUE.fullmatch(cell) is not None

    def _parse_date(self, row: CsvRow, name: str, cell: str) -> int:
        """Return a date as nanoseconds since 1970; raise if some dates of a column have a time zone and others not.

        `self._zoned` says for each column whether its first date has a zone. `row`, `name`: place of the cell.
        """
        where = f"{row.where}, column {name!r}"
        moment, zoned = parse_moment(cell, where)
        if self._zoned.setdefault(name, zoned) != zoned:
            raise fail(where, "a zone with every date or with none", show_value(cell))
        return moment

    def _make_column(self, name: str, values: list[float | int], cells: list[str]) -> np.ndarray:
        """Return a column as dates, as int64 or as floats.

        int64 is used if all cells are integers and one reaches EXACT (2^53), from where doubles skip integers. NAT
        stands for an empty cell among dates and among int64. WHOLE matches an integer that 64 bits hold, also written
        as 7.0.

        Args:
            name: name of the column; `self._dated` says whether it holds dates.
            values: the number in each cell, NaN if it is empty; of dates nanoseconds since 1970.
            cells: the cells' texts, from which integers are read with all digits.
        """
        if self._dated.get(name):
            # Empty cells before the first date are NaN, which is the only number that differs from itself.
            nanoseconds = [NAT if value != value else int(value) for value in values]
            return np.array(nanoseconds, dtype=np.int64).view("datetime64[ns]")
        numbers = np.array(values, dtype=np.float64)
        if not np.any(np.abs(numbers) >= EXACT):
            return numbers
        matches = [WHOLE.fullmatch(cell) for cell in cells]
        if not all(match or np.isnan(number) for match, number in zip(matches, numbers, strict=True)):
            return numbers
        return np.array([int(match[1]) if match else NAT for match in matches], dtype=np.int64)


def _is_empty(values: np.ndarray) -> bool:
    """Return whether a column has no value at all: only NaN, NaT, or among int64 the integer of NaT."""
    return bool((np.isnat(values) if values.dtype.kind == "M" else find_missing(values)).all())
