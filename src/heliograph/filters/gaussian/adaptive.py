"""A filter that learns the variances of its sensor's noise on line, by variational Bayes with forgetting."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import WeightedColumns
from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.base import (
    AbstractFilter,
    Step,
    corrects,
    predicts,
)
from heliograph.filters.gaussian.gaussian import GaussianFilter
from heliograph.filters.gaussian.gaussian_prediction import second_moments_at_start
from heliograph.filters.gaussian.robust import RobustFilter, predict_behind_channel, signal_without_noise
from heliograph.filters.gaussian.robust_scores import (
    SMALLEST,
    AbstractWeightingRule,
    PredictedMeasurement,
    divide_noise_by_weights,
    expected_branch_precision,
    expected_squared_residuals,
    joint_update,
    update_by_score,
)
from heliograph.filters.received_outlier_noise import NoiseBranches, ReceivedNoise, describe_outlier_noise
from heliograph.filters.wrappers.wrapper import AbstractWrapper
from heliograph.model.assumed.assumed_model import with_assumed
from heliograph.model.estimate import Innovation
from heliograph.model.over_time import OverTime, at, at_each_step
from heliograph.model.sensor import AbstractSensor
from heliograph.numerics.angles.angle import wrap_near
from heliograph.numerics.check import TINY, fail, scalar
from heliograph.numerics.gaussian_density import log_density
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.moments.second_moments import SecondOrder

ITERATIONS = 5  # of an update: the state for given noise variances, then these for the given state
PRIOR_SHAPE = 3.0  # of the inverse gamma law of each variance: the weight of six noises of the model's variance


class AdaptiveBelief(NamedTuple):
    """Law of the state, and an inverse gamma law of each noise variance, used as R = b / a (m,).

    `shape` is a and `scale` is b, (m,) each.
    """

    gaussian: Gaussian
    shape: Float[jax.Array, " m"]
    scale: Float[jax.Array, " m"]


class AdaptiveFilter(AbstractWrapper):
    """Gaussian or robust filter whose noise variances are learned. Built by `adaptive_filter`.

    The variance R of each component's noise has an inverse gamma law of shape a and scale b, used as R = b / a. Its
    prior a_0, b_0 has the variance of the filter's model, b_0 / a_0. For a component that arrived,

        a' = rho a + (1 - rho) a_0,  b' = rho b + (1 - rho) b_0,  a = a' + 1/2,
        R = b / a and b = b' + w E / 2,  E = (z - t+)^2 + V+, five times, from the same prior,

    with the noiseless measurement t, its mean t+ and variance V+ after an update with R, and the component's weight w
    (1 in a filter that weighs nothing). A component that did not arrive leaves its law unchanged.

    Args:
        base: the filter whose noise variances are learned.
        noise: its noise as it arrives, whose variance is the prior b_0 / a_0.
        memory: rho.
        claim: always "nominal".
        states: names of the states.
        inputs: names of the inputs.
        received: number of received components m.
    """

    base: GaussianFilter | RobustFilter
    noise: ReceivedNoise | OverTime
    memory: Float[jax.Array | np.ndarray, ""]

    def within(self, state: AdaptiveBelief) -> Gaussian:
        """Return the part of the state that the base filter has: the Gaussian of x, without the noise variances."""
        return state.gaussian

    @compile_on_call
    def init(self) -> AdaptiveBelief:
        """Return the filter's prior, and an inverse gamma law for each noise variance about that of the model.

        The law's shape is PRIOR_SHAPE, 3, as much as six observed noises would give.
        """
        shape = jnp.full(self.received, PRIOR_SHAPE)
        variance = jnp.diagonal(jnp.asarray(at(self.noise, k=0).covariance))
        return AdaptiveBelief(self.base.init(), shape, shape * variance)

    @predicts
    def predict(self, state: AdaptiveBelief, u: ArrayLike = (), k: Step = 0) -> AdaptiveBelief:
        """Predict the plant's state as the base filter does; the laws of the noise variances stay until data come."""
        return AdaptiveBelief(self.base.predict(state.gaussian, u, k), state.shape, state.scale)

    @corrects
    def correct(self, state: AdaptiveBelief, z: ArrayLike, k: Step = 0) -> tuple[AdaptiveBelief, Innovation]:
        """Correct the state and the laws of the noise variances with z (m,), NaN where a component did not arrive.

        Each variance R_i has an inverse gamma law of shape a_i and scale b_i. Variational Bayes corrects the state for
        given R and the laws of R for a given state, in turn. `state` has the Gaussian of x, a and b.
        """
        # Moments of the measurement without its noise, before the channel (`signal`) and behind it (`predicted`).
        base, belief, noise = self.base, state.gaussian, at(self.noise, k)
        sensor, plant = at(base.sensor, k), at(base.plant, k)
        signal = signal_without_noise(plant, sensor, base.transform, belief, second_moments_at_start(base.plant, base))
        predicted = predict_behind_channel(signal, at(base.channel, k))
        angles = base.received_angles if isinstance(base, RobustFilter) else base.observed_angles
        z = wrap_near(jnp.asarray(z), predicted.signal, angles)
        # How outliers are weighed: a robust base filter has a rule, or the Gaussian branches of the noise's law. Any
        # other base filter weighs nothing.
        rule = base.rule if isinstance(base, RobustFilter) else None
        branches = noise.find_branches(signal.mean) if isinstance(base, RobustFilter) and rule is None else None
        learned = _variational_update(
            predicted=predicted,
            shape_before=state.shape,
            scale_before=state.scale,
            z=z,
            center=noise.center,
            variance=jnp.diagonal(jnp.asarray(noise.covariance)),
            memory=jnp.asarray(self.memory),
            rule=rule,
            law=branches,
        )
        # The reported innovation is Gaussian, with the noise variances learned before z.
        value, covariance, present = z - predicted.signal - noise.center, learned.covariance, ~jnp.isnan(z)
        both_present = present[:, None] & present[None]
        density = log_density(value, covariance, jnp.abs(z) + jnp.abs(predicted.signal))
        innovation = Innovation(value, jnp.where(both_present, covariance, jnp.nan), density, learned.weight)
        return AdaptiveBelief(learned.state, learned.shape, learned.scale), innovation

    def variances(self, state: AdaptiveBelief) -> Float[np.ndarray, "... m"]:
        """Return the noise variances of the received components, b / a, of one state or of several stacked ones."""
        R: np.ndarray = np.asarray(state.scale) / np.asarray(state.shape)  # b / a
        return R

    def noise_deviations(self, state: AdaptiveBelief, k: Step = 0) -> Float[jax.Array, " outputs"]:
        """Return standard deviations of each output's noise as they were learned, in units of those of the model.

        The learned variance of each received number is scale / shape of its inverse gamma law. An output's deviation is
        the root mean square over the received numbers that carry it, or 1 if none does.
        """
        noise = at(self.noise, k)
        learned_variance, variance_of_model = state.scale / state.shape, jnp.diagonal(jnp.asarray(noise.covariance))
        ratio = learned_variance / variance_of_model
        carries = jnp.asarray(noise.output)  # (m, p): 1 where received number i carries output a
        count = jnp.sum(carries, axis=0)  # how many received numbers carry each output
        return jnp.sqrt(jnp.where(count > 0, carries.T @ ratio / jnp.maximum(count, 1), 1.0))


