"""Uniform quantizer of equal segments of [-d, d], each number by its midpoint, which saturates beyond them."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.fusion.quantizer import AbstractQuantizer, Quantized
from heliograph.model.estimate import Claim, weakest
from heliograph.numerics.check import array, check_count, fail
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.traced import is_traced
from heliograph.numerics.types import Array, ArrayLike, Float, PyTree

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
    result: Parameter = array(name, value, (None,) if several else ())
    return result


def positive(name: str, value: ArrayLike) -> Parameter:
    """Return a parameter that is positive."""
    result = parameter(name, value)
    if not isinstance(result, jax.Array) and np.any(result <= 0):
        raise fail(name, "positive numbers", value)
    return result


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


class UniformQuantizer(AbstractQuantizer):
    """Midpoints of `levels` equal segments of [-amplitude, amplitude], its ends outside: u q(x / u), u = scale.

    |error| <= scale amplitude / levels where x / u lies within the amplitude; outside nothing is guaranteed. Errors and
    their bounds do not depend on the data, so what was "upper" stays so.

    Args:
        levels: number of segments, at least 2.
        amplitude: positive, a number or (n,).
        scale: unit u of x, positive, a number or (n,); 1 by default.

    Raises:
        ValueError: fewer than two levels, an amplitude or scale that is not positive, an amplitude or an error beyond
            the range of numbers.

    Source: H-infinity quantized fusion over amplify-and-forward relays, equations (10), (11) and (13).
    """

    levels: Float[Array, ""]
    amplitude: Parameter
    scale: Parameter

    def __init__(self, levels: int, amplitude: Float[ArrayLike, "*n"], scale: Float[ArrayLike, "*n"] = 1.0):
        self.levels = levels_of(levels)
        self.amplitude, self.scale = positive("amplitude", amplitude), positive("scale", scale)
        check_range("amplitude times scale", self.amplitude, self.scale, self.levels)

    def init(self, n: int) -> tuple[()]:
        """Return the empty state."""
        return ()

    @in_float64
    def step(self, state: PyTree, value: ArrayLike) -> tuple[PyTree, Quantized]:
        """Quantize with the fixed amplitude."""
        return state, _published(jnp.asarray(value, dtype=float), self.amplitude, self.levels, self.scale)

    def error(self, n: int) -> Float[Array, " n"]:
        """Half of a segment's length."""
        return np.asarray(np.broadcast_to(self.scale * self.amplitude / self.levels, (n,)))

    def claim(self, claim: Claim) -> Claim:
        """Lower a claim to "upper" at most."""
        return weakest([claim, "upper"])


def _published(
    x: Float[jax.Array, "*n"], amplitude: Parameter, levels: Float[Array, ""], scale: Parameter
) -> Quantized:
    """Equations (10), (11) and (13), with d for values from d on and -d for values below -d."""
    scaled = x / scale
    inside = midpoint(segment_of(scaled, amplitude, levels), amplitude, levels)
    value = jnp.where(scaled >= amplitude, amplitude, jnp.where(scaled < -amplitude, -amplitude, inside))
    saturated = jnp.abs(scaled) > amplitude
    error = jnp.where(saturated | ~jnp.isfinite(x), jnp.nan, scale * amplitude / levels)
    return Quantized(scale * value, error, saturated, jnp.ones(x.shape, dtype=int))
