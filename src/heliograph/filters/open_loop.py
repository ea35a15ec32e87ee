"""The filter that hears nothing: prediction only."""

import equinox as eqx
import jax.numpy as jnp

from heliograph.filters.base import AbstractFilter, Step, corrects, predicts
from heliograph.filters.gaussian import Belief, predicted, prior_of
from heliograph.filters.innovation import no_innovation
from heliograph.filters.retained import AbstractRetained
from heliograph.filters.retaining import moments_retained
from heliograph.filters.transform import AbstractTransform, Cubature
from heliograph.model.estimate import Claim, Estimate, Innovation
from heliograph.model.over_time import at, first
from heliograph.model.plant import AnyPlant, LinearPlant, check_plant
from heliograph.numerics.angle import wrapped
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import Array, ArrayLike


class OpenLoop(AbstractFilter):
    """The filter that hears nothing: prediction only. What any use of the measurements has to beat."""

    plant: AnyPlant
    transform: AbstractTransform
    initial_mean: Array
    initial_covariance: Array
    claim: Claim = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    received: int = eqx.field(static=True)

    @in_float64
    def init(self) -> Belief:
        """The prior."""
        return Belief(jnp.asarray(self.initial_mean), jnp.asarray(self.initial_covariance))

    @predicts
    def predict(self, state: Belief, u: ArrayLike = (), k: Step = 0) -> Belief:
        """Mean and covariance of f(x, u) + w."""
        plant, u = at(self.plant, k), jnp.asarray(u)
        moved = self.transform.apply(plant.moves(u, state.mean), *state)
        return Belief(moved.mean + plant.noise_mean(), moved.covariance + plant.noise_covariance(u))

    @corrects
    def correct(self, state: Belief, z: ArrayLike, k: Step = 0) -> tuple[Belief, Innovation]:
        """z, of whatever length, is not used."""
        return state, no_innovation()

    @in_float64
    def estimate(self, state: Belief) -> Estimate:
        """The prediction."""
        return Estimate(wrapped(state.mean, first(self.plant).angles), state.covariance, self.claim)

    def retain(
        self, before: Belief, prior: Belief, after: Belief, heard: Innovation, z: ArrayLike, u: ArrayLike, k: Step
    ) -> AbstractRetained:
        """The prediction, of which nothing more is ever heard."""
        cross = predicted(at(self.plant, k), self.transform, before, jnp.asarray(u)).cross
        return moments_retained(after, prior, cross, self.claim, first(self.plant).angles)


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
