"""A filter's prediction as its estimate, so that it can be compared with filters that predict."""

from typing import NamedTuple

import equinox as eqx

from heliograph.filters.base import AbstractFilter, Step, corrects, predicts
from heliograph.filters.gaussian.belief import Belief
from heliograph.filters.gaussian.gaussian import GaussianFilter
from heliograph.model.estimate import Claim, Estimate, Innovation
from heliograph.numerics.check import fail
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import ArrayLike


class Ahead(NamedTuple):
    """The belief, and the prediction that it was corrected from."""

    belief: Belief
    prior: Belief


class PredictionFilter(AbstractFilter):
    """A Gaussian filter whose estimate at step k is made before z_k is used: from z_0 ... z_k-1.

    Mean and covariance are those of f(x, u) + w; z_k is used for the next step. Built by `prediction_of`.
    """

    base: GaussianFilter
    claim: Claim = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    received: int = eqx.field(static=True)

    def __init__(self, base: GaussianFilter):
        self.base, self.claim = base, base.claim
        self.states, self.inputs, self.received = base.states, base.inputs, base.received

    @in_float64
    def init(self) -> Ahead:
        """The prior of the filter."""
        return Ahead(self.base.init(), self.base.init())

    @predicts
    def predict(self, state: Ahead, u: ArrayLike = (), k: Step = 0) -> Ahead:
        """The filter's prediction, kept beside what z_k will make of it."""
        prior = self.base.predict(state.belief, u, k)
        return Ahead(prior, prior)

    @corrects
    def correct(self, state: Ahead, z: ArrayLike, k: Step = 0) -> tuple[Ahead, Innovation]:
        """Use what arrived of z for the next step; the estimate stays."""
        belief, innovation = self.base.correct(state.belief, z, k)
        return Ahead(belief, state.prior), innovation

    @in_float64
    def estimate(self, state: Ahead) -> Estimate:
        """The prediction."""
        return self.base.estimate(state.prior)


def prediction_of(filter: AbstractFilter) -> PredictionFilter:
    """The filter's one-step prediction as the estimate: at step k it has not seen z_k.

    Claim: the filter's own.

    Raises:
        ValueError: a filter that is not Gaussian.
    Source: the prediction step of cubature fusion under amplify-and-forward relays, Section III.
    """
    if not isinstance(filter, GaussianFilter):
        raise fail("filter", "a GaussianFilter", type(filter).__name__)
    return PredictionFilter(filter)
