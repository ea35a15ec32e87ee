"""The Kalman filter from a start that nobody knows, exactly: factors of two levels, finite and infinite."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import columns_of, triangularise
from heliograph.factors.diffuse_gaussian import (
    Diffuse,
    as_gaussian,
    condition_on_next_diffuse,
    observe_diffuse,
    predict_diffuse,
    project_diffuse,
    start_diffuse,
)
from heliograph.filters.base import AbstractSizedFilter, Step, corrects, estimates, make_sizes, predicts
from heliograph.filters.gaussian.gaussian_prediction import factor_process_noise, second_moments_at_start
from heliograph.filters.smoother_step import SmootherStep, StepTrace
from heliograph.model.assumed.assumed_model import AssumedModel, with_assumed
from heliograph.model.channel import perfect
from heliograph.model.diffuse_start import UnknownStart
from heliograph.model.estimate import Estimate, Innovation, lower_claim_by_noise
from heliograph.model.over_time import OverTime, at, first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor, check_linear, check_sensor
from heliograph.numerics.check import fail
from heliograph.numerics.types import ArrayLike


class DiffuseFilter(AbstractSizedFilter):
    """The Kalman filter of a plant with an unknown start; built by `kalman_filter`.

    The limit of filters with the covariance P + kappa P_inf at the start. Until a direction was measured, the variances
    that hold it are infinite, and what hears it has no innovation. The log-likelihood is the log of the integral of
    p(z | delta) over the unknown delta: statsmodels' has 1/2 log 2 pi less for each direction that was learned.

    Source: Koopman, Exact initial Kalman filtering and smoothing for nonstationary time series models (1997), of
    factors.
    """

    plant: AnyPlant
    sensor: AnySensor
    takes_unknown_start: ClassVar[bool] = True

    @compile_on_call
    def init(self) -> Diffuse:
        """Return the Gaussian before any data, with infinite variance in the state's unknown directions."""
        plant = first(self.plant)  # as it is at the first step
        start = plant.initial_covariance  # covariance `known` (n, n) of known components, and flags `unknown` (n,)
        finite, is_unknown = columns_of(start.known), np.array(start.unknown)
        return start_diffuse(jnp.asarray(plant.initial_mean), finite, is_unknown)

    @predicts
    def predict(self, state: Diffuse, u: ArrayLike = (), k: Step = 0) -> Diffuse:
        """Predict x over x+ = A x + B u + w.

        Unknown directions of x keep an infinite variance. To Cov w the rounding of the numbers is added, as large as
        E[x_i^2] at the start says: so no covariance becomes singular by rounding.
        """
        plant, u = at(self.plant, k), jnp.asarray(u)
        noise = factor_process_noise(plant, u, second_moments_at_start(self.plant))
        return predict_diffuse(state, plant.transition_matrix(u), plant.shift(u), noise)

    @corrects
    def correct(self, state: Diffuse, z: ArrayLike, k: Step = 0) -> tuple[Diffuse, Innovation]:
        """Condition on z = H x + v, and return the innovation z - H m - E v with its covariance H P H' + R.

        A component of z that depends on a still unknown direction of x has an infinite variance: it teaches that
        direction, and its innovation is NaN, as no prediction of it existed.
        """
        sensor, z = at(self.sensor, k), jnp.asarray(z)
        matrix, noise = jnp.asarray(sensor.matrix), sensor.noise.columns
        value = z - matrix @ state.mean - jnp.asarray(sensor.noise.mean)
        after, observed = observe_diffuse(state, matrix, value, noise)
        # H P H' of the known directions, and which components of H x depend on unknown ones too.
        covariance, depends_on_unknown = project_diffuse(state, matrix)
        innovation = jnp.where(depends_on_unknown, jnp.nan, value)
        present = ~jnp.isnan(innovation)
        total = jnp.where(present[:, None] & present, covariance + noise.covariance, jnp.nan)
        return after, Innovation(innovation, total, observed.log_likelihood)

    @estimates
    def estimate(self, state: Diffuse) -> Estimate:
        """Return the mean and covariance; an unknown component has infinite variance, and 0 in the rest of its row."""
        return Estimate(state.mean, state.covariance, self.claim)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return what a Rauch-Tung-Striebel pass needs of this step: x after the update, and x before it given x+.

        The step leads from `step.before` over x+ = A x + B u + w to `step.prior`, and by z to `step.after`. A direction
        that stays unknown given all of x+ has the variance NaN.
        """
        plant, u = at(self.plant, step.k), jnp.asarray(step.u)
        noise = triangularise(factor_process_noise(plant, u, second_moments_at_start(self.plant)))
        predicted = jnp.asarray(step.prior.mean)
        given_next = condition_on_next_diffuse(step.before, plant.transition_matrix(u), predicted, noise)
        return SmootherStep(as_gaussian(step.after), given_next, claim=self.claim)


def has_unknown_start(plant: AnyPlant) -> bool:
    """Return whether the plant's initial covariance says that nothing is known of some state (`hg.diffuse`)."""
    return isinstance(getattr(first(plant), "initial_covariance", None), UnknownStart)


def diffuse_filter(plant: AnyPlant, sensor: AnySensor) -> DiffuseFilter:
    """Return the Kalman filter of a linear plant of whose first state some components are unknown.

    Args:
        plant: a linear plant that does not vary over time, with `hg.diffuse` as its initial covariance.
        sensor: a linear sensor without inputs, received directly; it may vary over time.

    Raises:
        ValueError: a plant or sensor that is not linear, a plant that varies, a sensor with inputs.
    """
    check_linear("Kalman filter from an unknown start", plant, sensor)
    if isinstance(plant, OverTime):
        raise fail("plant with an unknown start", "one that does not vary over time", "one in over_time")
    check_sensor(first(sensor), len(plant.states))
    first(sensor).refuse_inputs("a filter from an unknown start")
    outputs = len(first(sensor).outputs)
    # "upper" instead of "exact" if a noise is only known by a bound of its covariance.
    claim = lower_claim_by_noise("exact", plant, sensor)
    filter = DiffuseFilter(plant=plant, sensor=sensor, **make_sizes(claim, plant, outputs))
    return with_assumed(filter, AssumedModel(plant, sensor, perfect(outputs)))
