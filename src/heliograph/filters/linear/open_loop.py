"""Prediction without measurements."""

import jax.numpy as jnp

from heliograph.filters.base import Step, corrects
from heliograph.filters.gaussian.belief import AbstractBeliefFilter, Belief, predicted, prior_of
from heliograph.filters.gaussian.transform import Cubature
from heliograph.filters.innovation import no_innovation
from heliograph.filters.smoother_step.base import AbstractSmootherStep
from heliograph.filters.smoother_step.building import moments_smoother_step
from heliograph.model.estimate import Claim, Innovation
from heliograph.model.over_time import at, first
from heliograph.model.plant import AnyPlant, LinearPlant, check_plant
from heliograph.numerics.types import ArrayLike, Float


class OpenLoop(AbstractBeliefFilter):
    """Prediction without measurements: the baseline for any use of them."""

    @corrects
    def correct(self, state: Belief, z: ArrayLike, k: Step = 0) -> tuple[Belief, Innovation]:
        """Return the state as it is, whatever the length of z."""
        return state, no_innovation()

    def smoother_step(
        self, before: Belief, prior: Belief, after: Belief, innovation: Innovation, z: ArrayLike, u: ArrayLike, k: Step
    ) -> AbstractSmootherStep:
        """Return the prediction as a smoother step, with no measurement after it."""
        cross = predicted(at(self.plant, k), self.transform, before, jnp.asarray(u)).cross
        return moments_smoother_step(after, prior, cross, self.claim, first(self.plant).angles)


def open_loop_filter(
    plant: AnyPlant,
    initial_mean: Float[ArrayLike, " n"] | None = None,
    initial_covariance: Float[ArrayLike, "n n"] | None = None,
) -> OpenLoop:
    """Prediction by cubature points without any measurement.

    Args:
        plant: the plant, n states.
        initial_mean: mean (n,) of the first state; the plant's by default.
        initial_covariance: its covariance (n, n); the plant's by default.

    Claim: "exact" for a linear plant started from its initial law, else "nominal".

    Raises:
        ValueError: an initial mean or covariance of the wrong shape.

    Source: the prediction step of any of the filters, alone.
    """
    start = check_plant(plant)
    mean, spread, own_prior = prior_of(start, initial_mean, initial_covariance)
    claim: Claim = "exact" if isinstance(start, LinearPlant) and not own_prior and not start.circular else "nominal"
    return OpenLoop(
        plant=plant,
        transform=Cubature(),
        initial_mean=mean,
        initial_covariance=spread,
        claim=claim,
        states=start.states,
        inputs=start.inputs,
        received=0,
    )
