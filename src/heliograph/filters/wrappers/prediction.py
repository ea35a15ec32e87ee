"""One-step prediction of a filter as its estimate, for comparison with filters in predictor form."""

from typing import NamedTuple

from heliograph.filters.base import AbstractFilter, AbstractSizedFilter, Step, corrects, predicts
from heliograph.filters.gaussian.belief import Belief
from heliograph.filters.gaussian.gaussian import GaussianFilter
from heliograph.model.estimate import Estimate, Innovation
from heliograph.numerics.check import fail
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import ArrayLike


class Ahead(NamedTuple):
    """Corrected belief, and the prediction before the correction."""

    belief: Belief
    prior: Belief


class PredictionFilter(AbstractSizedFilter):
    """A Gaussian filter whose estimate at step k is made before z_k is used: from z_0 ... z_k-1.

    Mean and covariance are those of f(x, u) + w; z_k is used for the next step. Built by `prediction_of`.
    """

    base: GaussianFilter

    def __init__(self, base: GaussianFilter):
        self.base, self.claim = base, base.claim
        self.states, self.inputs, self.received = base.states, base.inputs, base.received

    @in_float64
    def init(self) -> Ahead:
        """Return the prior of the filter, twice."""
        return Ahead(self.base.init(), self.base.init())

    @predicts
    def predict(self, state: Ahead, u: ArrayLike = (), k: Step = 0) -> Ahead:
        """Predict with the filter; the correction will not change the stored prior."""
        prior = self.base.predict(state.belief, u, k)
        return Ahead(prior, prior)

    @corrects
    def correct(self, state: Ahead, z: ArrayLike, k: Step = 0) -> tuple[Ahead, Innovation]:
        """Correct the belief for the next step; the estimate stays the prediction."""
        belief, innovation = self.base.correct(state.belief, z, k)
        return Ahead(belief, state.prior), innovation

    @in_float64
    def estimate(self, state: Ahead) -> Estimate:
        """Mean and covariance of the prediction."""
        return self.base.estimate(state.prior)


def prediction_of(filter: AbstractFilter) -> PredictionFilter:
    """One-step prediction of a filter as its estimate: at step k it does not use z_k.

    Claim: that of `filter`, a `GaussianFilter`.

    Raises:
        ValueError: a filter that is not Gaussian.

    Source: the prediction step of cubature fusion under amplify-and-forward relays, Section III.
    """
    if not isinstance(filter, GaussianFilter):
        raise fail("filter", "a GaussianFilter", type(filter).__name__)
    return PredictionFilter(filter)
