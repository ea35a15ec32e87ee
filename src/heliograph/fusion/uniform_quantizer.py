"""Uniform quantizer of equal segments, which saturates beyond them."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.fusion.quantizer import AbstractQuantizer, Quantized
from heliograph.fusion.segments import Parameter, check_range, levels_of, midpoint, positive, segment_of
from heliograph.model.estimate import Claim, weakest
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import Array, ArrayLike, Float, PyTree


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
