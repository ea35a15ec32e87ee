"""Angles in radians: numbers that mean the same after a full turn, among others that do not."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import fail, items
from heliograph.numerics.traced import library
from heliograph.numerics.types import Array

TURN = 2 * np.pi
A = TypeVar("A", jax.Array, np.ndarray)
Angles = tuple[int, ...]  # which components are angles


def angles_named(name: str, circular: Sequence[str], names: Sequence[str]) -> Angles:
    """Which of the `names` are angles.

    Raises:
        ValueError: a name that there is not, or one given twice.
    """
    given = [str(item) for item in items(name, circular, "names")]
    unknown = [item for item in given if item not in names]
    if unknown or len(set(given)) < len(given):
        raise fail(name, f"some of {list(names)}, each once", given)
    return tuple(i for i, single in enumerate(names) if single in given)


def nearest(value: A, reference: Array, angles: Angles) -> A:
    """The same angles (..., n), full turns taken off so that they are within half a turn of `reference` (..., n).

    What is no angle stays as it is.
    """
    if not angles:
        return value
    xp = library(value, reference)
    turns = xp.round((value - reference) / TURN)
    chosen = np.isin(np.arange(np.shape(value)[-1]), angles) & ~xp.isnan(turns)
    result: A = xp.where(chosen, value - TURN * turns, value)
    return result


def wrapped(value: A, angles: Angles) -> A:
    """Angles between -pi and pi, (..., n)."""
    return nearest(value, np.zeros(np.shape(value)[-1]), angles)


def continued(
    function: Callable[[jax.Array], jax.Array], center: jax.Array, given: Angles, result: Angles
) -> Callable[[jax.Array], jax.Array]:
    """The function with what it finds of angles continued from `center`, so that no jump is taken for a change.

    f(x) is taken near f(center) + D (x - center), D the whole turns that the angles found make with the angles given:
    their derivatives, rounded. So an angle that is a given one and a little more follows it any number of turns, and
    every other is taken within half a turn of that at the center.
    """
    if not result:
        return function
    start, size = function(center), center.shape[0]
    turns = jnp.zeros((*start.shape, size))
    for i in given:
        slope = jax.jvp(function, (center,), (jnp.zeros_like(center).at[i].set(1.0),))[1]
        turns = turns.at[:, i].set(jnp.round(slope))
    return lambda x: nearest(function(x), start + turns @ (x - center), result)
