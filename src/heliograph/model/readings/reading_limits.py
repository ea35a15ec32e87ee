"""Limits of a sensor's range, codes by which a sensor reports that it failed, and readings that are stuck."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from typing_extensions import TypeAliasType

from heliograph.model.channel import Channel
from heliograph.model.channel_side_information import separate_told_numbers
from heliograph.model.checks.refusal_reasons import Reason, number_of_reason
from heliograph.model.over_time import first
from heliograph.model.readings.limit_arguments import read_intervals, read_numbers
from heliograph.model.readings.repeated_readings import Repeats, StuckLike, count_repeats, find_stuck_counts
from heliograph.model.sensor import AnySensor
from heliograph.numerics.check import fail, show_value
from heliograph.numerics.module import Module
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Array, ArrayLike, Bool, Float, Int

ROUNDING = 4 * float(np.finfo(np.float64).eps)  # of a product and of the factor in it, relative

SINGLE = float(np.finfo(np.float32).eps) / 2  # of a number in single precision, relative

FIRST = Repeats()  # before the first reading

LimitsLike = TypeAliasType("LimitsLike", "ArrayLike | Sequence[Sequence[float | None]] | ReadingLimits | None")


def make_limits(
    received: int,
    limits: LimitsLike,
    invalid: ArrayLike,
    stuck: StuckLike = None,
    sensor: AnySensor | None = None,
    channel: Channel | None = None,
) -> "ReadingLimits | None":
    """Return a node's rule of which received numbers count as missing, or None if it has none.

    Args:
        received: how many numbers are received.
        limits: lowest and highest valid numbers, None for no limits, or the whole rule of another node, which is
            returned as it is. One pair is for the measured values, not for what is told about the link.
        invalid: codes that are no readings.
        stuck: after how many equal readings a sensor counts as stuck (`find_stuck_counts`); True: by the noise and
            resolution of the `sensor`.
        sensor: the node's sensor, None where there is none.
        channel: its channel, which must deliver readings as they are if `stuck` is True, and which says what of the
            received numbers are values.

    Raises:
        ValueError: limits of another number of readings, or further codes beside those of another node.
    """
    codes, values = read_numbers("invalid values", invalid), _find_values(received, channel)
    counts = find_stuck_counts(received, stuck, sensor, channel, values)
    if isinstance(limits, ReadingLimits):
        if len(limits.low) != received or codes.size or counts is not None:
            more = " and further codes" * bool(codes.size) + " and stuck=" * (counts is not None)
            got = f"those of {len(limits.low)}{more}"
            raise fail("limits of another node", f"those of {received} received numbers, codes and stuck included", got)
        return limits
    if limits is None and codes.size == 0 and counts is None:
        return None
    return ReadingLimits(received, limits, invalid, counts, values)


def _find_values(received: int, channel: Channel | None) -> Sequence[int]:
    """Return which of the received numbers are measured values: those that the channel's link delivers.

    The others are told about the link: its gain, what a message declares, how many messages were lost. Without a
    channel all count as values.
    """
    return range(received) if channel is None else separate_told_numbers(first(channel)).values


class ScreenedReadings(NamedTuple):
    """Readings without those that count as missing.

    Args:
        values: the readings (time, m), NaN where one counts as missing.
        refused: the number of each one's reason (`model.checks.refusal_reasons`), 0 where it is kept (time, m).
        repeats: runs of equal readings that end with the last ones.
    """

    values: Float[np.ndarray, "time m"]
    refused: Int[np.ndarray, "time m"]
    repeats: Repeats

    def by(self, reason: Reason) -> Bool[np.ndarray, "time m"]:
        """Return which readings are refused for this reason, such as "limits", "code" or "stuck" (time, m)."""
        return np.asarray(self.refused == number_of_reason(reason))


class ReadingLimits(Module):
    """Received numbers that count as missing: below `low` or above `high`, equal to a code, or repeated for too long.

    A number is equal to a code up to the rounding of a product, since sensors send whole numbers that are scaled, or if
    it is the code in single precision, in which many sensors send.

    Args:
        received: length m of a measurement.
        limits: lowest and highest valid number of each component, or of all `values`; None for no limits. Stored as low
            and high (m,), with -inf and inf where there is none.
        invalid: codes (codes,) that are no measurements.
        stuck: after how many equal readings in a row one counts as missing (m,), infinite for those that may repeat;
            None where all may.
        values: which components are measured values; None: all.
    """

    low: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]
    invalid: Float[np.ndarray, " codes"]
    stuck: Float[np.ndarray, " m"] | None

    def __init__(
        self,
        received: int,
        limits: LimitsLike = None,
        invalid: ArrayLike = (),
        stuck: Float[np.ndarray, " m"] | None = None,
        values: Sequence[int] | None = None,
    ):
        """Check and hold which received numbers count as missing: beyond limits, codes, or repeated too often.

        Args:
            received: length m of a measurement.
            limits: (low, high) for all values or for each component; None for no limits.
            invalid: codes that are no measurements, a number or several.
            stuck: for each component, how many equal readings in a row count as missing from then on; None for no such
                rule.
            values: which components are measured values, which one pair of limits is for; None: all.
        """
        intervals = read_intervals(limits, received, values=values)
        self.low, self.high = intervals[:, 0], intervals[:, 1]
        codes = read_numbers("invalid values", invalid)
        if codes.ndim > 1 or not np.all(np.isfinite(codes)):
            raise fail("invalid values", "a finite number or several", show_value(invalid))
        self.invalid, self.stuck = np.atleast_1d(codes), stuck

    @property
    def bounded(self) -> bool:
        """Whether a number may count as missing for its value, which tells of the state as a code does not."""
        return self.has_range or self.stuck is not None  # a run of equal readings is found by their values too

    @property
    def has_range(self) -> bool:
        """Whether some number counts as missing below or above a limit."""
        return bool(np.any(np.isfinite(self.low)) or np.any(np.isfinite(self.high)))

    def screen(self, z: Float[np.ndarray, "time m"], before: Repeats = FIRST) -> ScreenedReadings:
        """Return the readings without those that count as missing, from runs of equal readings before them (`before`).

        A reading is missing if it is beyond the limits, or is a code; neither ends a run of equal readings.
        `self.stuck`: the number of equal readings in a row from which a component counts as missing; None if runs are
        not counted.
        """
        refused = np.asarray(self.find_refusal_reasons(z))
        values = np.where(refused > 0, np.nan, z)
        if self.stuck is None:
            return ScreenedReadings(values, refused, before)
        counts, repeats = count_repeats(values, before)
        is_stuck = counts >= self.stuck
        refused = np.where(is_stuck, number_of_reason("stuck"), refused)
        return ScreenedReadings(np.where(is_stuck, np.nan, values), refused, repeats)

    def find_refusal_reasons(self, z: Float[Array, "... m"]) -> Int[Array, "... m"]:
        """Return the number of the reason for which each value by itself counts as missing, or 0 if it does not.

        A code is a value of `self.invalid`, such as -999, that stands for no reading; it counts as a code even beyond
        the limits (`self.low`, `self.high`). NaN is missing already and has no reason.
        """
        xp = library(z)
        is_beyond = (z < self.low) | (z > self.high)
        refused_by_limits = xp.where(is_beyond, number_of_reason("limits"), 0)
        reasons: Array = xp.where(equals_code(z, self.invalid), number_of_reason("code"), refused_by_limits)
        return reasons

    def outside(self, z: Float[Array, "... m"]) -> Bool[Array, "... m"]:
        """Return True for each number that by itself counts as missing; NaN is not one of them."""
        is_outside: Array = self.find_refusal_reasons(z) > 0
        return is_outside

    def describe_missing(self, z: Float[np.ndarray, " m"], refused: Int[np.ndarray, " m"], names: Sequence[str]) -> str:
        """Return in words which components of a measurement are refused, and why, or "" if none is.

        Args:
            z: the measurement, with the readings that are refused.
            refused: the number of each component's reason, 0 if it is kept, as `screen` returns it.
            names: names of the components.
        """
        descriptions = []
        for i in np.flatnonzero(refused).tolist():
            if refused[i] == number_of_reason("code"):
                reason = "is a code"
            elif refused[i] == number_of_reason("limits"):
                reason = f"is outside {self.low[i]:g} to {self.high[i]:g}"
            else:
                assert self.stuck is not None
                reason = f"is stuck: {self.stuck[i]:g} equal readings in a row or more"
            descriptions.append(f"{names[i]} {z[i]:g} {reason}")
        return ", ".join(descriptions)


def equals_code(z: ArrayLike, codes: Float[np.ndarray, " codes"]) -> Bool[Array, "..."]:
    """Return whether each number of z (...) is one of some codes, numbers such as -999 that stand for no reading.

    A number counts as the code if it differs by the rounding of a product, as where a device scales whole numbers, or
    if it is the code as single precision stores it.
    """
    xp = library(z)
    numbers = xp.asarray(z, dtype=float)[..., None]  # compared with all codes along a last axis
    if not len(codes):
        return np.zeros(numbers.shape[:-1], dtype=bool)
    # ROUNDING, SINGLE: relative rounding of a product of doubles, and of a number in single precision. All but the
    # largest whole numbers are exact in both.
    with np.errstate(over="ignore"):
        single = codes.astype(np.float32).astype(np.float64)
    rounding = np.where(codes == np.round(codes), ROUNDING, SINGLE) * np.abs(codes)
    is_code = (xp.abs(numbers - codes) <= rounding) | (numbers == single)
    is_some_code: Array = is_code.any(axis=-1)
    return is_some_code
