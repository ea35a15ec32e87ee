"""Events that are pushed to a timeline, and its verdicts on them."""

from typing import Literal, NamedTuple, get_args

import numpy as np

from heliograph.numerics.check import fail, is_whole, show_value
from heliograph.numerics.masked_arrays import fill_masked
from heliograph.numerics.types import ArrayLike, Float

Verdict = Literal["used", "duplicate", "conflict", "late", "future", "implausible"]
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
WHOLE = "a whole number from 0 to 2^63 - 1"
OF_STEPS = "any times: a plant with the input 'dt', such as LinearPlant(lambda u: F(u[0]), ..., inputs=['dt'])"
# How much later than its arrival an event may have been measured, in seconds or steps: clocks that are set over a
# network agree to some ten milliseconds, over the internet too, and those that do not are wrong by more.
AHEAD = 0.1
INPUTS = "inputs"  # the node whose events are the plant's inputs


class Event(NamedTuple):
    """Measurement of a node at one time. Events of the node "inputs" are the plant's inputs, without "dt".

    Args:
        node: name of the node, or "inputs".
        sequence: the node's running count, from 0.
        time: moment of the measurement, in steps or seconds.
        values: measured values; NaN did not arrive. Shape (received,) of the node.
        arrival: moment of arrival; None means at once.
    """

    node: str
    sequence: int
    time: float
    values: ArrayLike
    arrival: float | None = None


class CheckedEvent(NamedTuple):
    """An event whose parts are checked numbers, with the index of its node in the network, -1 for inputs."""

    node_index: int
    sequence: int
    time: float
    values: list[float]  # NaN where one did not arrive
    arrival: float

    @property
    def is_inputs(self) -> bool:
        """Return whether it holds the plant's inputs, and no measurement of a node."""
        return self.node_index < 0

    @property
    def name(self) -> tuple[int, int, float]:
        """Return what identifies the event: (node, running count, time). Counts alone start again after a reboot."""
        return self.node_index, self.sequence, self.time


def check_63_bits(name: str, value: object) -> int:
    """Return a count as an int; raise ValueError, which calls it `name`, unless it is an integer with 0 <= n < 2^63."""
    if not is_whole(value) or not 0 <= int(value) < 2**63:
        raise fail(name, WHOLE, show_value(value))
    return int(value)


def check_moment(name: str, value: object) -> float:
    """Return a time as a float; raise ValueError, which calls it `name`, unless it is a finite number."""
    if not is_whole(value) and not isinstance(value, float | np.floating):
        raise fail(name, "a finite number", show_value(value))
    if not np.isfinite(value):
        raise fail(name, "a finite number", value)
    return float(value)


def check_numbers(name: str, value: ArrayLike, size: int, alone: int | None = None) -> Float[np.ndarray, " numbers"]:
    """Return a copy of a message's values as doubles, NaN where one did not arrive.

    Args:
        name: what the values are called in errors.
        value: a list or array of numbers; a single number need not stand in a list.
        size: how many numbers there have to be.
        alone: another accepted count: that of values which come without their numbers of lost messages. None if none.

    Raises:
        ValueError: no such array of numbers, another count of them, or an infinite one.
    """
    expected = "1 number" if size == 1 else f"{size} numbers"
    try:
        values = np.array(fill_masked(value))  # NaN for entries that are masked
        if values.dtype.kind not in "fiu":
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        raise fail(name, expected, show_value(value)) from None
    values = values.astype(np.float64)
    values = values[None] if values.ndim == 0 and 1 in (size, alone) else values
    if values.ndim != 1 or len(values) not in (size, alone):
        raise fail(name, expected, f"shape {values.shape}")
    if np.isinf(values).any():
        raise fail(name, "finite numbers, or NaN for what is missing", values.tolist())
    return values
