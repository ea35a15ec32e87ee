"""What is pushed to a timeline, and what it says of it."""

from typing import Literal, NamedTuple, get_args

import numpy as np

from heliograph.numerics.check import fail, shown
from heliograph.numerics.types import ArrayLike, Float

Verdict = Literal["used", "duplicate", "conflict", "late", "future", "implausible"]
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
WHOLE = "a whole number from 0 to 2^63 - 1"
INPUTS = "inputs"  # the node whose events are the plant's inputs


class Event(NamedTuple):
    """What `node` measured at `time`, its number there, and when it was heard (None: at once); NaN did not arrive.

    Those of the node "inputs" are the plant's inputs, without "dt", which a timeline counts itself.
    """

    node: str
    sequence: int
    time: float
    values: ArrayLike
    arrival: float | None = None


class Known(NamedTuple):
    """An event as numbers, with the place of its node in the network, -1 of inputs."""

    place: int
    sequence: int
    time: float
    values: Float[np.ndarray, " size"]
    arrival: float

    @property
    def name(self) -> tuple[int, int, float]:
        """What tells it from others. The time is part of it, since numbers come again after a reboot."""
        return self.place, self.sequence, self.time


def whole(name: str, value: object) -> int:
    """A whole number that counts: from 0, of 63 bits."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not 0 <= int(value) < 2**63:
        raise fail(name, WHOLE, shown(value))
    return int(value)


def moment(name: str, value: object) -> float:
    """A finite number: times are counted from an origin, dates have none."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise fail(name, "a finite number", shown(value))
    if not np.isfinite(value):
        raise fail(name, "a finite number", value)
    return float(value)


def numbers(name: str, value: ArrayLike, size: int) -> Float[np.ndarray, " size"]:
    """A copy of `size` real numbers, NaN where one did not arrive; a single one need not be a list."""
    expected = "1 number" if size == 1 else f"{size} numbers"
    try:
        values = np.array(value)
        if values.dtype.kind not in "fiu":
            raise ValueError
    except ValueError:
        raise fail(name, expected, shown(value)) from None
    values = values.astype(np.float64)
    values = values[None] if values.ndim == 0 and size == 1 else values
    if values.ndim != 1 or len(values) != size:
        raise fail(name, expected, f"shape {values.shape}")
    if np.isinf(values).any():
        raise fail(name, "finite numbers, or NaN for what is missing", values.tolist())
    return values
