"""Senders with a rate of their own among rows of another rate, distinguished from losses by a test against chance."""

from typing import NamedTuple

import numpy as np

from heliograph.numerics.types import Bool, Float, Int
from heliograph.report.diagnosis.sending_pattern import CHANCE, BurstLossLaw

PEAKS = 8  # of the spectrum of arrivals that are looked at
FEWEST = 8  # arrivals from which a rate is looked for
ENOUGH = 20_000  # rows that decide
ROUNDING = 1e-9  # periods: the arrivals at both ends of the interval of phases are in it
STEPS = 18  # of the bisection for a rate
PARAMETERS = 5  # of a rate: it, phase, width, first and last row; N rows distinguish some N values of each
OFF = 0.25  # periods by which the interval of phases at a peak of the spectrum is too wide, at most


class SendingRate(NamedTuple):
    """A sender that is due once in each `period` rows, a real number; `slots` numbers the arrivals among what was due.

    Shapes: slots (arrivals,).
    """

    period: float
    slots: Int[np.ndarray, " arrivals"]


class _PeriodicRows(NamedTuple):
    """Rows r that come right after a multiple of the period: frac(frequency r - start) <= width."""

    frequency: float  # periods per row
    start: float  # phase of the earliest row in its period
    width: float  # of the interval of phases, in periods

    def phases(self, rows: Int[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
        """Return the phase of each row, frequency r - start, in periods; its integer part numbers the period."""
        return np.asarray(self.frequency * rows - self.start)

    def number_periods(self, rows: Int[np.ndarray, " rows"]) -> Int[np.ndarray, " rows"]:
        """Return the number of the period in which each row is, the integer part of its phase."""
        return np.asarray(np.floor(self.phases(rows)), dtype=np.int64)


def find_rate(arrived: Bool[np.ndarray, " time"]) -> SendingRate | None:
    """Return the rate of a sender with its own clock, or None if random losses alone could explain the empty rows.

    A sender that is due each T rows, where T is no integer, comes in the rows r with frac(r / T - phase) < 1 / T, with
    frac the fractional part. All other rows are empty. If T is hardly above 1, empty rows are rare, and are found by
    their own rate: one each 1 / (1 - 1 / T) rows, none missing. `slots` in the result: number of each arrival among the
    messages due. `_find_slowest_rate` does this for periods that leave many rows empty. `period` is in rows.
    """
    rate = _find_slowest_rate(arrived)
    if rate is not None:
        return rate
    rows = np.flatnonzero(arrived)
    rate_of_empty = _find_slowest_rate(~arrived[rows[0] : rows[-1]]) if len(rows) else None
    if rate_of_empty is None or np.any(np.diff(rate_of_empty.slots) > 1):
        return None
    return SendingRate(period=1 / (1 - 1 / rate_of_empty.period), slots=np.arange(np.count_nonzero(arrived)))


def _find_slowest_rate(arrived: Bool[np.ndarray, " time"]) -> SendingRate | None:
    """Return the slowest rate whose due rows hold all arrivals, if losses in bursts would hardly leave it; else None.

    A sender with its own clock sends at a rate below that of the rows, so that some rows are empty without a loss. It
    may begin late and fall silent: the rows from its first arrival to its last decide, up to ENOUGH. Then the phases of
    arrivals (row times frequency, less whole periods) lie in a narrow interval, and rows whose phase is in it are due.
    A rate is accepted if losses in bursts would leave all other rows empty with a probability below CHANCE. `slots` of
    the result numbers the periods of the arrivals from 0. FEWEST is 8 arrivals; N rows distinguish some N values of
    each of a rate's PARAMETERS (5).
    """
    rows = np.flatnonzero(arrived)
    span = 1 + int(np.ptp(rows)) if len(rows) else 0  # rows from the first arrival to the last
    # Nothing to find in few arrivals, or where each row has one.
    came_in_each_row = len(rows) == span
    if len(rows) < FEWEST or came_in_each_row:
        return None
    # Law of losses in bursts, the alternative explanation of empty rows.
    loss_law = BurstLossLaw.fit_to_intervals(np.diff(rows))
    found: SendingRate | None = None
    deciding_rows = rows[0] + np.arange(min(span, ENOUGH))
    arrivals_after_first = int(np.sum(rows <= deciding_rows[-1])) - 1
    # Many rates are possible, and any would have been taken, so the chance of one is multiplied by their number.
    log_number_of_rates = PARAMETERS * np.log(len(arrived))
    for frequency in _find_likely_frequencies(arrived):
        # The frequency nearby, and the interval of phases of this width, that hold all arrivals; None if none does.
        due_rows = _fit_rate(frequency, rows)
        if due_rows is None:
            continue
        is_due = np.mod(due_rows.phases(deciding_rows) + ROUNDING, 1) <= due_rows.width + 2 * ROUNDING
        log_chance = loss_law.log_chance_within(is_due, arrivals_after_first) + log_number_of_rates
        # If a frequency passes, its multiples do too: the sender's is the least.
        if log_chance < np.log(CHANCE) and (found is None or due_rows.frequency < 1 / found.period):
            slots = due_rows.number_periods(rows)
            found = SendingRate(period=1 / due_rows.frequency, slots=slots - slots[0])
    return found


def _fit_rate(frequency: float, rows: Int[np.ndarray, " arrivals"]) -> _PeriodicRows | None:
    """Return the due rows of a sender near a frequency (in periods per row), or None if the arrivals' rows do not fit.

    Each arrival has to be in a period of its own. `width` of the result is the length of the interval of phases, in
    periods; OFF (0.25) is how much wider it may be at the given frequency than at the best one near it.
    """
    # Due rows have phases in an interval of length 1 / T = frequency: about the rest of the circle is empty.
    middle, gap = _find_largest_gap(frequency, rows)
    if gap < 1 - frequency - OFF:
        return None
    due_rows = _fit_periodic_rows(frequency, rows, middle)
    if due_rows.width >= 1 or np.any(np.diff(due_rows.number_periods(rows)) < 1):
        return None
    return due_rows


def _find_likely_frequencies(arrived: Bool[np.ndarray, " time"]) -> list[float]:
    """Return frequencies to look at, in periods a row: of usual intervals, and of the largest peaks of the spectrum.

    Of the spectrum of what arrived the PEAKS (8) largest count. It does not tell f from 1 - f: both are returned.
    """
    intervals = np.diff(np.flatnonzero(arrived))
    # The next power of two, times four: the zeros behind the data make the frequencies of the spectrum close.
    size = 4 * 2 ** int(np.ceil(np.log2(len(arrived))))
    spectrum = np.abs(np.fft.rfft(arrived - np.mean(arrived), size))
    inner = spectrum[1:-1]  # without the first and the last
    has_risen, will_fall = inner >= spectrum[:-2], inner > spectrum[2:]
    is_peak = has_risen & will_fall
    peaks = 1 + np.flatnonzero(is_peak)
    largest_first = peaks[np.argsort(spectrum[peaks])[::-1]]
    frequencies = [1 / float(np.median(intervals)), 1 / float(np.mean(intervals))]
    for f in (largest_first[:PEAKS] / size).tolist():
        frequencies += [f, 1 - f]
    return frequencies


def _find_largest_gap(frequency: float, rows: Int[np.ndarray, " arrivals"]) -> tuple[float, float]:
    """Return the middle and the length of the largest part of a period in which no arrival falls.

    The period is a circle of length 1. `frequency` is in periods per row, and `rows` holds the rows of the arrivals.
    """
    phases = np.sort(np.mod(frequency * rows, 1))
    gaps = np.diff(phases, append=phases[0] + 1)  # the last one goes around the circle, to the first phase
    largest = int(np.argmax(gaps))
    return float(phases[largest] + gaps[largest] / 2), float(gaps[largest])


def _fit_periodic_rows(frequency: float, rows: Int[np.ndarray, " arrivals"], middle: float) -> _PeriodicRows:
    """Return the rows of the sender's period near `frequency` that hold all arrivals with the least width of phases.

    The phase of the arrival in row r is f r - k, with k the number of its period at the given frequency, which is kept.
    Then the width max(phase) - min(phase) is a convex function of f. Its slope is the distance between the rows of the
    largest and the least phase, so bisection finds the minimum. STEPS, 18, halve the interval often enough.

    Args:
        frequency: an approximate frequency, in periods per row.
        rows: rows of the arrivals.
        middle: phase in the middle of the largest gap between arrivals' phases, where periods are counted from.
    """
    whole_periods = np.floor(frequency * rows - middle)  # of each arrival, counted from the middle of the gap
    low, high = frequency - 1 / np.ptp(rows), frequency + 1 / np.ptp(rows)
    for _ in range(STEPS):
        best = (low + high) / 2
        phases = best * rows - whole_periods
        low, high = (best, high) if rows[phases.argmax()] < rows[phases.argmin()] else (low, best)
    phases = (low + high) / 2 * rows - whole_periods
    least = float(phases.min())
    return _PeriodicRows(frequency=(low + high) / 2, start=least, width=float(phases.max()) - least)
