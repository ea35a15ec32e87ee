"""Reports from nodes to the fusion centre: rate, channel and delay, and sending on events."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.fusion.quantizer import AbstractQuantizer, Quantized, Quantizer
from heliograph.model.channel import Channel, perfect
from heliograph.model.estimate import Claim, weakest
from heliograph.model.over_time import OverTime, first
from heliograph.numerics.check import array, check_count, fail, instance, probabilities, rank
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.masked_arrays import fill_masked
from heliograph.numerics.module import Module, are_same, readable
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Array, ArrayLike, Bool, Float
from heliograph.random_affine.base import AbstractRandomAffine


class LastSent(NamedTuple):
    """value: the estimate (n,) that was sent last. any: whether one was sent at all; the value is zero before."""

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
            losses that do not depend on the data, and these do; the claim is "nominal". Over a `ReportLink` silence is
            understood only where all that is sent arrives as it is, after a fixed delay.

    Raises:
        ValueError: thresholds that are not positive.
    """

    threshold: Float[Array, "..."]
    announced: bool = eqx.field(static=True, default=True)

    def __init__(self, threshold: Float[ArrayLike, "*n"], announced: bool = True):
        """Store the change beyond which a value is sent, and whether the receiver knows the rule (`announced`)."""
        self.threshold = array("threshold", threshold, () if rank("threshold", threshold) == 0 else (None,))
        if np.any(self.threshold <= 0):
            raise fail("threshold", "positive numbers", threshold)
        self.announced = announced

    @property
    def silent(self) -> bool:
        """True if the receiver has no value (NaN) at steps at which nothing is sent: it does not know the rule."""
        return not self.announced

    @property
    def holds(self) -> bool:
        """True if the receiver holds the value that was sent last for as long as nothing is sent.

        It may do so if it knows the thresholds (`announced`): silence then means that x is still near that value.
        """
        return self.announced

    @in_float64
    def init(self, n: int) -> LastSent:
        """Return the state before the first value of n components is sent."""
        return LastSent(jnp.zeros(n), jnp.asarray(False))

    @in_float64
    def step(self, state: LastSent, value: ArrayLike) -> tuple[LastSent, Quantized]:
        """Return the next state, and what the receiver has after this step: a new value, the last one, or NaN.

        A value is sent if a component differs from the last sent one by more than its threshold. If `self.announced`,
        the receiver knows that silence means no change and keeps the last value; otherwise silence is a loss (NaN). The
        symbols are 1 for each component that is sent, else 0.
        """
        x = jnp.asarray(fill_masked(value), dtype=float)
        is_value = ~jnp.any(jnp.isnan(x))
        sent = is_value & (~state.any | jnp.any(jnp.abs(x - state.value) > self.threshold))
        last = LastSent(jnp.where(sent, x, state.value), state.any | sent)
        received = jnp.where(is_value & (sent | self.announced), last.value, jnp.nan)
        return last, Quantized(
            value=received,
            error=jnp.where(jnp.isnan(received), jnp.nan, self.error(len(x))),
            saturated=jnp.zeros(len(x), dtype=bool),
            symbols=jnp.where(sent, jnp.ones(len(x), int), 0),
        )

    def error(self, n: int) -> Float[Array, " n"]:
        """Return a bound (n,) on |received - x|: the thresholds if the receiver knows them, and zero otherwise.

        A receiver that knows them takes the last value for x while nothing is sent, which is off by a threshold at
        most. One that does not know them uses nothing but values that are sent, and these are not rounded.
        """
        bound = library(self.threshold).broadcast_to(self.threshold, (n,))
        return bound if self.announced else np.zeros(n)

    def claim(self, claim: Claim) -> Claim:
        """Lower a claim to "upper" at most where silence is interpreted; else to "nominal"."""
        return weakest([claim, "upper" if self.announced else "nominal"])


