"""Values that repeat for longer than noise allows: a sensor that is stuck, or one that has no noise."""

from typing import NamedTuple

import numpy as np

from heliograph.numerics.types import Float

SELDOM = 1e-4  # expected number of runs as long, from which a longer one is no chance


class HeldValue(NamedTuple):
    """The longest run of equal values of one output.

    Args:
        value: the value.
        first_row: row, from 0, of its first reading.
        readings: number of readings in the run.
        received: number of readings of the output in the whole recording.
    """

    value: float
    first_row: int
    readings: int
    received: int

    def __str__(self) -> str:
        """One line, such as "400 equal values (3.2) from row 1200"."""
        if self.readings == self.received:
            return f"all {self.readings} values are {self.value:g}"
        return f"{self.readings} equal values in a row ({self.value:g}) from row {self.first_row + 1}"


def find_held_value(values: Float[np.ndarray, " time"], variance: Float[np.ndarray, " time"]) -> HeldValue | None:
    """Find the longest run of equal values, if chance makes one as long less than once in 10,000 recordings.

    A reading of resolution q whose innovation has variance S equals the one before it with probability at most
    q / sqrt(2 pi S): q times the greatest density. A run of n then begins at one of N readings with probability at
    most N p^(n - 1). The resolution is the least difference of two values; where all values are equal, p = 1/2.
    A law may repeat a value by itself, as a link that is off gives 0 each time: p is at least the share of the value
    among the readings outside of the run, and the share of those that equal the one before.

    Args:
        values: what was received (time,), NaN where nothing arrived.
        variance: claimed variance of the innovations (time,).
    """
    rows = np.flatnonzero(~np.isnan(values) & (variance > 0))
    if len(rows) < 3:
        return None
    came = values[rows]
    # Runs of equal values: where each begins, and how long it is.
    starts = np.flatnonzero(np.concatenate([[True], came[1:] != came[:-1]]))
    lengths = np.diff(np.concatenate([starts, [len(came)]]))
    longest = int(np.argmax(lengths))
    # The probability that chance repeats a value.
    levels = np.unique(came)
    resolution = float(np.min(np.diff(levels))) if len(levels) > 1 else 0.0
    density = 1 / np.sqrt(2 * np.pi * float(np.median(variance[rows])))
    repeats = (
        max(resolution * density, *_share_outside(came, starts[longest], lengths[longest])) if len(levels) > 1 else 0.5
    )
    if repeats >= 1:
        return None
    expected = np.log(len(came)) + (int(lengths[longest]) - 1) * np.log(max(repeats, 1e-300))
    if lengths[longest] < 3 or expected > np.log(SELDOM):
        return None
    return HeldValue(float(came[starts[longest]]), int(rows[starts[longest]]), int(lengths[longest]), len(came))


def _share_outside(came: Float[np.ndarray, " n"], start: int, length: int) -> tuple[float, float]:
    """Return the share of a run's value outside of it, and the share of readings there that equal the one before."""
    outside = np.ones(len(came), dtype=bool)
    outside[start : start + length] = False
    equal = (came[1:] == came[:-1])[outside[1:] & outside[:-1]]
    return float(np.mean(came[outside] == came[start])), float(np.mean(equal)) if len(equal) else 0.0