class VariationalUpdate(NamedTuple):
    """Result of one update: the state, a and b of the variances' law, predicted covariance of z, weights of components.

    The covariance uses the noise variances before this update: a variance that was learned from a value would make
    every value look plausible.
    """

    state: Gaussian
    shape: jax.Array
    scale: jax.Array
    covariance: jax.Array
    weight: jax.Array


class WeighedResiduals(NamedTuple):
    """Residuals of the received components with their weights, (m,) each.

    `residual` is z less its expected value and the noise's mean; `weight` divides the noise's variance in the update;
    `reported` is the weight to report; `received` says whether the component arrived and has a weight above 0.
    """

    residual: jax.Array
    weight: jax.Array
    reported: jax.Array
    received: jax.Array


def _weigh_residuals(
    predicted: PredictedMeasurement,
    e: jax.Array,
    arrived: jax.Array,
    noise: jax.Array,
    rule: AbstractWeightingRule | None,
    scaled_law: NoiseBranches | None,
    center: jax.Array,
    variance: jax.Array,
) -> WeighedResiduals:
    """Weigh the innovations: by the branches of the noise's law if given, else by a rule if given, else all by 1.

    Branches are the Gaussian parts of a mixture, such as a usual part and one of outliers. A weight below 1 enlarges
    the noise's variance of this component in the update, so that an outlier counts less.

    Args:
        predicted: prediction of z without its noise.
        e: innovations z - E z (m,), 0 where nothing arrived.
        arrived: which components arrived (m,).
        noise: present estimates of the noise's variances (m,).
        rule: how a robust filter weighs outliers, or None.
        scaled_law: Gaussian branches of the noise's law, scaled to the variances `noise`, or None.
        center: mean of the noise (m,).
        variance: variances (m,) of the noise in the model; the weight of branches is precision times these.
    """
    if scaled_law is not None:
        # w = E[variance / r_j | z] over the branches j, of variance r_j and mean m_j. `branch_mean` is the mean of the
        # m_j, weighted by precision. e = z - E z has `center` taken off already: e + center - branch_mean puts
        # `branch_mean` in its place.
        weight, branch_mean = expected_branch_precision(predicted, e + center, variance, scaled_law)
        residual = jnp.where(arrived, e + center - branch_mean, 0.0)
        return WeighedResiduals(residual=residual, weight=weight, reported=weight, received=arrived)
    if rule is not None:
        # The rule repeats weighing and correcting. A component of next to no weight counts as not received.
        weight, reported = rule.iterate(predicted, _make_independent_noise(noise), e, arrived)
        return WeighedResiduals(residual=e, weight=weight, reported=reported, received=arrived & (weight > SMALLEST))
    ones = jnp.ones_like(e)  # a filter that weighs nothing
    return WeighedResiduals(residual=e, weight=ones, reported=ones, received=arrived)