@readable
class ReportLink(Module):
    """Link of a node's reports: report m is sent after every d-th step, arrives as G m + n, and perhaps late.

    A quantizer with dither adds noise that does not depend on the signal: a `hop` of gain 1 whose noise is the
    dither's.

    Args:
        channel: any random affine map without memory: fading hops, chains of them, losses that the centre detects
            (`erasure`) or not (`dropout`); lossless by default.
        delay: a number of steps, or the probabilities (ages,) of 0, 1, ... steps, drawn independently for each report;
            the centre knows when a report was sent. 0 by default.
        every: reports are sent after the steps d, 2 d, ...; 1 by default.

    Raises:
        ValueError: a channel that is none, a delay that is no count and no probabilities, d below one.
    """

    channel: Channel | None
    delay: Float[np.ndarray, " ages"]
    every: int = eqx.field(static=True)

    def __init__(self, channel: Channel | None = None, delay: Float[ArrayLike, "*ages"] = 0, every: int = 1):
        """Check and hold the channel and every how many steps a report is sent, and the delay as probabilities.

        `self.delay` (ages,) has the probability of each number of steps 0, 1, ...; a fixed delay has probability 1.
        """
        self.channel = channel
        self.every = check_count("every", every)
        if channel is not None:
            instance("channel of a report link", first(channel), AbstractRandomAffine, "a random affine map")
        if rank("delay", delay) == 0:
            steps = check_count("delay of a report link", delay, 0)
            self.delay = np.eye(steps + 1)[steps]
        else:
            self.delay = probabilities("delay of a report link", delay)

    def check(self, n: int) -> None:
        """Raise ValueError unless the channel takes reports of n components and its draws are independent over time.

        A channel that varies over time is checked at its first step: it has the same form at all steps.
        """
        if self.channel is None:  # lossless
            return
        channel = first(self.channel)
        if channel.inputs != n:
            raise fail("channel of a report link", f"one that takes {n} numbers", f"{channel.inputs} inputs")
        if channel.remembers:
            raise fail("channel of a report link", "one that forgets", f"{type(channel).__name__}")

    def delivers(self, n: int) -> bool:
        """Return whether every report of n numbers that is sent arrives as it is, after a fixed delay."""
        return bool(np.max(self.delay) == 1) and (self.channel is None or are_same(self.channel, perfect(n)))

    def received(self, n: int) -> int:
        """Return how many numbers the centre receives of a report of n numbers."""
        return n if self.channel is None else int(first(self.channel).outputs)


ReportLinks = ReportLink | Mapping[str, ReportLink]  # one for all nodes, or by their names


def check_reports(links: Sequence[ReportLink], quantizers: Sequence[Quantizer], n: int) -> None:
    """Raise ValueError unless the nodes' links, and their quantizers if any, fit reports of n numbers."""
    for link in links:
        instance("report link", link, ReportLink, "a ReportLink").check(n)
    # There are no quantizers, or one for each link.
    for link, quantizer in zip(links, quantizers, strict=False):
        if isinstance(quantizer, OverTime):
            raise fail("quantizer of reports", "one that does not vary over time", "an OverTime")
        # This raises if the error has no bound before any data.
        quantizer.error(n)
        # A quantizer that holds is silent while its value stays, so that silence must not mean a loss.
        if quantizer.holds and not link.delivers(n):
            raise fail(f"reports through {type(quantizer).__name__}, whose silence is understood", "a report link "
                       "that loses, changes and delays by chance nothing that is sent", "another")  # fmt: skip


class ReportModel(NamedTuple):
    """Model of the reports z_i = G_i (m_i + mu_i) + n_i of one step: m_i the estimate of node i, |mu_i| <= error_i.

    mu_i is the error of the node's quantizer.

    Shapes: gain E[G] (node, m, n), offset E[n] (node, m), covariance (node, m, m, n + 1, n + 1), which takes second
    moments of (m_i, 1) to Cov(z_i | m_i); error (node, n).
    """

    gain: jax.Array | np.ndarray
    offset: jax.Array | np.ndarray
    covariance: jax.Array | np.ndarray
    error: jax.Array | np.ndarray
