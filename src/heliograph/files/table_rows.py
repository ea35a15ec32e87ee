"""Rows of a table as columns of numbers and dates, a part of the table at a time or all of them."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import InputError, fail
from heliograph.numerics.times.dates import round_to_nanoseconds

EXACT = 2**53  # up to here doubles hold every whole number


class TableRows(NamedTuple):
    """Rows of a table that could be read, as columns; their numbers, from 1; and why others could not be read."""

    columns: dict[str, np.ndarray]
    numbers: np.ndarray
    refused: list[InputError]


def join_rows(parts: Iterable[TableRows]) -> TableRows:
    """Return the rows of several parts of a table, one after the other."""
    parts = list(parts)
    # Parts without rows do not say of which kind their columns are, and count only where there is nothing else.
    filled = [part for part in parts if len(part.numbers)] or parts[-1:]
    names = filled[0].columns if filled else ()
    columns = {name: _join_column([part.columns[name] for part in filled]) for name in names}
    numbers = np.concatenate([np.zeros(0, dtype=np.int64), *(part.numbers for part in filled)])
    return TableRows(columns, numbers, [error for part in parts for error in part.refused])


def _join_column(parts: list[np.ndarray]) -> np.ndarray:
    """Return the parts of a column, one after the other, as dates, float64 or int64: what holds all of them.

    A part of int64 has numbers too large for doubles. So the column stays int64 where all its numbers are whole, since
    float64 would round the large ones.
    """
    kinds = {part.dtype.kind for part in parts}  # of NumPy: M dates, i integers, f floats
    if "M" in kinds:  # a part without dates has empty cells alone, as those before the first date
        parts = [part if part.dtype.kind == "M" else np.full(len(part), "NaT", "datetime64[ns]") for part in parts]
    elif kinds == {"i", "f"} and all(_are_whole_numbers(part) for part in parts):
        parts = [part.astype(np.int64) for part in parts]
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _are_whole_numbers(numbers: np.ndarray) -> bool:
    """Return whether all numbers are whole, and of a size at which doubles hold each."""
    return numbers.dtype.kind == "i" or bool(np.all((np.abs(numbers) < EXACT) & (numbers == np.trunc(numbers))))


def convert_to_numbers(column: np.ndarray) -> np.ndarray:
    """Return numbers as float64, or as int64 where that alone tells them apart."""
    whole = column.dtype.kind in "iu" and column.size and np.abs(column.astype(np.float64)).max() >= EXACT
    return np.asarray(column, dtype=np.int64 if whole and column.dtype != np.uint64 else np.float64)


def convert_to_nanoseconds(column: np.ndarray, name: str, first: int = 1) -> np.ndarray:
    """Return dates as datetime64[ns]; `first` is the number of their first row, for errors.

    Raises:
        ValueError: a date that 64 bits of nanoseconds cannot say, or a part of a nanosecond; one line with its row.
    """
    moments = round_to_nanoseconds(column)
    # Converted back, what nanoseconds do not reach is NaT, and what lost a part of one another date.
    wrong = ~np.isnat(column) & (moments.astype(column.dtype) != column)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise fail(f"{name}, row {first + row}", "a date in whole nanoseconds, from 1678 to 2261", column[row])
    return moments
