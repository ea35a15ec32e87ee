"""What is masked or missing in arrays and tables, as NaN: every array that comes in passes here."""

from numbers import Real
from typing import Any

import numpy as np


def fill_masked(value: Any) -> Any:
    """Return numbers with NaN, or dates with NaT, where they are masked or missing; anything else as it is.

    Masked are those of NumPy's masked arrays, also within a list, and None and NA among numbers, and in columns
    of tables.
    """
    if isinstance(value, list | tuple):
        if any(isinstance(part, np.ma.MaskedArray) for part in value):
            value = np.ma.array([np.nan if part is np.ma.masked else part for part in value])
        elif all(is_absent(part) or isinstance(part, Real) for part in value):
            return [np.nan if is_absent(part) else part for part in value]
    if isinstance(value, np.ma.MaskedArray):
        numbers, masked = np.asarray(value), np.ma.getmaskarray(value)
    elif hasattr(value, "to_numpy"):  # a column of a table, or several
        numbers, masked = np.asarray(value), np.asarray(False)
    else:
        return value
    if numbers.dtype.kind == "M":
        return np.where(masked, np.datetime64("NaT"), numbers)
    if numbers.dtype.kind == "O":
        absent = np.array([is_absent(part) for part in numbers.flat], dtype=bool)
        filled = np.where(masked | absent.reshape(numbers.shape), np.nan, numbers)
        return filled.astype(np.float64) if all(isinstance(part, Real) for part in filled.flat) else filled
    if numbers.dtype.kind not in "fiub" or not masked.any():
        return numbers
    return np.where(masked, np.nan, numbers.astype(np.float64))


def is_absent(value: object) -> bool:
    """Return whether an entry of a table is none: None, NaN, or NA of pandas, which compares with nothing."""
    return value is None or type(value).__name__ == "NAType" or (isinstance(value, float) and value != value)
