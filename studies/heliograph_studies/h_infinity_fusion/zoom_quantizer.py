"""The paper's dynamic quantizer: its amplitude follows the square of what it is given."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

import heliograph as hg
from heliograph.fusion.quantizer import AbstractQuantizer, Quantized
from heliograph.model.estimate import Claim, weakest
from heliograph.numerics.check import fail
from heliograph.numerics.float64 import in_float64


class ZoomQuantizer(AbstractQuantizer):
    """A uniform quantizer with the amplitude d+ = decay d + growth x^2.

    As published: driven by the unquantized x, which a fusion centre does not know, so nobody there can decode it; and d
    saturates for every constant |x| below (1 - decay) / (growth scale), since it tends to growth x^2 / (1 - decay).
    `hg.fusion.EscapeQuantizer` has neither fault.

    Raises:
        ValueError: fewer than two levels, an amplitude that is not positive, decay outside (0, 1), negative growth.
    Source: H-infinity quantized fusion over amplify-and-forward relays, equations (10) to (13).
    """

    uniform: hg.fusion.UniformQuantizer
    decay: np.ndarray
    growth: np.ndarray

    def __init__(self, levels: int, amplitude: ArrayLike, decay: float, growth: float):
        self.uniform = hg.fusion.UniformQuantizer(levels, amplitude)
        if not 0 < decay < 1:
            raise fail("decay", "a number between 0 and 1", decay)
        if growth < 0:
            raise fail("growth", "no negative number", growth)
        self.decay, self.growth = np.asarray(decay), np.asarray(growth)

    @in_float64
    def init(self, n: int) -> jax.Array:
        """The first amplitude (n,)."""
        return jnp.broadcast_to(jnp.asarray(self.uniform.amplitude), (n,))

    @in_float64
    def step(self, state: ArrayLike, value: ArrayLike) -> tuple[jax.Array, Quantized]:
        """Quantize with the present amplitude; the next one follows x."""
        x, amplitude = jnp.asarray(value, dtype=float), jnp.asarray(state, dtype=float)
        following = jnp.where(jnp.isfinite(x), self.decay * amplitude + self.growth * x**2, amplitude)
        _, sent = eqx.tree_at(lambda q: q.amplitude, self.uniform, amplitude).step((), x)
        return following, sent

    def claim(self, claim: Claim) -> Claim:
        """At most "nominal": the amplitude depends on the data, and may be small where errors are large."""
        return weakest([claim, "nominal"])
