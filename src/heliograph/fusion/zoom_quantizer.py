"""A uniform quantizer whose amplitude follows what is sent."""

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.fusion.quantizer import AbstractQuantizer, Parameter, Quantized, UniformQuantizer
from heliograph.model.estimate import Claim, weakest
from heliograph.numerics.check import fail, scalar
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.types import Array, ArrayLike, Float


class ZoomQuantizer(AbstractQuantizer):
    """A uniform quantizer with the amplitude d+ = decay d + growth x^2: a dynamic quantizer, as it is published.

    It is driven by the unquantized x, which a fusion centre does not know, so that nobody there can decode it: for
    studies. And d saturates for every constant |x| below (1 - decay) / growth, since it tends to growth x^2 /
    (1 - decay). `EscapeQuantizer` has neither fault.

    Args:
        levels: number of segments, at least 2.
        amplitude: d of the first value, positive, a number or (n,).
        decay: share of the amplitude that is left at the next value, between 0 and 1.
        growth: of the amplitude with x^2, not negative, per unit of x.

    Raises:
        ValueError: fewer than two levels, an amplitude that is not positive, decay outside (0, 1), negative growth.

    Source: H-infinity quantized fusion over amplify-and-forward relays, equations (10) to (13).
    """

    uniform: UniformQuantizer
    decay: Parameter
    growth: Parameter

    def __init__(
        self,
        levels: int,
        amplitude: Float[ArrayLike, "*n"],
        decay: "Float[ArrayLike, '']",
        growth: "Float[ArrayLike, '']",
    ):
        """Check and hold the first uniform quantizer, and the parameters of d+ = decay d + growth x^2."""
        self.uniform = UniformQuantizer(levels, amplitude)
        self.decay = scalar("decay", decay)
        self.growth = scalar("growth", growth)
        if not is_traced(self.decay) and not 0 < self.decay < 1:
            raise fail("decay", "a number between 0 and 1", decay)
        if not is_traced(self.growth) and self.growth < 0:
            raise fail("growth", "no negative number", growth)

    @in_float64
    def init(self, n: int) -> jax.Array:
        """Return the first amplitude (n,)."""
        return jnp.broadcast_to(jnp.asarray(self.uniform.amplitude), (n,))

    @in_float64
    def step(self, state: Array, value: ArrayLike) -> tuple[jax.Array, Quantized]:
        """Return the next amplitude, and the value x quantized with the present amplitude.

        The next amplitude is decay times the present one plus growth times x^2; it stays if x is missing.
        """
        x = jnp.asarray(value, dtype=float)
        amplitude = jnp.asarray(state, dtype=float)
        next_amplitude = jnp.where(jnp.isfinite(x), self.decay * amplitude + self.growth * x**2, amplitude)
        quantizer_now = eqx.tree_at(lambda quantizer: quantizer.amplitude, self.uniform, amplitude)
        _, quantized = quantizer_now.step((), x)
        return next_amplitude, quantized

    def claim(self, claim: Claim) -> Claim:
        """Lower a claim to "nominal": the amplitude depends on the data, and may be small where errors are large."""
        return weakest([claim, "nominal"])
