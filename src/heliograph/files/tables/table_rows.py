"""Rows of a table as columns of numbers and dates, a part of the table at a time or all of them."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import InputError, fail
from heliograph.numerics.times.dates import MISSING, REACH, round_to_nanoseconds

EXACT = 2**53  # up to here doubles hold every whole number


class TableRows(NamedTuple):
    """Rows of a table as columns, and why other rows could not be read.

    An empty cell is NaN, NaT among dates, and MISSING (the integer that stands for NaT) in a column of int64.
    """

    columns: dict[str, np.ndarray]  # by name, (rows,) each
    numbers: np.ndarray  # of the rows in the table, from 1, (rows,)
    refused: list[InputError]  # an error for each row that could not be read


def join_rows(parts: Iterable[TableRows]) -> TableRows:
    """Return the rows of several parts of a table, one after the other.

    A part has columns by name, the rows' numbers in the file, and errors of refused rows; all parts have the same
    columns.
    """
    parts = list(parts)
    # A part without rows does not tell the kinds of its columns. It is used only if all parts are empty.
    filled = [part for part in parts if len(part.numbers)] or parts[-1:]
    names = filled[0].columns if filled else ()
    columns = {name: _join_column([part.columns[name] for part in filled]) for name in names}
    numbers = np.concatenate([np.zeros(0, dtype=np.int64), *(part.numbers for part in filled)])
    return TableRows(columns, numbers, [error for part in parts for error in part.refused])


def _join_column(parts: list[np.ndarray]) -> np.ndarray:
    """Return the parts of a column, one after the other, as dates, float64 or int64.

    A part of int64 has integers that are too large for doubles. If all numbers of the column are integers, it stays
    int64, since float64 would round the large ones. Else it becomes float64.
    """
    kinds = {part.dtype.kind for part in parts}  # of NumPy: M dates, i integers, f floats
    if "M" in kinds:  # a part without dates has only empty cells
        parts = [part if part.dtype.kind == "M" else np.full(len(part), "NaT", "datetime64[ns]") for part in parts]
    elif kinds == {"i", "f"}:
        convert = _convert_to_whole if all(map(_are_whole_numbers, parts)) else convert_to_doubles
        parts = [convert(part) for part in parts]
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _are_whole_numbers(numbers: np.ndarray) -> bool:
    """Return whether all numbers, without NaN, are integers that are exact as doubles or are int64 already."""
    if numbers.dtype.kind == "i":
        return True
    numbers = numbers[~np.isnan(numbers)]
    return bool(np.all((np.abs(numbers) < EXACT) & (numbers == np.trunc(numbers))))


def _convert_to_whole(numbers: np.ndarray) -> np.ndarray:
    """Return whole numbers, float64 or int64, as int64; NaN becomes MISSING."""
    if numbers.dtype.kind == "i":
        return numbers
    return np.where(np.isnan(numbers), MISSING, np.nan_to_num(numbers).astype(np.int64))


def convert_to_doubles(numbers: np.ndarray) -> np.ndarray:
    """Return numbers as float64; in a column of int64 MISSING becomes NaN."""
    doubles = np.asarray(numbers, dtype=np.float64)
    return np.where(numbers == MISSING, np.nan, doubles) if numbers.dtype.kind == "i" else doubles


def find_missing(numbers: np.ndarray) -> np.ndarray:
    """Return the mask of the missing numbers: NaN of float64, MISSING of int64."""
    return np.asarray(numbers == MISSING if numbers.dtype.kind == "i" else np.isnan(numbers))


def convert_to_numbers(column: np.ndarray, missing: np.ndarray | None = None) -> np.ndarray:
    """Return numbers as float64, or as int64 if integers are too large for exact doubles.

    A missing number becomes NaN in float64, and MISSING in int64, which therefore holds no number as small as this.
    EXACT is 2^53, up to which doubles hold every integer.

    Args:
        column: numbers of any type.
        missing: mask of the missing numbers; None if there are none.
    """
    absent = np.zeros(len(column), dtype=bool) if missing is None else missing
    doubles = np.where(absent, np.nan, column.astype(np.float64))
    present = column[~absent]
    is_large = column.dtype.kind in "iu" and present.size and np.nanmax(np.abs(doubles)) >= EXACT
    if not is_large or int(present.max()) > np.iinfo(np.int64).max or int(present.min()) <= MISSING:
        return doubles
    return np.where(absent, MISSING, column.astype(np.int64))


def convert_to_nanoseconds(column: np.ndarray, name: str, first: int = 1) -> np.ndarray:
    """Return dates as datetime64[ns]; `first` is the number of their first row, for errors.

    Raises:
        ValueError: a date is beyond 64 bits of nanoseconds, or has a fraction of a nanosecond. The error names its row.
    """
    moments = round_to_nanoseconds(column)
    # Convert back and compare: a date out of reach is NaT then, and one that lost a fraction is another date.
    wrong = ~np.isnat(column) & (moments.astype(column.dtype) != column)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise fail(f"{name}, row {first + row}", f"a date in whole nanoseconds, {REACH}", column[row])
    return moments
