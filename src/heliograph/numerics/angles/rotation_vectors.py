"""Attitudes as rotation vectors: the group of rotations by three numbers, by NumPy or JAX, without a singular zero.

A rotation vector r turns by |r| radians about its own direction: v in the body is R(r) v in the world, R = exp [r]x.
All products go through unit quaternions q = (w, x, y, z) = (cos |r|/2, sin(|r|/2) r / |r|), which have no singular
attitude. Of a rotation, r with |r| <= pi is the one that is returned.

Source: Sola, Deray and Atchuthan, A micro Lie theory for state estimation in robotics (2018), section IV and example 4.
"""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.types import Array

A = TypeVar("A", jax.Array, np.ndarray)
SMALL = 1e-4  # of a square: below it four terms of a series are exact to the last digit


def _library(*values: object) -> Any:
    """Return jax.numpy if one of the arrays is JAX's, else numpy."""
    return jnp if any(isinstance(value, jax.Array) for value in values) else np


def _entries_of(q: Array) -> tuple[Any, Any, Any, Any]:
    """Return the entries w, x, y and z, each (...), of quaternions (..., 4)."""
    return q[..., 0], q[..., 1], q[..., 2], q[..., 3]


def quaternion_of(r: Array) -> Any:
    """Return the unit quaternions (..., 4) of rotation vectors r (..., 3) in radians, with cos(|r| / 2) first.

    The rest is sin(|r| / 2) / |r| times r. If |r|^2 is below SMALL, series are used, which are exact to rounding there.
    """
    xp = _library(r)
    s = xp.sum(r * r, axis=-1, keepdims=True)  # |r|^2
    is_small = s < SMALL
    half_angle = xp.sqrt(xp.where(is_small, 1.0, s)) / 2
    cosine_by_series = 1 - s / 8 * (1 - s / 48 * (1 - s / 120))
    cosine = xp.where(is_small, cosine_by_series, xp.cos(half_angle))
    factor_by_series = (1 - s / 24 * (1 - s / 80 * (1 - s / 168))) / 2
    factor = xp.where(is_small, factor_by_series, xp.sin(half_angle) / (2 * half_angle))  # sin(|r| / 2) / |r|
    return xp.concatenate([cosine, factor * r], axis=-1)


def rotation_vector_of(q: Array) -> Any:
    """Return the rotation vectors (..., 3), at most pi long, of quaternions q (..., 4) of any length; q and -q are one.

    For q = (w, v), with the real part w, it is 2 atan2(|v|, w) v / |v|. If (|v| / w)^2 is below SMALL, a series is
    used.
    """
    xp = _library(q)
    q = xp.where(q[..., :1] < 0, -q, q)
    w, v = q[..., :1], q[..., 1:]
    s = xp.sum(v * v, axis=-1, keepdims=True)  # |v|^2
    is_small = s < SMALL * w * w
    # For small t = (|v| / w)^2, atan2(|v|, w) / |v| is the series of the arc tangent divided by w.
    length, w_if_small = xp.sqrt(xp.where(is_small, 1.0, s)), xp.where(is_small, w, 1.0)
    t = xp.where(is_small, s, 0.0) / (w_if_small * w_if_small)
    series = (1 - t * (1 / 3 - t * (1 / 5 - t * (1 / 7 - t / 9)))) / w_if_small
    return 2 * v * xp.where(is_small, series, xp.arctan2(length, w) / length)


def multiply_quaternions(q: Array, p: Array) -> Any:
    """Return the product q p of quaternions (..., 4) with the real part first: the turn p followed by q."""
    xp = _library(q, p)
    a, b, c, d = _entries_of(q)
    e, f, g, h = _entries_of(p)
    parts = [
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    ]
    return xp.stack(parts, axis=-1)


def turn(r: Array, by: Array) -> Any:
    """Return attitudes r after a turn `by` in their own (body) axes, log(exp(r) exp(by)): rotation vectors (..., 3)."""
    return rotation_vector_of(multiply_quaternions(quaternion_of(r), quaternion_of(by)))


def turn_between(r: Array, other: Array) -> Any:
    """Return the turn from `other` to r in the axes of `other`, log(exp(-other) exp(r)): rotation vectors (..., 3)."""
    return rotation_vector_of(multiply_quaternions(quaternion_of(-other), quaternion_of(r)))


def matrix_of(r: Array) -> Any:
    """Return the rotation matrices R (..., 3, 3) of rotation vectors (..., 3).

    R times a vector in the body's axes is the same vector in the world's axes.
    """
    xp = _library(r)
    w, x, y, z = _entries_of(quaternion_of(r))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
