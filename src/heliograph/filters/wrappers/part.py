"""Filters that estimate the first states of a larger system."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp

from heliograph.filters.base import AbstractFilter, AbstractSizedFilter, Step, corrects, predicts
from heliograph.filters.linear.plan import PlannedFilter
from heliograph.model.estimate import Estimate, Innovation
from heliograph.numerics.check import check_count, fail, instance
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import Array, ArrayLike, Float, PyTree


class AbstractPartFilter(AbstractSizedFilter):
    """Filter that estimates the first states of those of `base`, which it predicts and corrects."""

    base: eqx.AbstractVar[AbstractFilter]

    @in_float64
    def init(self) -> PyTree:
        """Return the larger filter's initial state."""
        return self.base.init()

    @predicts
    def predict(self, state: PyTree, u: ArrayLike = (), k: Step = 0) -> PyTree:
        """Predict with the larger filter."""
        return self.base.predict(state, u, k)

    @corrects
    def correct(self, state: PyTree, z: ArrayLike, k: Step = 0) -> tuple[PyTree, Innovation]:
        """Correct with the larger filter."""
        return self.base.correct(state, z, k)

    @in_float64
    def estimate(self, state: PyTree) -> Estimate:
        """Mean and covariance of the first states."""
        return self._part(self.base.estimate(state))

    def _part(self, estimate_: Estimate) -> Estimate:
        n = len(self.states)
        return Estimate(estimate_.mean[..., :n], estimate_.covariance[..., :n, :n], self.claim)


class PartFilter(AbstractPartFilter):
    """A filter of a larger system that estimates its first states alone. Built by `part_filter`."""

    base: AbstractFilter

    def __init__(self, base: AbstractFilter, states: int):
        self.base, self.claim, self.states = base, base.claim, base.states[:states]
        self.inputs, self.received = base.inputs, base.received

    def after_step(self, state: PyTree, k: Step) -> Estimate:
        """Mean and covariance of the first states after step k."""
        return self._part(self.base.after_step(state, k))

    def planned(self, inputs: Float[Array, "horizon inputs"]) -> AbstractFilter:
        """Precompute all that does not depend on data."""
        plan, n = self.base.planned(inputs), len(self.states)
        if not isinstance(plan, PlannedFilter):
            return PartFilter(plan, n)
        projection = jnp.eye(len(self.base.states)) if plan.projection is None else jnp.asarray(plan.projection)
        return replace(plan, covariances=plan.covariances[:, :n, :n], projection=projection[:n], states=self.states)


def part_filter(filter: AbstractFilter, states: int) -> PartFilter:
    """Restrict a filter to its first states, as those of the plant in a system enlarged by `with_past`.

    Args:
        filter: the filter of the larger system.
        states: how many of its states are estimated, counted from the first.

    Claim: that of `filter`.

    Raises:
        ValueError: no filter, more states than it has.

    Source: a part of a linear estimate is the estimate of that part.
    """
    instance("filter", filter, AbstractFilter, "a filter")
    if check_count("states", states) > len(filter.states):
        raise fail("states", f"at most the filter's {len(filter.states)}", states)
    return PartFilter(filter, states)