def _variational_update(
    predicted: PredictedMeasurement,
    shape_before: jax.Array,
    scale_before: jax.Array,
    z: jax.Array,
    center: jax.Array,
    variance: jax.Array,
    memory: jax.Array,
    rule: AbstractWeightingRule | None,
    law: NoiseBranches | None,
) -> VariationalUpdate:
    """Return the state x and the law of the noise variances R given z: x given R, then R given x, `ITERATIONS` times.

    R_i is inverse gamma of shape a_i and scale b_i, used as R = b / a. First a and b are forgotten towards the prior.
    Then a grows by 1/2 for each value that arrived, and b by w E[(z - t)^2] / 2, with the weight w of the value and the
    noiseless measurement t. The state is corrected with the variances before the last b.

    Args:
        predicted: prediction of z without its noise.
        shape_before: a before the step (m,).
        scale_before: b before the step (m,).
        z: what arrived (m,), NaN where nothing did.
        center: mean of the noise (m,).
        variance: nominal variance of the noise (m,).
        memory: share of a and b that a step keeps.
        rule: weights of a robust filter; None if it has none, or uses `law`.
        law: Gaussian branches of the noise, for a robust filter that updates by the score; else None.
    """
    arrived = ~jnp.isnan(z)
    # Forget towards the prior, and count the new value.
    prior_weight = PRIOR_SHAPE * (1 - memory)
    shape, scale = memory * shape_before + prior_weight, memory * scale_before + prior_weight * variance
    next_shape = shape + 0.5
    # Variational Bayes: correct x with R = b / a, then b by the expected square of the noise given that x.
    e = jnp.where(arrived, z - predicted.signal - center, 0.0)
    noise = scale / shape
    for _ in range(ITERATIONS):
        scaled_law = None if law is None else _scale_branches(law, noise / variance)
        weighed = _weigh_residuals(predicted, e, arrived, noise, rule, scaled_law, center, variance)
        weighted_noise = divide_noise_by_weights(_make_independent_noise(noise), weighed.weight)
        squared = expected_squared_residuals(predicted, weighted_noise, weighed.residual, weighed.received)
        noise = jnp.where(weighed.received, (scale + weighed.weight * squared / 2) / next_shape, noise)
    # The state with the variances before the last b.
    if scaled_law is not None:
        x = update_by_score(predicted, z, scaled_law).state
    else:
        x = joint_update(predicted, e, weighed.received, weighted_noise)
    return VariationalUpdate(
        state=x,
        shape=jnp.where(weighed.received, next_shape, shape_before),
        scale=jnp.where(weighed.received, noise * next_shape, scale_before),
        covariance=predicted.columns.covariance + jnp.diag(scale / shape),
        weight=jnp.where(arrived, weighed.reported, jnp.nan),
    )


