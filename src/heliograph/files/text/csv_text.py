"""Text of CSV, a line at a time, to rows of cells: of a file, and of a pipe whose lines come when they come."""

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from heliograph.disk.quoted_text import unquote_cell
from heliograph.files.text.csv_dialects import (
    FLAGS,
    NO_VALUE,
    check_header,
    guess_meaning_of_cell,
    suggest_recoding,
    suggest_rewrite,
)
from heliograph.files.text.text_file import is_valid_text, open_text
from heliograph.numerics.check import InputError, fail, show_value

ANNOTATIONS = ("#group", "#datatype", "#default", "#constant")  # of Influx's annotated CSV
OPEN = 100  # lines that a cell in quotes may have


class CsvRow(NamedTuple):
    """Row of a table.

    Attributes:
        where: its place, for errors.
        number: its number, from 1.
        header: the names of its columns.
        cells: a text for each column, without margins.
    """

    where: str
    number: int
    header: list[str]
    cells: list[str]


class CsvReader:
    """Reader of a table of CSV, to which lines are given one after another.

    The first line that is not empty has the names of the columns; annotations of Influx begin a table with a header of
    its own. Rows count from 1 over all of them. What is no row is an error in its place, and the rest goes on: a
    comment, more or fewer cells than columns, bytes that are no text, a quote that is not closed.

    Args:
        source: the name of the table, for errors.
        path: the file, if it can be read again.
        marked: whether the first of several names may begin with a mark of comments.
    """

    def __init__(self, source: str, path: Path | None, marked: bool):
        """Begin before the first line; `marked`: whether a line that begins with # may be a row and no comment."""
        self.source, self.path, self._marked = source, path, marked
        self.header: list[str] = []  # [] until the line with the columns' names has come
        self.number = 0  # of the last row
        self._open_lines: list[str] = []  # lines from the one that opened a quote, while it is not closed

    @property
    def is_open(self) -> bool:
        """Return whether a quote was opened that is not closed yet."""
        return bool(self._open_lines)

    def add(self, line: str) -> list[CsvRow | InputError]:
        """Return the rows that a line completes, or errors for rows that cannot be read; none inside a quoted cell.

        A cell in quotes may go on over several lines, and the row is complete only with the line that closes the quote.

        Raises:
            ValueError: the header names no columns, or a column twice.
        """
        if not self._open_lines and '"' not in line:
            return self._make_row(line.rstrip("\r\n").split(","))
        self._open_lines.append(line)
        return self._read_lines_of_open_quote(ended=False)

    def end(self) -> list[CsvRow | InputError]:
        """Return the rows, or errors, of lines that are left at the end of the text, since a quote was not closed."""
        return self._read_lines_of_open_quote(ended=True)

    def _read_lines_of_open_quote(self, ended: bool) -> list[CsvRow | InputError]:
        """Return the rows of `self._open_lines`, the lines since a quote was opened; [] while it may still be closed.

        If it is not closed within OPEN lines, or at the text's end (`ended`), its first line is an error, and the other
        lines are read anew.
        """
        rows: list[CsvRow | InputError] = []
        while self._open_lines:
            try:
                cells = next(csv.reader(["".join(self._open_lines)], strict=True))
            except csv.Error as error:
                if "unexpected end" in str(error) and not ended and len(self._open_lines) < OPEN:
                    return rows
                lines, self._open_lines = self._open_lines, []
                rows += self._make_row(lines[:1], str(error))
                for line in lines[1:]:
                    rows += self.add(line)
                if not ended:
                    return rows
            else:
                self._open_lines = []
                rows += self._make_row(cells)
        return rows

    def _make_row(self, cells: list[str], broken: str = "") -> list[CsvRow | InputError]:
        """Return the row of these cells, or the error why they are no row, in a list.

        The list is empty for an empty line, an annotation of Influx and a header, which sets `self.header`. `broken`:
        what is wrong with the line, if this is known already. `self.number` counts the rows behind the header.
        ANNOTATIONS are the words that begin such a line.

        Raises:
            ValueError: the header names no columns, or a column twice.
        """
        if not broken and not any(cell.strip() for cell in cells):
            return []
        if cells[0].strip() in ANNOTATIONS:
            self.header = []
            return []
        if not self.header:
            if broken:
                raise fail(f"{self.source}, header", "names separated by commas", f"{show_value(cells[0])}: {broken}")
            header = [unquote_cell(name.strip()) for name in cells]
            check_header(self.source, header, self.path, self._marked)
            self.header = header
            return []
        self.number += 1
        where = f"{self.source}, row {self.number}"
        error = fail(where, "a row of CSV", broken) if broken else self._find_row_error(where, cells)
        if error is not None:
            return [error]
        return [CsvRow(where, self.number, self.header, [cell.strip() for cell in cells])]

    def _find_row_error(self, where: str, cells: list[str]) -> InputError | None:
        """Return the error if the cells are no row of this table, or None if they are one.

        A line that begins with # is a comment, unless `self._marked` allows such rows. `suggest_recoding` and
        `suggest_rewrite` return the call of pandas that rewrites the file, for the error's text.
        """
        line = ",".join(cells)
        if not is_valid_text(line):
            return fail(where, "a text in UTF-8 or UTF-16", f"{show_value(line)}{suggest_recoding(self.path, line)}")
        if line.lstrip().startswith("#") and not (self._marked and len(cells) == len(self.header)):
            remedy = "" if self.path is None else f": {suggest_rewrite(self.path, comment='#')}"
            return fail(where, "numbers", f"a comment, {show_value(cells[0])}{remedy}")
        if len(cells) != len(self.header):
            hint = ": numbers have a decimal point" if len(cells) > len(self.header) else ""
            return fail(where, f"{len(self.header)} cells, one for each column", f"{len(cells)}{hint}")
        return None


def read_csv_rows(path: Path, marked: bool) -> Iterator[CsvRow | InputError]:
    """Yield the rows of a CSV file; an error stands in place of a row that cannot be read; `marked` as of `CsvReader`.

    Raises:
        ValueError: the header names no columns, or a packed file is damaged (the rows before are yielded).
    """
    text = CsvReader(str(path), path, marked)
    with open_text(path) as file:
        for line in file:
            yield from text.add(line)
    yield from text.end()


def read_csv_header(path: Path) -> list[str]:
    """Return the names of a CSV file's columns, or [] if the file cannot be read as CSV."""
    text = CsvReader(str(path), path, marked=True)
    try:
        with open_text(path) as file:
            for line in file:
                text.add(line)
                if text.header:
                    break
    except (InputError, OSError):
        return []
    return text.header


def parse_cell(where: str, name: str, cell: str, path: Path | None) -> float:
    """Return the number in a cell: 1 for true and 0 for false, NaN if it is empty or a word for no value (NO_VALUE).

    `where` and `name` are the cell's row and column, for the error. `path` is the table's file, if it can be rewritten.
    FLAGS maps "true" and "false" to their values.

    Raises:
        ValueError: the cell holds no number. The error says what is probably meant.
    """
    try:
        if "_" in cell:  # only Python accepts such numbers
            raise ValueError
        return float(cell) if cell else float("nan")
    except ValueError:
        if NO_VALUE.fullmatch(cell):
            return float("nan")
        if cell.lower() in FLAGS:
            return float(FLAGS[cell.lower()])
        hint = guess_meaning_of_cell(cell, name, path)
        expected = "a number or an empty cell"
        raise fail(f"{where}, column {name!r}", expected, f"{show_value(cell)}{hint}") from None
