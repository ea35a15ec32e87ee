"""How a node's reports travel to the fusion centre: how often, through what, how late."""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.over_time import first
from heliograph.numerics.check import check_count, fail, instance, probabilities, rank
from heliograph.numerics.module import Module
from heliograph.numerics.readable import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.base import AbstractRandomAffine


@readable
class ReportLink(Module):
    """A node's report m is sent after every d-th step, arrives as G m + n, and perhaps late.

    `channel`: any random affine map that forgets: fading hops, chains of them, losses that the centre is told of
    (`erasure`) or not (`dropout`); as it is unless given. `delay`: a number of steps, or the probabilities of 0, 1, ...
    steps, drawn anew for each report; the centre knows when a report was sent. `every`: reports are sent after the
    steps d, 2 d, ...

    A quantizer with dither adds noise that does not depend on the signal: a `hop` of gain 1 whose noise is the
    dither's.

    Raises:
        ValueError: a channel that is none, a delay that is no count and no probabilities, d below one.
    """

    channel: Channel | None
    delay: Float[np.ndarray, " ages"]
    every: int = eqx.field(static=True)

    def __init__(self, channel: Channel | None = None, delay: ArrayLike = 0, every: int = 1):
        self.channel, self.every = channel, check_count("every", every)
        if channel is not None:
            instance("channel of a report link", first(channel), AbstractRandomAffine, "a random affine map")
        if rank("delay", delay) == 0:
            steps = check_count("delay of a report link", delay, 0)
            self.delay = np.eye(steps + 1)[steps]
        else:
            self.delay = probabilities("delay of a report link", delay)

    def check(self, n: int) -> None:
        """Raise ValueError unless it takes reports of n components and forgets."""
        if self.channel is None:
            return
        if first(self.channel).inputs != n:
            raise fail(
                "channel of a report link", f"one that takes {n} numbers", f"{first(self.channel).inputs} inputs"
            )
        if first(self.channel).remembers:
            raise fail("channel of a report link", "one that forgets", f"{type(first(self.channel)).__name__}")

    @property
    def may_lack(self) -> bool:
        """Whether a step may pass without the report of that step."""
        return self.every > 1 or self.delay[0] < 1 or (self.channel is not None and first(self.channel).erases)

    def received(self, n: int) -> int:
        """How many numbers of a report of n arrive."""
        return n if self.channel is None else int(first(self.channel).outputs)


ReportLinks = ReportLink | Mapping[str, ReportLink]  # one for all nodes, or by their names


class Links(NamedTuple):
    """What a centre knows of the reports of one step, z_i = G_i m_i + n_i, |what a quantizer adds to m_i| <= error_i.

    Shapes: gain E[G] (node, m, n), offset E[n] (node, m), spread (node, m, m, n + 1, n + 1), which takes second moments
    of (m_i, 1) to Cov(z_i | m_i); error (node, n).
    """

    gain: jax.Array | np.ndarray
    offset: jax.Array | np.ndarray
    spread: jax.Array | np.ndarray
    error: jax.Array | np.ndarray
