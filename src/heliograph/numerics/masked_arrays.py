"""What is masked or missing in arrays and tables, as NaN: every array that comes in passes here."""

from collections.abc import Mapping
from numbers import Real
from typing import Any

import numpy as np


def fill_masked(value: Any) -> Any:
    """Return numbers with NaN, or dates with NaT, where they are masked or missing; anything else as it is.

    Entries of NumPy's masked arrays may be masked, also within a list. None and NA are missing, among numbers of a list
    or in columns of tables.
    """
    if isinstance(value, list | tuple):
        if any(isinstance(item, np.ma.MaskedArray) for item in value):
            value = np.ma.array([np.nan if item is np.ma.masked else item for item in value])
        elif all(is_absent(item) or isinstance(item, Real) for item in value):
            return [np.nan if is_absent(item) else item for item in value]
    if isinstance(value, np.ma.MaskedArray):
        return _fill_array(np.asarray(value), np.ma.getmaskarray(value))
    if hasattr(value, "to_numpy"):  # a column of a table, or several
        return _fill_array(np.asarray(value), np.asarray(False))
    return value


# What NetCDF and Zarr say of numbers that are packed or stand for missing ones; xarray takes it away as it decodes.
PACKED = ("scale_factor", "add_offset", "_FillValue", "missing_value")


def find_packing(value: Any) -> str:
    """Return the attribute by which a labelled array says that its numbers are not decoded yet, or ""."""
    attributes = getattr(value, "attrs", None)
    if not isinstance(attributes, Mapping):
        return ""
    since = ["units"] if " since " in str(attributes.get("units", "")) else []  # a clock that counts from a date
    return next((name for name in (*PACKED, *since) if name in attributes), "")


def holds_texts_or_dates(numbers: np.ndarray) -> bool:
    """Return whether an array holds texts, dates or spans of time: no numbers, though they may read as such.

    Of an array of objects only texts among them count.
    """
    kind = numbers.dtype.kind  # U and S: texts, m: spans of time, M: dates, O: any objects
    return kind in "USmM" or (kind == "O" and any(isinstance(entry, str | bytes) for entry in numbers.flat))


def _fill_array(numbers: np.ndarray, masked: np.ndarray) -> np.ndarray:
    """Return an array with NaN, or NaT for dates, where it is masked or an object in it is absent (None, NA).

    If all objects are then numbers, they become doubles.
    """
    kind = numbers.dtype.kind
    if kind == "M":  # dates
        return np.where(masked, np.array("NaT", numbers.dtype), numbers)
    if kind == "O":  # any objects: numbers if all that is not absent are
        absent = np.array([is_absent(entry) for entry in numbers.flat], dtype=bool)
        filled = np.where(masked | absent.reshape(numbers.shape), np.nan, numbers)
        holds_numbers_alone = all(isinstance(entry, Real) for entry in filled.flat)
        return filled.astype(np.float64) if holds_numbers_alone else filled
    if kind not in "fiub" or not masked.any():  # no real numbers, or none masked
        return numbers
    return np.where(masked, np.nan, numbers.astype(np.float64))


def is_absent(value: object) -> bool:
    """Return whether an entry of a table is none: None, NaN, or NA of pandas, which compares with nothing."""
    return value is None or type(value).__name__ == "NAType" or (isinstance(value, float) and value != value)
