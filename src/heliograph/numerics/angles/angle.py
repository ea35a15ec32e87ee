"""Angles in radians: numbers that mean the same after a full turn, among others that do not."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import array, fail, items
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Array

TURN = 2 * np.pi
A = TypeVar("A", jax.Array, np.ndarray)
Angles = tuple[int, ...]  # which components are angles


def read_angles(name: str, circular: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """Return the names that a user listed as `circular`, checked, in the order of the model's `names`.

    Args:
        name: what an error calls the list.
        circular: names of angles.
        names: all names, in the order of the components.
    """
    angles = [str(angle) for angle in items(name, circular, "names")]
    unknown = [angle for angle in angles if angle not in names]
    if unknown or len(set(angles)) < len(angles):
        raise fail(name, f"some of {list(names)}, each once", angles)
    return tuple(component for component in names if component in angles)


def angles_at(angles: object, size: int) -> Angles:
    """Return the indices of angles among `size` components from a user's list; raise ValueError for other numbers."""
    indices = array("angles", items("angles", angles, "places"), (None,)).tolist()
    if not set(indices) <= set(range(size)):
        raise fail("angles", f"places from 0 to {size - 1}", indices)
    return tuple(map(int, indices))


def wrap_near(value: A, reference: Array, angles: Angles) -> A:
    """Return the angles (..., n) changed by full turns so that they lie within half a turn of `reference` (..., n).

    `angles` has the indices of the components that are angles, in radians; all others are unchanged. So is an angle
    where it or its reference is NaN, not known: a difference from NaN says no turns. Arrays may be of NumPy or JAX.
    """
    if not angles:
        return value
    xp = library(value, reference)  # numpy, or jax.numpy where a number is traced
    turns = xp.round((value - reference) / TURN)  # TURN: 2 pi
    is_angle = np.isin(np.arange(np.shape(value)[-1]), angles)
    unwrapped: A = xp.where(is_angle & ~xp.isnan(turns), value - TURN * turns, value)
    return unwrapped


def wrap_angles(value: A, angles: Angles) -> A:
    """Return angles (..., n) between -pi and pi; other components are unchanged."""
    return wrap_near(value, np.zeros(np.shape(value)[-1]), angles)


def continue_angles(
    function: Callable[[jax.Array], jax.Array], center: jax.Array, given: Angles, angles: Angles
) -> Callable[[jax.Array], jax.Array]:
    """Return the function with its angular results continued from `center`, so that no jump counts as a change.

    f(x) is taken near f(center) + D (x - center). D is the Jacobian of resulting angles by given angles, rounded to
    whole turns. An angle that follows a given angle thus makes any number of turns with it, and every other angle is
    taken within half a turn of its value at the center. `given`: indices of angles in x. `angles`: indices of angles in
    f(x).
    """
    if not angles:
        return function
    value_at_center, size = function(center), center.shape[0]
    D = jnp.zeros((*value_at_center.shape, size))
    for i in given:
        direction = jnp.zeros_like(center).at[i].set(1.0)
        slope = jax.jvp(function, (center,), (direction,))[1]
        D = D.at[:, i].set(jnp.round(slope))
    return lambda x: wrap_near(function(x), value_at_center + D @ (x - center), angles)


def find_wraps(values: Array, most: float) -> np.ndarray:
    """Return the rows before which an angle wraps around: from near pi to near -pi, or back.

    Values (time,) count as such an angle if they never leave +-`most`, and some neighbours are more than pi apart.
    """
    values = np.asarray(values)
    jumps = np.flatnonzero(np.abs(np.diff(values)) > TURN / 2) + 1
    return jumps if jumps.size and np.nanmax(np.abs(values)) <= most + 1e-9 else jumps[:0]


def insert_gaps(time: Array, rows: np.ndarray, *parts: Array) -> tuple[np.ndarray, ...]:
    """Return times and what is drawn over them, each (time,), with a NaN before each of `rows`, so that a curve breaks.

    The time of such an entry is that of its row.
    """
    time = np.asarray(time)
    return np.insert(time, rows, time[rows]), *(np.insert(np.asarray(part), rows, np.nan) for part in parts)
