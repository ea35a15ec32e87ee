"""Times of rows of data: those that are given, and the dates by which the rows of a table are known."""

from collections.abc import Iterable
from typing import Any, cast

import numpy as np

from heliograph.numerics.check import InputError, array, fail, show_value
from heliograph.numerics.masked_arrays import fill_masked, find_packing
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.times.dates import REACH, looks_like_date, parse_dates, round_to_nanoseconds
from heliograph.numerics.types import ArrayLike

NANOSECONDS = np.dtype("datetime64[ns]")
LONG_AGO, LEAP = 1e8, 100.0  # of a clock that has counted for long, and how many times its time no later one is


def check_times(name: str, value: ArrayLike, count: int) -> np.ndarray:
    """Return `count` times that do not go backwards: numbers, or dates (datetime64, UTC), then to the nanosecond.

    Dates may be texts of ISO 8601, datetimes, or periods of pandas, which stand for their first moment. Whole numbers
    that doubles cannot tell apart stay what they are.

    Args:
        name: name of the times, for errors.
        value: numbers or dates (count,).
        count: number of rows.

    Raises:
        ValueError: neither numbers nor dates, some that are missing, another count, times that go backwards.
    """
    clock = read_dates(name, value)
    # Numbers: doubles, unless large whole numbers would lose digits.
    if clock is None:
        if not is_traced(value) and _holds_texts_or_spans(value):
            raise fail(name, "numbers, or dates (datetime64, datetimes, texts of ISO 8601)", show_value(value))
        clock = array(name, value, (count,))
        whole = np.asarray(value)
        if whole.dtype.kind == "O":  # Python's integers, or pandas' own
            whole = np.asarray(whole.tolist())
        if whole.dtype.kind in "iu" and np.abs(clock).max(initial=0) >= 2**53:  # doubles cannot tell these apart
            clock = whole
    # Dates: as many as rows, none missing.
    elif clock.shape != (count,) or np.isnat(clock).any():
        missing = np.count_nonzero(np.isnat(clock))
        raise fail(name, f"{count} dates", f"shape {clock.shape}, {missing} of them missing")
    row = find_backwards_row(clock)
    if row is not None:
        raise fail(name, "times that do not go backwards", f"{backwards_text(clock, row)} in row {row + 1}")
    return clock


def _holds_texts_or_spans(value: object) -> bool:
    """Return whether a value holds texts or spans of time, by its NumPy type; a list of unequal lists does not."""
    try:
        return np.asarray(value).dtype.kind in "mSU"
    except ValueError:
        return False


def check_dates(name: str, value: object) -> np.ndarray:
    """Return dates as datetime64[ns] in UTC, with NaT for missing ones; raise ValueError for anything else."""
    dates = read_dates(name, value)
    if dates is None:
        raise fail(name, "dates", show_value(value))
    return dates


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
    if getattr(getattr(value, "dtype", None), "kind", "") == "M":  # datetime64, or a type of pandas with a zone
        filled = fill_masked(value) if isinstance(value, np.ma.MaskedArray) else value
        dates = np.asarray(filled)
        return _convert_to_nanoseconds(name, dates if dates.dtype.kind == "M" else np.asarray(filled, NANOSECONDS))
    # Anything else that holds at least one date: all has to be dates then.
    elements = _list_elements(value)
    if not any(_is_date(element) for element in elements):
        return None
    moments = [period.to_timestamp() if hasattr(period, "to_timestamp") else period for period in elements]
    texts = [str(_convert_to_nanoseconds(name, m)) if isinstance(m, np.datetime64) else m for m in moments]
    return parse_dates(texts, name)


def _list_elements(value: object) -> list[Any]:
    """Return the elements of a list, or of an array of one axis that holds no numbers; anything else gives []."""
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


def _convert_to_nanoseconds(name: str, moments: np.ndarray | np.datetime64) -> np.ndarray:
    """Return datetime64 of any unit in nanoseconds, with NaT for missing ones.

    Raises:
        ValueError: a date that 64 bits of nanoseconds since 1970 cannot express; `name` is for the message.
    """
    given = np.asarray(moments)
    converted = round_to_nanoseconds(given)
    is_too_far = np.isnat(converted) & ~np.isnat(given)
    if is_too_far.any():
        raise fail(name, f"dates {REACH}", str(given[is_too_far][0]))
    return converted


