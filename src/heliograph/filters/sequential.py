"""The central filter: it hears all nodes, predicts once, and uses their measurements one after another."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.gaussian import Belief, GaussianFilter
from heliograph.model.estimate import Claim, Estimate, weakest
from heliograph.model.over_time import OverTime, alike, first, stack
from heliograph.numerics.check import fail
from heliograph.numerics.float64 import compiled, in_float64


class SequentialFilter(AbstractFilter):
    """Predict with the first node's filter, then correct with each node's in turn; z is the nodes' measurements joined.

    The posterior of one node is the prior of the next. Behind uncertain gains the first correction is not a conditional
    mean, so a next one that assumes E[e yhat'] = 0 (`ZeroMean`) is no bound: the claim is "nominal" unless every part
    is exact.
    """

    filters: tuple[GaussianFilter, ...]
    lengths: tuple[int, ...] = eqx.field(static=True)
    claim: Claim = eqx.field(static=True)

    @in_float64
    def init(self) -> Belief:
        """The first node's prior."""
        return self.filters[0].init()

    @compiled
    def step(self, state: Belief, z: Any, u: Any = (), k: Any = 0) -> tuple[Belief, Estimate]:
        """Predict over step k, then use what arrived from each node."""
        after = self.filters[0].predict(state, u, k)
        after = self._correct(after, jnp.asarray(z, dtype=float), k)
        return after, Estimate(after.mean, after.covariance, self.claim)

    def _correct(self, prior: Belief, z: jax.Array, k: Any) -> Belief:
        if all(alike(item, self.filters[0]) for item in self.filters):  # one correction compiled, run over the nodes
            arrays, rest = eqx.partition(stack(self.filters), eqx.is_array)

            def correct(belief: Belief, item: tuple[Any, jax.Array]) -> tuple[Belief, None]:
                one: GaussianFilter = eqx.combine(item[0], rest)
                return one.correct(belief, item[1], k), None

            return jax.lax.scan(correct, prior, (arrays, z.reshape(len(self.filters), -1)))[0]
        ends = np.cumsum(self.lengths)
        for item, part in zip(self.filters, jnp.split(z, ends[:-1]), strict=True):
            prior = item.correct(prior, part, k)
        return prior


def sequential_filter(filters: Sequence[GaussianFilter]) -> SequentialFilter:
    """The central filter made of the nodes' own filters, in the order of the network's nodes.

    Claim: "exact" if every part is, else "nominal".

    Raises:
        ValueError: no filters, or filters of different state dimensions.
    Source: cubature fusion under amplify-and-forward relays, Section I (centralised fusion, the reference).
    """
    parts = tuple(filters)
    if len({len(first(item.plant).states) for item in parts}) != 1:
        raise fail("sequential filter", "filters of one state dimension", [len(first(f.plant).states) for f in parts])
    weakest_part = weakest([item.claim for item in parts])
    return SequentialFilter(
        filters=parts,
        lengths=tuple(_received(item) for item in parts),
        claim="exact" if weakest_part == "exact" else "nominal",
    )


def _received(item: GaussianFilter) -> int:
    channel = item.channel.values if isinstance(item.channel, OverTime) else item.channel
    return int(channel.offset.shape[-1])
