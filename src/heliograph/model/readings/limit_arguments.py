"""Limits as users give them, read as intervals (low, high): of received numbers, and of a plant's states."""

from collections.abc import Mapping, Sequence

import numpy as np
from typing_extensions import TypeAliasType

from heliograph.numerics.check import fail, show_value
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.types import Array, Float

StateLimits = tuple[tuple[str, tuple[float, float]], ...]  # of each limited state its name, lowest and highest value
StateLimitsLike = TypeAliasType("StateLimitsLike", "Mapping[str, Sequence[float | None]] | StateLimits")


def read_intervals(
    limits: object, received: int, name: str = "limits", values: Sequence[int] | None = None
) -> Float[np.ndarray, "m 2"]:
    """Return (low, high) for each received number, infinite where there is no limit, from limits as users give them.

    Args:
        limits: (low, high) for all measured values, or such a pair for each received number, None in place of an end
            without a limit; None for no limits.
        received: how many numbers are received.
        name: what the limits are called in errors.
        values: which of them are measured values; others are told about the link, such as its gain. None (default):
            all.

    Raises:
        ValueError: what is no such pair or list of pairs, a low end that is not below the high one.
    """
    no_limits = [-np.inf, np.inf]
    if limits is None:
        return np.tile(no_limits, (received, 1))
    expected = f"(low, high), or such a pair for each of {received} received numbers, None where there is no limit"
    try:
        pairs_given = np.asarray(limits, dtype=object)
    except (TypeError, ValueError):
        raise fail(name, expected, show_value(limits)) from None
    if pairs_given.shape not in ((2,), (received, 2)):
        raise fail(name, expected, show_value(limits))
    pair_for_all = pairs_given.ndim == 1
    rows = np.tile(pairs_given, (received, 1)) if pair_for_all else np.array(pairs_given)
    if pair_for_all and values is not None:  # what is told about the link has no such limits
        rows[[i for i in range(received) if i not in values]] = None
    pairs = [[end if bound is None else bound for bound, end in zip(row, no_limits, strict=True)] for row in rows]
    intervals = read_numbers(name, pairs, expected)
    if np.any(~(intervals[:, 0] < intervals[:, 1])):
        raise fail(name, "a low end below the high one", show_value(limits))
    return intervals


def read_numbers(name: str, value: object, expected: str = "numbers") -> Float[np.ndarray, "..."]:
    """Return a user's real numbers as an array of doubles.

    Args:
        name: what the value is called in errors.
        value: a number, or numbers in any nesting; texts, truth values and ragged lists are refused.
        expected: what is said in errors to be expected.

    Raises:
        ValueError: anything but real numbers.
    """
    try:
        values = np.asarray(value)
        if values.size and values.dtype.kind not in "fiu":  # neither floats nor whole numbers, signed or not
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        raise fail(name, expected, show_value(value)) from None
    return values.astype(np.float64)


def read_state_limits(
    limits: StateLimitsLike, states: Sequence[str], circular: Sequence[str], initial_mean: Array
) -> StateLimits:
    """Return the limits of a plant's states in their order, infinite where there is none; () for no limits.

    Such limits are known bounds of a state, as of a level between 0 and 1; a filter keeps its estimates within them.
    States without a limit are left out of the result.

    Args:
        limits: {state: (lowest, highest value)}, with None in place of a value that has no limit.
        states: names of the states.
        circular: names of the states that are angles, which have no limits.
        initial_mean: mean of the state at the start (n,), which must lie within them.

    Raises:
        ValueError: what is no such table, a name that is no state or an angle, a start that they exclude.
    """
    # Read the table: its keys must be states that are no angles.
    expected = 'a table such as {"soc": (0, 1), "speed": (0, None)}'
    try:
        given = dict(limits)
    except (TypeError, ValueError):
        raise fail("limits of states", expected, show_value(limits)) from None
    no_angles = [str(name) for name in states if name not in circular]
    for name in given:
        if name not in no_angles:
            raise fail("limits of states", f"names of states that are no angles, {no_angles}", show_value(name))
    # Read each interval: it must hold the initial mean (unless JAX traces this); infinite intervals are left out.
    read = []
    for i, name in enumerate(states):
        if name not in given:
            continue
        (interval,) = read_intervals([given[name]], 1, f"limits of {name!r}")
        low, high = interval.tolist()
        if not is_traced(initial_mean):
            mean = float(initial_mean[i])
            if not low <= mean <= high:
                raise fail(f"limits of {name!r}", f"an initial mean within {low:g} to {high:g}", f"{mean:g}")
        if np.isfinite([low, high]).any():
            read.append((str(name), (low, high)))
    return tuple(read)
