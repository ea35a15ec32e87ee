"""What filters around another filter (`base`) have in common: whatever they do not change, the base filter does."""

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
    """A filter around another one, `base`, that estimates all of its states or the first ones.

    A final class overrides what it does otherwise, and says itself whether its states have attitudes. If its state
    holds more than that of `base`, `within` returns the latter, and the class defines `init`, `predict` and `correct`.
    Smoothing is not passed on to `base`: a class that changes a step must say how the backward pass changes.
    """

    base: eqx.AbstractVar[AbstractFilter]

    def within(self, state: PyTree) -> PyTree:
        """Return the state of `base` whose estimate is this filter's."""
        return state

    @in_float64
    def init(self) -> PyTree:
        """Return the initial state of the base filter."""
        return self.base.init()

    @predicts
    def predict(self, state: PyTree, u: ArrayLike = (), k: Step = 0) -> PyTree:
        """Predict over step k with the inputs u, by the base filter."""
        return self.base.predict(state, u, k)

    @corrects
    def correct(self, state: PyTree, z: ArrayLike, k: Step = 0) -> tuple[PyTree, Innovation]:
        """Correct with the measurement z of step k, by the base filter."""
        return self.base.correct(state, z, k)

    @estimates
    def estimate(self, state: PyTree) -> Estimate:
        """Return the mean and covariance of the estimate."""
        return self._restrict_to_first_states(self.base.estimate(self.within(state)))

    def after_step(self, state: PyTree, k: Step) -> Estimate:
        """Return the mean and covariance after step k."""
        return self._restrict_to_first_states(self.base.after_step(self.within(state), k))

    def angles_used(self) -> FilterAngles | None:
        """Return the angles of the base filter, among the states that this filter estimates."""
        angles = self.base.angles_used()
        return angles and angles._replace(states=tuple(i for i in angles.states if i < len(self.states)))

    @property
    def remarks(self) -> bool:
        """True if the base filter may have something to remark."""
        return self.base.remarks

    def remark(self, state: PyTree) -> Remark:
        """Return the remark of the base filter: what happened to the state that its user should know."""
        return self.base.remark(self.within(state))

    @property
    def of_atoms(self) -> bool:
        """True if the base filter is a mixture (particles, modes) that excludes z only by a likelihood of 0."""
        return self.base.of_atoms

    @property
    def silence_tells(self) -> bool:
        """True if silence is data to the base filter: its sender stays silent by a rule."""
        return self.base.silence_tells

    def _restrict_to_first_states(self, whole: Estimate) -> Estimate:
        """Return mean and covariance of the first states, under this filter's own claim."""
        n = len(self.states)
        mean = whole.mean[..., :n]
        covariance = whole.covariance[..., :n, :n]
        return replace(whole, mean=mean, covariance=covariance, claim=self.claim, attitude=self.attitude)
