"""Attitudes as states: rotation vectors turned, and as rotation matrices and unit quaternions."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.angles.rotation_vectors import matrix_of, quaternion_of, rotation_vector_of, turn
from heliograph.numerics.check import array, fail
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.types import Array, ArrayLike, Float


def turn_attitude(attitude: Float[ArrayLike, "*any 3"], by: Float[ArrayLike, "*any 3"]) -> Float[Array, "*any 3"]:
    """Return an attitude turned in its own axes: log(exp(attitude) exp(by)), a rotation vector of at most pi.

    With a gyroscope's rate it is r+ = turn_attitude(r, rate * dt), which is exact if the rate is constant in the body's
    axes. It is for the transition of a plant with `attitude=`, and for arrays.

    Args:
        attitude: rotation vector in radians, R = exp [r]x from body to world. Shape (..., 3).
        by: the turn in the body's axes, in radians. Shape (..., 3).

    Raises:
        ValueError: arrays of another shape.
    """
    turned: Array = turn(_read_coordinates("attitude", attitude, 3), _read_coordinates("turn of an attitude", by, 3))
    return turned


def rotation_matrix(attitude: Float[ArrayLike, "*any 3"]) -> Float[Array, "*any 3 3"]:
    """Return R = exp [r]x of an attitude r, which turns vectors from the body's axes to the world's, and R' back.

    Args:
        attitude: rotation vector in radians. Shape (..., 3).

    Raises:
        ValueError: an array of another shape.
    """
    matrix: Array = matrix_of(_read_coordinates("attitude", attitude, 3))
    return matrix


def to_quaternion(attitude: Float[ArrayLike, "*any 3"]) -> Float[Array, "*any 4"]:
    """Return the unit quaternion (w, x, y, z) of an attitude; w >= 0 for rotation vectors of at most half a turn.

    Args:
        attitude: rotation vector in radians, as estimates have it. Shape (..., 3).

    Raises:
        ValueError: an array of another shape.
    """
    quaternion: Array = quaternion_of(_read_coordinates("attitude", attitude, 3))
    return quaternion


def from_quaternion(quaternion: Float[ArrayLike, "*any 4"]) -> Float[Array, "*any 3"]:
    """Return the attitude of a quaternion (w, x, y, z) of any length, as a rotation vector of at most pi.

    Args:
        quaternion: w first; q and -q are one attitude. Shape (..., 4).

    Raises:
        ValueError: an array of another shape, a quaternion of length 0.
    """
    values = _read_coordinates("quaternion", quaternion, 4)
    largest = abs(values).max(axis=-1, keepdims=True)
    if not is_traced(values) and not largest.all():
        raise fail("quaternion", "four numbers of which one is not 0", "all of them 0")
    attitude: Array = rotation_vector_of(values / largest)  # scaled so that no square overflows or underflows
    return attitude


def _read_coordinates(name: str, value: ArrayLike, last: int) -> Any:
    """Return coordinates of shape (..., last): a JAX array as it is, which may be traced, anything else as doubles.

    NaN stands for a missing coordinate and is allowed. `name`: what the array is called in errors.

    Raises:
        ValueError: an array whose last axis has another length, or one that is no array of numbers.
    """
    if isinstance(value, jax.Array):
        coordinates = value
    else:
        try:
            coordinates = array(name, value, (None,) * np.ndim(value), missing=True)  # None: an axis of any length
        except (TypeError, ValueError):
            coordinates = array(name, value, (last,), missing=True)  # raises with the reason
    shape = jnp.shape(coordinates)
    if shape[-1:] != (last,):
        raise fail(name, f"shape (..., {last})", f"shape {shape}")
    return coordinates
