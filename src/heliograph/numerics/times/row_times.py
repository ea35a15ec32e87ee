"""Times of rows of data: those that are given, and the dates by which the rows of a table are known."""

from collections.abc import Iterable
from typing import Any, cast

import numpy as np

from heliograph.numerics.check import array, fail, show_value
from heliograph.numerics.masked_arrays import fill_masked
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.times.dates import YEARS, looks_like_date, parse_dates
from heliograph.numerics.types import ArrayLike

NANOSECONDS = np.dtype("datetime64[ns]")
LONG_AGO, LEAP = 1e8, 100.0  # of a clock that has counted for long, and how many times its time no later one is


def check_times(name: str, value: ArrayLike, count: int) -> np.ndarray:
    """Return `count` times that do not go backwards: numbers, or dates (datetime64, UTC), then to the nanosecond.

    Dates may be texts of ISO 8601, datetimes, or periods of pandas, which stand for their first moment. Whole numbers
    that doubles cannot tell apart stay what they are.

    Args:
        name: of the times, for errors.
        value: numbers or dates (count,).
        count: number of rows.

    Raises:
        ValueError: neither numbers nor dates, some that are missing, another count, times that go backwards.
    """
    clock = read_dates(name, value)
    if clock is None:
        if not is_traced(value) and _holds_texts_or_spans(value):
            raise fail(name, "numbers, or dates (datetime64, datetimes, texts of ISO 8601)", show_value(value))
        clock = array(name, value, (count,))
        whole = np.asarray(value)
        if whole.dtype.kind in "iu" and np.abs(clock).max(initial=0) >= 2**53:  # doubles cannot tell these apart
            clock = whole
    elif clock.shape != (count,) or np.isnat(clock).any():
        missing = np.count_nonzero(np.isnat(clock))
        raise fail(name, f"{count} dates", f"shape {clock.shape}, {missing} of them missing")
    row = find_backwards_row(clock)
    if row is not None:
        raise fail(name, "times that do not go backwards", f"{backwards_text(clock, row)} in row {row + 1}")
    return clock


def _holds_texts_or_spans(value: object) -> bool:
    """Test whether a value is of texts or spans of time, by NumPy's type of it; a list of unequal lists is not."""
    try:
        return np.asarray(value).dtype.kind in "mSU"
    except ValueError:
        return False


def read_dates(name: str, value: object) -> np.ndarray | None:
    """Return dates as datetime64[ns] in UTC, NaT where they are missing; None of what holds no date.

    Args:
        name: of the dates, for errors.
        value: datetime64 of any unit, or texts, datetimes or periods of pandas in a list or an array of any kind.

    Raises:
        ValueError: something among dates that is none, or one that nanoseconds since 1970 cannot say in 64 bits.
    """
    if is_traced(value):
        return None
    if getattr(getattr(value, "dtype", None), "kind", "") == "M":
        given = fill_masked(value) if isinstance(value, np.ma.MaskedArray) else value
        whole = np.asarray(given)
        return _convert_unit(name, whole if whole.dtype.kind == "M" else np.asarray(given, NANOSECONDS))
    # Anything else that holds at least one date: all has to be dates then.
    parts = _list_elements(value)
    if not any(_is_date(part) for part in parts):
        return None
    moments = [part.to_timestamp() if hasattr(part, "to_timestamp") else part for part in parts]
    return parse_dates([str(_convert_unit(name, m)) if isinstance(m, np.datetime64) else m for m in moments], name)


def _list_elements(value: object) -> list[Any]:
    """Return what a list, or an array that is not of numbers, holds along its one axis; an empty list of all else."""
    kind = getattr(getattr(value, "dtype", None), "kind", "O")
    if isinstance(value, str | bytes | dict) or kind in "fiubcm" or getattr(value, "ndim", 1) != 1:
        return []
    try:
        return list(cast(Iterable[Any], value))
    except TypeError:
        return []


def _is_date(part: object) -> bool:
    """Return whether something may be a date: a text, a datetime64, a date or datetime, or a period of pandas."""
    return isinstance(part, str | np.datetime64) or hasattr(part, "isoformat") or hasattr(part, "to_timestamp")


def _convert_unit(name: str, moments: np.ndarray | np.datetime64) -> np.ndarray:
    """Return datetime64 of any unit in nanoseconds; NumPy alone would let years beyond YEARS overflow silently.

    Raises:
        ValueError: a year that nanoseconds since 1970 cannot say in 64 bits; `name` is for the message.
    """
    years = 1970 + np.asarray(moments).astype("datetime64[Y]").astype(np.int64)
    beyond = ~np.isnat(moments) & ((years < YEARS[0]) | (years > YEARS[-1]))
    if beyond.any():
        raise fail(name, f"dates from {YEARS[0]} to {YEARS[-1]}", str(np.asarray(moments)[beyond][0]))
    return np.asarray(np.asarray(moments).astype(NANOSECONDS))


def row_dates(name: str, rows: object) -> np.ndarray | None:
    """Return the dates with which the rows of a table, a column or a labelled array are labelled; None if with none.

    Args:
        name: of the rows, for errors.
        rows: with an index (pandas) or a coordinate of its first dimension (xarray); anything else has none.

    Raises:
        ValueError: dates that are missing or go backwards.
    """
    labels = getattr(rows, "index", None)
    if hasattr(rows, "dims") and hasattr(rows, "coords"):
        dims: Any = rows.dims
        labels = rows.coords.get(next(iter(dims))) if dims else None
    if labels is None or callable(labels):  # a list has a function of that name
        return None
    shown = np.asarray(labels)
    if shown.dtype.kind != "M" and not (shown.ndim == 1 and len(shown) and all(_is_date_label(part) for part in shown)):
        return None
    return check_times(f"dates of {name}", labels, len(shown))


def _is_date_label(part: object) -> bool:
    """Return whether a row's label is a date: of a class of dates, or a text that reads as one."""
    if isinstance(part, str):
        return looks_like_date(part)
    return _is_date(part)


def is_mix_of_units(earlier: Any, later: Any) -> Any:
    """Return whether two times of one clock, numbers or arrays, are in two units, as seconds and milliseconds.

    Of a clock that has counted for long (seconds since 1970 are 1.7e9) a hundredfold leap is no time that went by.
    """
    return (earlier >= LONG_AGO) & (later > LEAP * earlier)


def find_backwards_row(clock: np.ndarray) -> int | None:
    """Return the first row whose time is before that of the row above, None if there is none."""
    falls = np.flatnonzero(clock[1:] < clock[:-1])
    return int(falls[0]) + 1 if falls.size else None


def backwards_text(clock: np.ndarray, row: int) -> str:
    """Return the two times of that row and the row above in words."""
    now, before = (str(t) if clock.dtype.kind == "M" else f"{t:.10g}" for t in (clock[row], clock[row - 1]))
    return f"{now} after {before}"
