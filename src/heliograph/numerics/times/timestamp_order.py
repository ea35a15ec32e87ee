"""Order of times: which of them are out of order, and which are of a clock that was not set."""

from bisect import bisect_right

import numpy as np

from heliograph.numerics.types import Bool, Int

SECOND = 10**9  # nanoseconds
YEAR = 365 * 86400 * SECOND  # a stamp that is further from its arrival was not set, or is of another clock
CENTURY = 946_684_800 * SECOND  # 2000-01-01


def find_out_of_order(time: np.ndarray) -> Bool[np.ndarray, " rows"]:
    """Return the mask of the rows that are out of order: the fewest rows without which times do not go backwards.

    If there are several such sets of rows, the later rows are marked. The rows that remain are a longest subsequence
    that does not decrease, found by patience sorting.
    """
    # Times in order, as most are.
    if np.all(time[1:] >= time[:-1]):
        return np.zeros(len(time), dtype=bool)
    # Searched from the end, so that of equally long subsequences the one with the earlier rows remains. Negated times,
    # last row first, do not decrease along a subsequence if and only if the times do not.
    reversed_times = (-time.astype(np.int64) if time.dtype.kind in "Mi" else -time)[::-1].tolist()
    # For each k, among the subsequences of length k + 1 found so far, the least last value and its row. And for each
    # row the row before it in the longest subsequence that ends with it, -1 for none.
    least_ends, end_rows = list[float](), list[int]()
    previous = list[int]()
    for row, value in enumerate(reversed_times):
        length = bisect_right(least_ends, value)  # of the longest subsequence that this row continues
        previous.append(end_rows[length - 1] if length else -1)
        # It is the new end at index `length`: it replaces a larger one there, or makes the longest one longer.
        least_ends[length : length + 1], end_rows[length : length + 1] = [value], [row]
    # All rows are out of order but those of the longest subsequence, from its end back.
    out_of_order = np.ones(len(time), dtype=bool)
    row = end_rows[-1]
    while row >= 0:
        out_of_order[len(time) - 1 - row] = False
        row = previous[row]
    return out_of_order


