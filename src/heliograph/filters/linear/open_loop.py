"""The filter that hears nothing: prediction only."""

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
from heliograph.numerics.types import ArrayLike


class OpenLoop(AbstractBeliefFilter):
    """The filter that hears nothing: prediction only. What any use of the measurements has to beat."""

    @corrects
    def correct(self, state: Belief, z: ArrayLike, k: Step = 0) -> tuple[Belief, Innovation]:
        """z, of whatever length, is not used."""
        return state, no_innovation()

    def smoother_step(
        self, before: Belief, prior: Belief, after: Belief, innovation: Innovation, z: ArrayLike, u: ArrayLike, k: Step
    ) -> AbstractSmootherStep:
        """The prediction, of which nothing more is ever heard."""
        cross = predicted(at(self.plant, k), self.transform, before, jnp.asarray(u)).cross
        return moments_smoother_step(after, prior, cross, self.claim, first(self.plant).angles)


def open_loop_filter(
    plant: AnyPlant, initial_mean: ArrayLike | None = None, initial_covariance: ArrayLike | None = None
) -> OpenLoop:
    """Prediction by cubature points without any measurement.

    Claim: "exact" for a linear plant started from its own initial law, else "nominal".

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
