"""Limits of a sensor's range, and codes by which a sensor reports that it failed."""

from collections.abc import Sequence

import numpy as np
from typing_extensions import TypeAliasType

from heliograph.numerics.check import fail, show_value
from heliograph.numerics.module import Module
from heliograph.numerics.types import ArrayLike, Bool, Float

ROUNDING = 4 * float(np.finfo(np.float64).eps)  # of a product and of the factor in it, relative

SINGLE = float(np.finfo(np.float32).eps) / 2  # of a number in single precision, relative

LimitsLike = TypeAliasType("LimitsLike", "ArrayLike | Sequence[Sequence[float | None]] | Limits | None")


def limits_of(received: int, limits: LimitsLike, invalid: ArrayLike) -> "Limits | None":
    """Return the limits of so many received numbers; those of another node as they are; None where there are none."""
    codes = _read_numbers("invalid values", invalid)
    if isinstance(limits, Limits):
        if len(limits.low) != received or codes.size:
            got = f"those of {len(limits.low)}" + " and further codes" * bool(codes.size)
            raise fail("limits of another node", f"those of {received} received numbers, codes included", got)
        return limits
    return None if limits is None and codes.size == 0 else Limits(received, limits, invalid)


class Limits(Module):
    """Received numbers that count as missing: those below `low` or above `high`, and those equal to a code.

    A number is equal to a code up to the rounding of a product, since sensors send whole numbers that are scaled, or if
    it is the code in single precision, in which many sensors send.

    Args:
        received: length m of a measurement.
        limits: lowest and highest valid number of each component; None for no limits. Stored as low and high (m,), with
            -inf and inf where there is none.
        invalid: codes (codes,) that are no measurements.
    """

    low: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]
    invalid: Float[np.ndarray, " codes"]

    def __init__(self, received: int, limits: LimitsLike = None, invalid: ArrayLike = ()):
        pairs = _read_intervals(limits, received)
        self.low, self.high = pairs[:, 0], pairs[:, 1]
        codes = _read_numbers("invalid values", invalid)
        if codes.ndim > 1 or not np.all(np.isfinite(codes)):
            raise fail("invalid values", "a finite number or several", show_value(invalid))
        self.invalid = np.atleast_1d(codes)

    @property
    def bounded(self) -> bool:
        """Whether a number may count as missing for its size, which tells of the state as a code does not."""
        return bool(np.any(np.isfinite(self.low)) or np.any(np.isfinite(self.high)))

    def outside(self, z: Float[np.ndarray, "... m"]) -> Bool[np.ndarray, "... m"]:
        """Return True for each number that counts as missing; NaN is not one of them."""
        return np.asarray((z < self.low) | (z > self.high) | is_code(z, self.invalid))

    def why(self, z: Float[np.ndarray, " m"], names: Sequence[str]) -> str:
        """Describe in words the components of a measurement that count as missing; "" if there are none."""
        said = []
        for i in np.flatnonzero(self.outside(z)).tolist():
            code = is_code(z[i], self.invalid)
            said.append(
                f"{names[i]} {z[i]:g} " + ("is a code" if code else f"is outside {self.low[i]:g} to {self.high[i]:g}")
            )
        return ", ".join(said)


def is_code(z: ArrayLike, codes: Float[np.ndarray, " codes"]) -> Bool[np.ndarray, "..."]:
    """Return whether each number is a code, up to the rounding of a product, or as single precision has it."""
    numbers = np.asarray(z, dtype=np.float64)[..., None]
    if not len(codes):
        return np.zeros(numbers.shape[:-1], dtype=bool)
    # Whole numbers are exact in both precisions, but for the largest.
    with np.errstate(over="ignore"):
        single = codes.astype(np.float32).astype(np.float64)
    rounding = np.where(codes == np.round(codes), ROUNDING, SINGLE) * np.abs(codes)
    near = (np.abs(numbers - codes) <= rounding) | (numbers == single)
    return np.asarray(near.any(axis=-1))


def _read_intervals(limits: LimitsLike, received: int) -> Float[np.ndarray, "m 2"]:
    """Return (low, high) for each received number, infinite where there is no limit."""
    everything = [-np.inf, np.inf]
    if limits is None:
        return np.tile(everything, (received, 1))
    expected = f"(low, high), or such a pair for each of {received} received numbers, None where there is no limit"
    try:
        values = np.asarray(limits, dtype=object)
    except (TypeError, ValueError):
        raise fail("limits", expected, show_value(limits)) from None
    if values.shape not in ((2,), (received, 2)):
        raise fail("limits", expected, show_value(limits))
    rows = np.tile(values, (received, 1)) if values.ndim == 1 else values
    pairs = [[end if bound is None else bound for bound, end in zip(row, everything, strict=True)] for row in rows]
    intervals = _read_numbers("limits", pairs, expected)
    if np.any(~(intervals[:, 0] < intervals[:, 1])):
        raise fail("limits", "a low end below the high one", show_value(limits))
    return intervals


def _read_numbers(name: str, value: object, expected: str = "numbers") -> Float[np.ndarray, "..."]:
    """Return real numbers as an array of doubles, or raise one line."""
    try:
        values = np.asarray(value)
        if values.size and values.dtype.kind not in "fiu":
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        raise fail(name, expected, show_value(value)) from None
    return values.astype(np.float64)