def row_dates(name: str, rows: object) -> np.ndarray | None:
    """Return the dates that label the rows of a table, a column or a labelled array, or None without dates.

    Args:
        name: name of the rows, for errors.
        rows: the rows; an index (pandas) or a coordinate of the first dimension (xarray) labels them. Spans of time
            become seconds.

    Raises:
        ValueError: dates that are missing or go backwards, or that are not decoded (numbers "days since 2000-01-01").
    """
    labels = getattr(rows, "index", None)
    if hasattr(rows, "dims") and hasattr(rows, "coords"):
        dims: Any = rows.dims
        labels = rows.coords.get(next(iter(dims))) if dims else None
    if labels is None or callable(labels):  # a list has a function of that name
        return None
    # Dates that a file stores as numbers (CF conventions) must have been decoded by the reader.
    if packing := find_packing(labels):
        came = f"{packing!r} of {getattr(labels, 'attrs', {})[packing]!r}"
        raise fail(f"dates of {name}", "decoded ones, as xarray.decode_cf makes them", came)
    label_array = np.asarray(labels)
    if label_array.dtype.kind == "m":
        return check_times(f"times of {name}", label_array / np.timedelta64(1, "s"), len(label_array))
    if label_array.dtype.kind != "M":
        is_filled_list = label_array.ndim == 1 and len(label_array) > 0
        if not is_filled_list or not all(_is_date_label(label) for label in label_array):
            return None
    return check_times(f"dates of {name}", labels, len(label_array))


def _is_date_label(label: object) -> bool:
    """Return whether a row's label is a date: of a class of dates, or a text that reads as one."""
    if isinstance(label, str):
        return looks_like_date(label)
    return _is_date(label)


def is_mix_of_units(earlier: Any, later: Any) -> Any:
    """Return whether two times of one clock, numbers or arrays, are in two units, as seconds and milliseconds.

    Of a clock that has counted for long (seconds since 1970 are 1.7e9) a hundredfold leap is no time that went by.
    """
    return (earlier >= LONG_AGO) & (later > LEAP * earlier)


COARSE = 0.01  # of a step, from which on the distance of doubles is an error of it


def find_lost_digits(clock: np.ndarray) -> tuple[float, float] | None:
    """Return the distance of neighbouring doubles at these times and the median step, if steps lost digits to it.

    They did where the distance is more than COARSE of the median step and the times go to their last digit: not all
    are multiples of two distances. Doubles that are all of single precision, as of a column of float32, have the
    distance of these. None of dates and of whole numbers.
    """
    if clock.dtype.kind != "f" or len(clock) < 2:
        return None
    largest = np.abs(clock).max()
    is_single = largest < np.finfo(np.float32).max and np.array_equal(clock.astype(np.float32), clock)
    distance = float(np.spacing(np.float32(largest) if is_single else largest))
    steps = np.abs(np.diff(clock))
    steps = steps[steps > 0]
    if not steps.size or distance <= COARSE * np.median(steps) or not np.any(np.remainder(clock, 2 * distance)):
        return None
    return distance, float(np.median(steps))


def find_backwards_row(clock: np.ndarray) -> int | None:
    """Return the first row whose time is before that of the row above, None if there is none."""
    is_lower = clock[1:] < clock[:-1]
    falls = np.flatnonzero(is_lower)
    return int(falls[0]) + 1 if falls.size else None


def fail_of_clock_set_back(where: str, clock: np.ndarray, row: int) -> InputError:
    """Return the error of dates in local time that go back by an hour in a row, where summer time ends.

    `where` is the place of the row.
    """
    came = f"{backwards_text(clock, row)}: clocks are set back so when summer time ends"
    return fail(where, "dates in UTC, or with their zone (pandas: tz_localize(ambiguous='infer'))", came)


def describe_clock_set_forward(clock: np.ndarray, row: int) -> str:
    """Return in words that dates without a zone go on by an hour more in a row, as local time does in spring."""
    moments = " after ".join(np.datetime_as_string(clock[[row, row - 1]], unit="s").tolist())
    return f"{moments}: clocks are set forward so when summer time begins; dates without a zone are taken as UTC"


def backwards_text(clock: np.ndarray, row: int) -> str:
    """Return the time of a row and that of the row before it in words: "3 after 5"."""
    now, before = (f"{t:.10g}" if clock.dtype.kind == "f" else str(t) for t in (clock[row], clock[row - 1]))
    return f"{now} after {before}"
