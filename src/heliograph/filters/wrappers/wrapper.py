"""What filters around another filter have in common: whatever they do not change, the filter within does."""

from dataclasses import replace

import equinox as eqx

from heliograph.filters.base import (
    AbstractFilter,
    AbstractSizedFilter,
    FilterAngles,
    Step,
    corrects,
    estimates,
    predicts,
)
from heliograph.filters.remark import Remark
from heliograph.model.estimate import Estimate, Innovation
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import ArrayLike, PyTree


class AbstractWrapper(AbstractSizedFilter):
    """A filter around another, `base`, of whose states it estimates the first ones: mostly all of them.

    A final class defines what it does otherwise, and says itself whether it turns attitudes. One that keeps more than
    the state of `base` says where that is, in `within`, and defines `init`, `predict` and `correct`. Smoothing is not
    handed on: whoever changes a step says how the way back changes.
    """

    base: eqx.AbstractVar[AbstractFilter]

    def within(self, state: PyTree) -> PyTree:
        """Return the state of `base` whose estimate is this filter's."""
        return state

    @in_float64
    def init(self) -> PyTree:
        """Return the initial state of the filter within."""
        return self.base.init()

    @predicts
    def predict(self, state: PyTree, u: ArrayLike = (), k: Step = 0) -> PyTree:
        """Predict with the filter within."""
        return self.base.predict(state, u, k)

    @corrects
    def correct(self, state: PyTree, z: ArrayLike, k: Step = 0) -> tuple[PyTree, Innovation]:
        """Correct with the filter within."""
        return self.base.correct(state, z, k)

    @estimates
    def estimate(self, state: PyTree) -> Estimate:
        """Return the mean and covariance of the estimate."""
        return self._restrict_to_first_states(self.base.estimate(self.within(state)))

    def after_step(self, state: PyTree, k: Step) -> Estimate:
        """Return the mean and covariance after step k."""
        return self._restrict_to_first_states(self.base.after_step(self.within(state), k))

    def angles_used(self) -> FilterAngles | None:
        """Return the angles of the filter within, of its states those that are estimated."""
        angles = self.base.angles_used()
        return angles and angles._replace(states=tuple(i for i in angles.states if i < len(self.states)))

    @property
    def remarks(self) -> bool:
        """True if the remark of the filter within may say anything."""
        return self.base.remarks

    def remark(self, state: PyTree) -> Remark:
        """Say what the filter within says."""
        return self.base.remark(self.within(state))

    @property
    def of_atoms(self) -> bool:
        """True if for the filter within likelihood 0 says that its model excludes a measurement."""
        return self.base.of_atoms

    @property
    def silence_tells(self) -> bool:
        """True if a step at which nothing arrives changes the state of the filter within."""
        return self.base.silence_tells

    def _restrict_to_first_states(self, whole: Estimate) -> Estimate:
        """Return mean and covariance of the first states, under this filter's own claim."""
        n = len(self.states)
        mean, covariance = whole.mean[..., :n], whole.covariance[..., :n, :n]
        return replace(whole, mean=mean, covariance=covariance, claim=self.claim, attitude=self.attitude)
