"""Links of reports from nodes to the fusion centre: rate, channel and delay."""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.over_time import first
from heliograph.numerics.check import check_count, fail, instance, probabilities, rank
from heliograph.numerics.module import Module, readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.base import AbstractRandomAffine


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
        self.channel, self.every = channel, check_count("every", every)
        if channel is not None:
            instance("channel of a report link", first(channel), AbstractRandomAffine, "a random affine map")
        if rank("delay", delay) == 0:
            steps = check_count("delay of a report link", delay, 0)
            self.delay = np.eye(steps + 1)[steps]
        else:
            self.delay = probabilities("delay of a report link", delay)

    def check(self, n: int) -> None:
        """Raise ValueError unless it takes reports of n components and has no memory."""
        if self.channel is None:
            return
        if first(self.channel).inputs != n:
            raise fail(
                "channel of a report link", f"one that takes {n} numbers", f"{first(self.channel).inputs} inputs"
            )
        if first(self.channel).remembers:
            raise fail("channel of a report link", "one that forgets", f"{type(first(self.channel)).__name__}")

    def received(self, n: int) -> int:
        """Number of received components of a report of n."""
        return n if self.channel is None else int(first(self.channel).outputs)


ReportLinks = ReportLink | Mapping[str, ReportLink]  # one for all nodes, or by their names


class Links(NamedTuple):
    """Reports of one step as the centre models them, z_i = G_i m_i + n_i, quantizers' errors on m_i within error_i.

    Shapes: gain E[G] (node, m, n), offset E[n] (node, m), spread (node, m, m, n + 1, n + 1), which takes second moments
    of (m_i, 1) to Cov(z_i | m_i); error (node, n).
    """

    gain: jax.Array | np.ndarray
    offset: jax.Array | np.ndarray
    spread: jax.Array | np.ndarray
    error: jax.Array | np.ndarray
