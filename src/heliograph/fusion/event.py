"""Event-triggered reports: a node reports when its estimate has changed by more than a threshold."""

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
    """Value that was sent last, and whether there is one."""

    value: Float[jax.Array, " n"]
    any: Bool[jax.Array, ""]


class EventSending(AbstractQuantizer):
    """Event trigger: send x, all of it, when some |x_j - last_j| > threshold_j, and the first value.

    A value of n components counts as n symbols when it is sent, else as none.

    Args:
        threshold: positive, a number or (n,).
        announced: whether the receiver knows the thresholds, so that silence means that x is within them of the last
            value; True by default. That error bound is used at every step, so that it does not depend on the data: what
            was "exact" or "upper" becomes "upper". Otherwise silence is taken for a loss: the receiver's claim is for
            losses that do not depend on the data, and these do; the claim is "nominal".

    Raises:
        ValueError: thresholds that are not positive.
    """

    threshold: Float[Array, "..."]
    announced: bool = eqx.field(static=True, default=True)

    def __init__(self, threshold: Float[ArrayLike, "*n"], announced: bool = True):
        self.threshold = array("threshold", threshold, () if rank("threshold", threshold) == 0 else (None,))
        if np.any(self.threshold <= 0):
            raise fail("threshold", "positive numbers", threshold)
        self.announced = announced

    @property
    def silent(self) -> bool:
        """True where a step may pass without a value for the receiver."""
        return not self.announced

    @in_float64
    def init(self, n: int) -> LastSent:
        """Return the state before the first value."""
        return LastSent(jnp.zeros(n), jnp.asarray(False))

    @in_float64
    def step(self, state: LastSent, value: ArrayLike) -> tuple[LastSent, Quantized]:
        """Send or stay silent; return what the receiver has after this step, NaN where it takes silence for a loss."""
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
        """Thresholds as the error bound, where silence is interpreted; zero otherwise."""
        bound = library(self.threshold).broadcast_to(self.threshold, (n,))
        return bound if self.announced else np.zeros(n)

    def claim(self, claim: Claim) -> Claim:
        """Lower a claim to "upper" at most where silence is interpreted; else to "nominal"."""
        return weakest([claim, "upper" if self.announced else "nominal"])