def find_clock_set_back(time: np.ndarray) -> int | None:
    """Return the first row by which a clock of local time was set back by an hour, as when summer time ends; else None.

    Dates then go from 02:50 to 02:00, if a row comes every ten minutes: back by an hour less a step. Wherever there is
    summer time, it ends on a Sunday, and the clock is set back to an hour before three. If rows come every hour, two
    rows have the same time then. Equal times have other causes too, so that they count only on the last Sunday of
    October and the first Sundays of November and April.

    Args:
        time: dates in the order of the rows, datetime64[ns].
    """
    nanoseconds: Int[np.ndarray, " rows"] = time.astype("datetime64[ns]").astype(np.int64)
    steps: Int[np.ndarray, " steps"] = np.diff(nanoseconds)
    forward = steps[steps > 0]
    if time.dtype.kind != "M" or not forward.size:
        return None
    step, hour = float(np.median(forward)), 3600.0 * SECOND
    most_set_back = 2 * (1 + np.ptp(nanoseconds) // YEAR)
    if step > hour or np.count_nonzero(steps <= 0) > most_set_back:
        return None  # the rows are in no order at all, or share their times
    # Rows whose time is back by an hour less a step, give or take half a step: 0 if the step is an hour.
    is_back_by_an_hour = (steps <= 0) & (np.abs(-steps - (hour - step)) <= step / 2)
    rows = 1 + np.flatnonzero(is_back_by_an_hour)
    is_sunday, month, day = _read_calendar(time[rows])
    is_before_three = time[rows] - time[rows].astype("datetime64[D]") < np.timedelta64(3, "h")
    ends_summer_time = ((month == 10) & (day > 24)) | (np.isin(month, (4, 11)) & (day < 8))
    goes_back = steps[rows - 1] < 0  # where the time is the same, the day must be one on which summer time ends
    found = rows[is_sunday & is_before_three & (goes_back | ends_summer_time)]
    return int(found[0]) if len(found) else None


def find_clock_set_forward(time: np.ndarray) -> int | None:
    """Return the first row by which a clock of local time was set forward, as when summer time begins; else None.

    Dates then go from 01:50 to 03:00, if a row comes every ten minutes: by a step and an hour, and all of that hour,
    the second, third or fourth of the day, is missing. Summer time begins on the second or the last Sunday of March,
    the last of September or the first of October.

    Args:
        time: dates in the order of the rows, datetime64[ns]; numbers are no dates.
    """
    if time.dtype.kind != "M":
        return None
    nanoseconds: Int[np.ndarray, " rows"] = time.astype("datetime64[ns]").astype(np.int64)
    steps: Int[np.ndarray, " steps"] = np.diff(nanoseconds)
    forward = steps[steps > 0]
    if not forward.size:
        return None
    step, hour = float(np.median(forward)), 3600 * SECOND
    # Rows that come a step and an hour after the row before them, give or take half a step.
    skips_an_hour = (np.abs(steps - (hour + step)) <= step / 2) & (step <= hour)
    rows = 1 + np.flatnonzero(skips_an_hour)
    is_sunday, month, day = _read_calendar(time[rows])
    begins_summer_time = (month == 3) & ((day > 24) | ((day > 7) & (day < 15)))
    begins_summer_time |= ((month == 9) & (day > 23)) | ((month == 10) & (day < 8))
    # Times of the day of the row before and of the row: all of the hour from h to h + 1 lies between them.
    midnight = time[rows].astype("datetime64[D]").astype("datetime64[ns]").astype(np.int64)
    before, after = nanoseconds[rows - 1] - midnight, nanoseconds[rows] - midnight
    is_hour_missing = [(before >= 0) & (before < h * hour) & (after >= (h + 1) * hour) for h in (1, 2, 3)]
    found = rows[is_sunday & begins_summer_time & np.any(is_hour_missing, axis=0)]
    return int(found[0]) if len(found) else None


def _read_calendar(time: np.ndarray) -> tuple[Bool[np.ndarray, " rows"], np.ndarray, np.ndarray]:
    """Return whether dates are of a Sunday, their months from 1, and their days of the month from 1."""
    days = time.astype("datetime64[D]")
    months = days.astype("datetime64[M]")
    is_sunday = (days.astype(np.int64) + 4) % 7 == 0  # 1970 began on a Thursday
    return is_sunday, months.astype(np.int64) % 12 + 1, (days - months).astype(np.int64) + 1


def find_unset_stamps(time: np.ndarray, year: float = YEAR) -> Bool[np.ndarray, " events"]:
    """Return the mask of the stamps, in the order of their messages, of a clock that was not set.

    A stamp is the time that the sender's clock showed. A clock that was not set shows a date that is years off.
    Messages are cut into stretches where the stamp jumps by more than a year. A stretch is of an unset clock in two
    cases, if all its stamps are more than a year outside of all others:

    - it lies between two stretches that are less than a year apart and together have more messages;
    - it is the first one, its stamps are of the first year since 1970, where clocks begin to count, and all others are
      of this century.

    Args:
        time: the stamps (events,).
        year: a year in the unit of the stamps (default: in nanoseconds).
    """
    # Stretches of messages, as arrays of their indices, between which the stamp jumps by more than a year.
    stretches = np.split(np.arange(len(time)), np.flatnonzero(np.abs(np.diff(time)) > year) + 1)
    is_candidate = np.zeros(len(time), dtype=bool)
    for before, stretch, after in zip(stretches, stretches[1:], stretches[2:], strict=False):
        jumps_back = abs(int(time[after[0]]) - int(time[before[-1]])) <= year
        is_minority = len(stretch) < len(before) + len(after)
        is_candidate[stretch] = jumps_back and is_minority
    # The first stretch: in the year from which clocks count, while all other stamps are of this century.
    first = stretches[0]
    later = time[len(first) :][~is_candidate[len(first) :]]
    in_first_year = bool(np.all((time[first] >= 0) & (time[first] < year)))
    is_candidate[first] = in_first_year and len(later) > 0 and bool(later.min() >= CENTURY / YEAR * year)
    if not is_candidate.any():
        return is_candidate
    # Candidates are unset if they lie more than a year outside of all others.
    others = time[~is_candidate]
    return np.asarray(is_candidate & ((time < others.min() - year) | (time > others.max() + year)))
