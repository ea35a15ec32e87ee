"""Columns of a table from a file, a DataFrame of pandas or polars, or a dictionary."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from heliograph.files.table import read_table
from heliograph.numerics.check import fail, shown
from heliograph.numerics.dates import dates

TIME = "time"


def columns_of(table: object, name: str = "table") -> dict[str, np.ndarray]:
    """Return columns by name, numbers as float64 and dates as datetime64[ns] in UTC; missing values are NaN or NaT."""
    if isinstance(table, str | os.PathLike):
        return read_table(Path(table))
    if isinstance(table, Mapping):
        named = dict(table)
    elif hasattr(table, "columns") and hasattr(table, "__getitem__"):
        frame: Any = table
        index = getattr(frame, "index", None)
        named = {TIME: index} if getattr(index, "name", None) == TIME and TIME not in frame.columns else {}
        named |= {column: frame[column] for column in frame.columns}
    else:
        raise fail(name, "a file, a DataFrame, or a dictionary of columns", shown(table))
    for column in named:
        if not isinstance(column, str):
            raise fail(f"{name}, columns", "names that are text", shown(column))
    return {column: _values(values, f"{name}, column {column!r}") for column, values in named.items()}


def _values(values: Any, name: str) -> np.ndarray:
    """Convert one column, which may have a missing value other than NaN."""
    missing = values.isna() if hasattr(values, "isna") else None
    if missing is not None and values.dtype.kind in "iufb":  # pandas's own kinds of number have a mask
        return np.asarray(values.to_numpy(dtype=np.float64, na_value=np.nan))
    result = values.to_numpy() if hasattr(values, "to_numpy") else np.asarray(values)
    if result.dtype.kind == "M":
        return np.asarray(result.astype("datetime64[ns]"))
    if result.dtype.kind in "fiub":
        return np.asarray(result, dtype=np.float64)
    if result.dtype.kind in "OUT":
        return _of_objects(result, name)
    raise fail(name, "numbers or dates", f"{result.dtype}")


def _of_objects(result: np.ndarray, name: str) -> np.ndarray:
    """Convert numbers with None among them, or dates; refuse text, even if it reads as a number."""
    some = next((item for item in result if item is not None), None)
    if isinstance(some, str) or hasattr(some, "isoformat"):
        return dates(result, name)
    texts = [item for item in result if isinstance(item, str | bytes)]  # text is no number, though it may read as one
    try:
        if texts:
            raise TypeError
        return np.array([np.nan if item is None else float(item) for item in result])
    except (TypeError, ValueError, OverflowError):
        raise fail(name, "numbers or dates", shown(texts[0] if texts else some)) from None
