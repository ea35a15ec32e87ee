"""Equal segments of [-d, d]: which one holds a number, and its middle."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import array, check_count, fail
from heliograph.numerics.traced import is_traced
from heliograph.numerics.types import Array, ArrayLike, Float

Parameter = Float[Array, "..."]  # of all components, or of each


def segment_of(x: Float[jax.Array, "*n"], amplitude: Parameter, levels: Float[Array, ""]) -> Float[jax.Array, "*n"]:
    """Which of the equal segments of [-amplitude, amplitude] holds x, from 0."""
    return jnp.clip(jnp.floor((x / amplitude + 1) * levels / 2), 0, levels - 1)


def midpoint(segment: Array, amplitude: Parameter, levels: Float[Array, ""]) -> Float[jax.Array, "*n"]:
    """The middle of a segment; exactly zero for the middle one of an odd number.

    The amplitude's power of two is taken out, which changes no bit, or its product with many levels would be no number.
    """
    fraction, power = jnp.frexp(jnp.asarray(amplitude))
    return jnp.ldexp((2 * segment + 1 - levels) * fraction / levels, power)


def levels_of(value: int) -> Float[np.ndarray, ""]:
    """How many segments, at least two."""
    check_count("levels", value, 2)
    return np.asarray(value, dtype=np.float64)


def parameter(name: str, value: ArrayLike) -> Parameter:
    """A number, or one for each component."""
    several = isinstance(value, Sequence) or np.ndim(value) > 0
    result: Parameter = array(name, value, (None,) if several else ())
    return result


def positive(name: str, value: ArrayLike) -> Parameter:
    """A parameter that is positive."""
    result = parameter(name, value)
    if not isinstance(result, jax.Array) and np.any(result <= 0):
        raise fail(name, "positive numbers", value)
    return result


def check_range(name: str, amplitude: Parameter, scale: Parameter, levels: Float[Array, ""]) -> None:
    """Raise ValueError unless the reach and the error of a level are numbers, the latter to full precision."""
    if is_traced(amplitude, scale):
        return
    with np.errstate(over="ignore", under="ignore"):
        reach = np.asarray(amplitude) * scale
        inside = np.isfinite(reach) & (reach / levels >= np.finfo(np.float64).tiny)
    if not np.all(inside):
        least = np.finfo(np.float64).tiny * float(levels)
        raise fail(name, f"from {least:.3g} to {np.finfo(np.float64).max:.3g}", reach.tolist())