def _make_independent_noise(variance: jax.Array) -> WeightedColumns:
    """Return columns of the covariance diag(variance) (m, m) of noises that are independent of each other."""
    return WeightedColumns(np.eye(len(variance)), variance)


def _scale_branches(law: NoiseBranches, ratio: jax.Array) -> NoiseBranches:
    """Return the law of sqrt(ratio_i) v_i for a noise v_i that is a mixture of Gaussians (its branches).

    Each branch's mean is multiplied by sqrt(ratio), its variance and least variance by `ratio` (m,); probabilities
    stay. The arrays of the law are (m, branches).
    """
    ratio_of_row = ratio[:, None]
    return NoiseBranches(
        log_share=law.log_share,
        mean=law.mean * jnp.sqrt(ratio_of_row),
        variance=law.variance * ratio_of_row,
        least=law.least * ratio_of_row,
    )


def adaptive_filter(filter: AbstractFilter, memory: ArrayLike = 0.98) -> AdaptiveFilter:
    """Return the filter with the noise variances of its sensor learned on line.

    Each variance has a law of its own (inverse gamma), which squared residuals update. At each step a share 1 -
    `memory` of this law is forgotten, and replaced by the variance of the filter's model. A component that does not
    arrive forgets nothing. The process noise is taken as true: a Q that is too small makes the learned R too large, so
    learn Q first, with `fit`. Claim: "nominal", the covariance is neither exact nor a bound.

    Args:
        filter: a Gaussian filter (kalman_filter, extended_filter, cubature_filter, ...) or a robust one.
        memory: share of the learned law that a step keeps, above 0 and at most 1 (never forget; default 0.98). About
            1 / (1 - memory) values decide a variance.

    Raises:
        ValueError: a filter that is neither Gaussian nor robust, correlated noise, a memory outside (0, 1].
    Source: Sarkka and Nummenmaa, Recursive noise adaptive Kalman filtering by variational Bayesian approximations
        (2009), with a forgetting that keeps a prior.
    """
    if not isinstance(filter, GaussianFilter | RobustFilter):
        expected = "one of kalman_filter, extended_filter, cubature_filter or robust_filter"
        raise fail("filter to adapt", expected, type(filter).__name__)
    # The noise as it arrives; a Gaussian filter's own is found from its sensor and channel.
    stored = scalar("memory of an adaptive filter", memory, low=TINY, high=1.0)
    noise = filter.noise if isinstance(filter, RobustFilter) else _find_sensor_noise(filter)
    adaptive = AdaptiveFilter(
        base=filter, noise=noise, memory=stored, claim="nominal", states=filter.states, inputs=filter.inputs,
        received=filter.received,
    )  # fmt: skip
    return with_assumed(adaptive, filter.assumed)


def _find_sensor_noise(filter: GaussianFilter) -> ReceivedNoise | OverTime:
    """Return the sensor's noise behind the filter's channel, over time if sensor or channel varies."""

    def describe(sensor: AbstractSensor, channel: SecondOrder) -> ReceivedNoise:
        """Return the law of the sensor's noise v as it arrives in z = G v + ..., by the second moments of the gain G.

        Only v is learned: noises of the channel stay in the channel's moments, so `late` (the last hop's) is None. Each
        variance is learned by itself, so noises whose components are correlated are refused (`independent`).
        """
        return describe_outlier_noise(sensed=sensor.noise, late=None, plain=channel, independent=True)

    noise: ReceivedNoise | OverTime = at_each_step(describe, filter.sensor, filter.channel)
    return noise
