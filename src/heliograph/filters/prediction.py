"""A filter's prediction as its estimate, so that it can be compared with filters that predict."""

from typing import Any

import equinox as eqx

from heliograph.filters.base import AbstractFilter
from heliograph.filters.gaussian import Belief, GaussianFilter
from heliograph.model.estimate import Claim, Estimate
from heliograph.numerics.check import fail
from heliograph.numerics.float64 import compiled, in_float64


class PredictionFilter(AbstractFilter):
    """A Gaussian filter whose estimate at step k is made before z_k is used: from z_0 ... z_k-1.

    Mean and covariance are those of f(x, u) + w; z_k is used for the next step. Built by `prediction_of`.
    """

    base: GaussianFilter
    claim: Claim = eqx.field(static=True)

    @in_float64
    def init(self) -> Belief:
        """The prior of the filter."""
        return self.base.init()

    @compiled
    def step(self, state: Belief, z: Any, u: Any = (), k: Any = 0) -> tuple[Belief, Estimate]:
        """Predict over step k, say so, then use what arrived of z."""
        prior = self.base.predict(state, u, k)
        return self.base.correct(prior, z, k), Estimate(prior.mean, prior.covariance, self.claim)


def prediction_of(filter: AbstractFilter) -> PredictionFilter:
    """The filter's one-step prediction as the estimate: at step k it has not seen z_k.

    Claim: the filter's own.

    Raises:
        ValueError: a filter that is not Gaussian.
    Source: the prediction step of cubature fusion under amplify-and-forward relays, Section III.
    """
    if not isinstance(filter, GaussianFilter):
        raise fail("filter", "a GaussianFilter", type(filter).__name__)
    return PredictionFilter(base=filter, claim=filter.claim)
