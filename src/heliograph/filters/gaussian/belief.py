"""Filters whose state is a mean and a covariance: their prior, prediction and estimate, and the one without data."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp

from heliograph.filters.base import (
    AbstractSizedFilter,
    FilterAngles,
    Step,
    corrects,
    estimates,
    predicts,
    sized,
)
from heliograph.filters.gaussian.transform import AbstractTransform, Cubature, Transformed, linear_transform
from heliograph.filters.innovation import no_innovation
from heliograph.filters.smoother_step.base import AbstractSmootherStep, StepTrace
from heliograph.filters.smoother_step.building import MomentsSmootherStep, moments_smoother_step
from heliograph.model.estimate import Claim, Estimate, Innovation, given_bounds
from heliograph.model.over_time import at, first
from heliograph.model.plant import AbstractPlant, AnyPlant, LinearPlant, check_plant
from heliograph.model.premise import believes
from heliograph.numerics.angle import wrapped
from heliograph.numerics.check import array, covariance
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import Array, ArrayLike, Float, PyTree


class Belief(NamedTuple):
    """Mean (n,) and covariance (n, n) of the state given the data so far."""

    mean: Float[jax.Array, " n"]
    covariance: Float[jax.Array, "n n"]


class AbstractBeliefFilter(AbstractSizedFilter):
    """A filter whose state is a `Belief`, predicted by a transform, or exactly where the plant is linear.

    Shapes: initial_mean (n,), initial_covariance (n, n).
    """

    plant: AnyPlant
    transform: AbstractTransform
    initial_mean: Array
    initial_covariance: Array

    def angles_used(self) -> FilterAngles:
        """Return the angles of its plant, and those that its channel delivers."""
        return FilterAngles(first(self.plant).angles, ())

    @in_float64
    def init(self) -> Belief:
        """Return the belief before any data."""
        return Belief(jnp.asarray(self.initial_mean), jnp.asarray(self.initial_covariance))

    @predicts
    def predict(self, state: Belief, u: ArrayLike = (), k: Step = 0) -> Belief:
        """Mean and covariance of f(x, u) + w."""
        return Belief(*predicted(at(self.plant, k), self.transform, state, jnp.asarray(u))[:2])

    @estimates
    def estimate(self, state: Belief) -> Estimate:
        """Mean and covariance of the belief, angles between -pi and pi."""
        return Estimate(wrapped(state.mean, first(self.plant).angles), state.covariance, self.claim)

    def smoother_step(self, step: StepTrace) -> AbstractSmootherStep:
        """Return the moments around the update."""
        return moments_around(self, step)


def predicted(plant: AbstractPlant, transform: AbstractTransform, state: Belief, u: jax.Array) -> Transformed:
    """Mean and covariance of f(x, u) + w, and Cov(x, f(x, u))."""
    if isinstance(plant, LinearPlant):
        moved = linear_transform(plant.transition_matrix(u), plant.transition(state.mean, u), state.covariance)
    else:
        moved = transform.apply(plant.moves(u, state.mean), *state)
    return Transformed(moved.mean + plant.noise_mean(), moved.covariance + plant.noise_covariance(u), moved.cross)


class PredictsByTransform(Protocol):
    """A filter that predicts its plant by a transform."""

    plant: AnyPlant
    transform: AbstractTransform
    claim: Claim


def moments_around(
    filter: PredictsByTransform,
    step: StepTrace,
    whole: Callable[[PyTree], Belief] | None = None,
) -> MomentsSmootherStep:
    """Smoother step by the moments around an update; `whole` reads them off a state that has others than its own."""
    plant, read = at(filter.plant, step.k), whole or (lambda state: Belief(state.mean, state.covariance))
    before, prior, after = map(read, step[:3])
    cross = predicted(plant, filter.transform, before, jnp.asarray(step.u)).cross
    return moments_smoother_step(after, prior, cross, filter.claim, plant.angles)


def prior_of(
    plant: AbstractPlant, initial_mean: ArrayLike | None, initial_covariance: ArrayLike | None
) -> tuple[Array, Array, bool]:
    """Return initial mean (n,) and covariance (n, n), the plant's where None is given, and whether any was given."""
    n = len(plant.states)
    mean = plant.initial_mean if initial_mean is None else array("filter's initial mean", initial_mean, (n,))
    spread = plant.initial_covariance
    if initial_covariance is not None:
        spread = covariance("filter's initial covariance", initial_covariance, n)
    return mean, spread, initial_mean is not None or initial_covariance is not None


class OpenLoop(AbstractBeliefFilter):
    """Prediction without measurements: the baseline for any use of them."""

    @corrects
    def correct(self, state: Belief, z: ArrayLike, k: Step = 0) -> tuple[Belief, Innovation]:
        """Return the state as it is, whatever the length of z."""
        return state, no_innovation()


@believes
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

    Claim: "exact" for a linear plant started from its initial law ("upper" where noise is known by bounds), else
        "nominal".

    Raises:
        ValueError: an initial mean or covariance of the wrong shape.

    Source: the prediction step of any of the filters, alone.
    """
    start = check_plant(plant)
    mean, spread, prior_given = prior_of(start, initial_mean, initial_covariance)
    linear = isinstance(start, LinearPlant) and not prior_given and not start.circular
    claim = given_bounds("exact" if linear else "nominal", plant)
    return OpenLoop(
        plant=plant,
        transform=Cubature(),
        initial_mean=mean,
        initial_covariance=spread,
        **sized(claim, start, 0),
    )
