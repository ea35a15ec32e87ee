"""Sending on event: a node reports when its estimate has changed by more than a threshold since its last report."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.fusion.quantizer import AbstractQuantizer, Quantized
from heliograph.model.estimate import Claim, weakest
from heliograph.numerics.check import array, fail, rank
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.traced import library
from heliograph.numerics.types import Array, ArrayLike, Bool, Float


class LastSent(NamedTuple):
    """The value that was sent last, and whether there is one."""

    value: Float[jax.Array, " n"]
    any: Bool[jax.Array, ""]


class EventSending(AbstractQuantizer):
    """Send x, all of it, when some |x_j - held_j| > threshold_j, held what was sent last; the first value is sent.

    `told`: the receiver knows the thresholds, so that silence says that x is within them of what it holds. That error
    bound is used at every step, so that it does not depend on the data: what was "exact" or "upper" becomes "upper".
    Without, silence is taken for a loss: what the receiver then claims is for losses that do not depend on the data,
    and these do; the claim is "nominal". A value of n components counts as n symbols when it is sent, else as none.

    Raises:
        ValueError: thresholds that are not positive.
    """

    threshold: Float[Array, "..."]
    announced: bool = eqx.field(static=True, default=True)

    def __init__(self, threshold: ArrayLike, announced: bool = True):
        self.threshold = array("threshold", threshold, () if rank("threshold", threshold) == 0 else (None,))
        if np.any(self.threshold <= 0):
            raise fail("threshold", "positive numbers", threshold)
        self.announced = announced

    @property
    def silent(self) -> bool:
        """Whether nothing may arrive."""
        return not self.announced

    @in_float64
    def init(self, n: int) -> LastSent:
        """Nothing was sent."""
        return LastSent(jnp.zeros(n), jnp.asarray(False))

    @in_float64
    def step(self, state: LastSent, value: ArrayLike) -> tuple[LastSent, Quantized]:
        """What the receiver holds after this step; NaN where it takes silence for a loss."""
        x = jnp.asarray(value, dtype=float)
        there = ~jnp.any(jnp.isnan(x))
        sent = there & (~state.any | jnp.any(jnp.abs(x - state.value) > self.threshold))
        held = LastSent(jnp.where(sent, x, state.value), state.any | sent)
        received = jnp.where(there & (sent | self.announced), held.value, jnp.nan)
        error = jnp.where(jnp.isnan(received), jnp.nan, self.error(len(x)))
        return held, Quantized(
            received, error, jnp.zeros(len(x), dtype=bool), jnp.where(sent, jnp.ones(len(x), int), 0)
        )

    def error(self, n: int) -> Float[Array, " n"]:
        """The thresholds, where silence is understood."""
        bound = library(self.threshold).broadcast_to(self.threshold, (n,))
        return bound if self.announced else np.zeros(n)

    def claim(self, claim: Claim) -> Claim:
        """At most "upper", where silence is understood; else "nominal"."""
        return weakest([claim, "upper" if self.announced else "nominal"])
