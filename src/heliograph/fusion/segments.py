"""Equal segments of [-d, d]: the segment of a number, and its midpoint."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import array, check_count, fail
from heliograph.numerics.traced import is_traced
from heliograph.numerics.types import Array, ArrayLike, Float

Parameter = Float[Array, "..."]  # of all components, or of each


def segment_of(x: Float[jax.Array, "*n"], amplitude: Parameter, levels: Float[Array, ""]) -> Float[jax.Array, "*n"]:
    """Index, from 0, of the segment of [-amplitude, amplitude] that holds x."""
    return jnp.clip(jnp.floor((x / amplitude + 1) * levels / 2), 0, levels - 1)


def midpoint(segment: Array, amplitude: Parameter, levels: Float[Array, ""]) -> Float[jax.Array, "*n"]:
    """Midpoint of a segment; exactly zero for the middle one of an odd number.

    The amplitude's power of two is factored out, which changes no bit, or its product with many levels would overflow.
    """
    fraction, power = jnp.frexp(jnp.asarray(amplitude))
    return jnp.ldexp((2 * segment + 1 - levels) * fraction / levels, power)


def levels_of(value: int) -> Float[np.ndarray, ""]:
    """Return the number of segments, at least two, as a float."""
    check_count("levels", value, 2)
    return np.asarray(value, dtype=np.float64)


def parameter(name: str, value: ArrayLike) -> Parameter:
    """Return a parameter as a number, or as one number per component."""
    several = isinstance(value, Sequence) or np.ndim(value) > 0
    numbers: Parameter = array(name, value, (None,) if several else ())
    return numbers


def positive(name: str, value: ArrayLike) -> Parameter:
    """Return a parameter that is positive."""
    checked = parameter(name, value)
    if not isinstance(checked, jax.Array) and np.any(checked <= 0):
        raise fail(name, "positive numbers", value)
    return checked


def check_range(name: str, amplitude: Parameter, scale: Parameter, levels: Float[Array, ""]) -> None:
    """Raise ValueError unless the amplitude and the error of a level are numbers, the latter to full precision."""
    if is_traced(amplitude, scale):
        return
    with np.errstate(over="ignore", under="ignore"):
        reach = np.asarray(amplitude) * scale
        inside = np.isfinite(reach) & (reach / levels >= np.finfo(np.float64).tiny)
    if not np.all(inside):
        least = np.finfo(np.float64).tiny * float(levels)
        raise fail(name, f"from {least:.3g} to {np.finfo(np.float64).max:.3g}", reach.tolist())
