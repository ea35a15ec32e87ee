"""Filters that doubt outliers: the score of the noise law, or rules that weigh the components of a measurement."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, columns_of, zero_covariance
from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.base import (
    AbstractFilter,
    FilterAngles,
    Step,
    corrects,
)
from heliograph.filters.gaussian.gaussian_prediction import AbstractGaussianStateFilter, second_moments_at_start
from heliograph.filters.gaussian.moment_transforms import AbstractTransform
from heliograph.filters.gaussian.moving_origin import make_moving_origin_filter
from heliograph.filters.gaussian.robust_scores import (
    AbstractWeightingRule,
    PredictedMeasurement,
    ScoreUpdate,
    divide_noise_by_weights,
    expected_squared_residuals,
    update_by_score,
    update_with_weights,
)
from heliograph.filters.gaussian.signal_moments import Signal, find_signal_moments, make_received_noise
from heliograph.filters.received_outlier_noise import ReceivedNoise
from heliograph.model.estimate import Innovation
from heliograph.model.over_time import OverTime, at, first
from heliograph.model.plant import AbstractPlant
from heliograph.model.sensor import AbstractSensor, AnySensor
from heliograph.numerics.angles.angle import Angles, wrap_near
from heliograph.numerics.check import TINY, check_count, scalar
from heliograph.numerics.gaussian_density import log_density
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.moments.second_moments import SecondOrder

Number = Float[jax.Array | np.ndarray, ""]
Degrees = Float[jax.Array | np.ndarray, " m"]


class Huber(AbstractWeightingRule):
    """Huber's weight w = min(1, c / |d|), d the innovation in its deviations: beyond c an error counts by its size.

    Source: Huber, Robust estimation of a location parameter (1964).
    """

    c: Number

    def __init__(self, c: "Float[ArrayLike, '']" = 1.345):
        """Hold c, the normalised innovation |d| beyond which a measurement's weight falls as c / |d|."""
        self.c = scalar("constant of Huber's rule", c, low=TINY)

    def weights(self, e: jax.Array, squared: jax.Array, scale: jax.Array) -> jax.Array:
        """Return min(1, c / |d|) of each component (m,); `squared` is d^2, the innovation squared over its variance."""
        within = squared <= self.c**2
        return jnp.where(within, 1.0, self.c / jnp.sqrt(jnp.where(within, 1.0, squared)))


class InverseMultiquadric(AbstractWeightingRule):
    """Weight w = 1 / (1 + d^2 / c^2), d the innovation in its deviations: a value far away loses all weight.

    The deviation is that of the whole innovation, so that good values count after an outage, when the state is
    uncertain.
    """

    c: Number

    def __init__(self, c: "Float[ArrayLike, '']" = 3.0):
        """Hold c, the normalised innovation |d| at which the weight 1 / (1 + d^2 / c^2) is a half."""
        self.c = scalar("constant of the inverse multiquadric rule", c, low=TINY)

    def weights(self, e: jax.Array, squared: jax.Array, scale: jax.Array) -> jax.Array:
        """Return 1 / (1 + d^2 / c^2) of each component (m,).

        `squared` is d^2, the squared innovation over its variance.
        """
        return 1 / (1 + squared / self.c**2)


class WoLF(AbstractWeightingRule):
    """Weight w = 1 / (1 + e^2 / (c^2 r)), by the noise's variance r alone (a squared weight of the likelihood).

    Source: Duran-Martin et al., Outlier-robust Kalman filtering through generalised Bayes (2024), freed of units by r.
    """

    c: Number

    def __init__(self, c: "Float[ArrayLike, '']"):
        """Hold c, the innovation in deviations of the noise at which the weight 1 / (1 + e^2 / (c^2 r)) is a half."""
        self.c = scalar("constant of the weighted likelihood filter", c, low=TINY)

    def weights(self, e: jax.Array, squared: jax.Array, scale: jax.Array) -> jax.Array:
        """Return 1 / (1 + e^2 / (c^2 r)) of each component (m,), for innovations e and noise variances r (`scale`)."""
        return 1 / (1 + e**2 / (self.c**2 * scale))


class Gate(AbstractWeightingRule):
    """Chi-squared gate: w = 1 where d^2 <= c, else 0. It may lock a filter out after an outage.

    Locked out, it rejects right values since its own state is wrong. With `after` or `seconds` it gives in: it accepts
    what it has rejected for too long.

    Args:
        c: limit of the squared deviation d^2 (default 9).
        after: number of rejections in a row after which a number is accepted; None for no such limit.
        seconds: duration of rejections in a row after which a number is accepted, for a plant with the input dt; None
            for no such limit. It should be so long that the other sensors tell a wrong sensor from a wrong state
            (`heliograph.filters.gaussian.recovering_gate`).

    Source: Bar-Shalom, Li and Kirubarajan, Estimation with applications to tracking and navigation (2001).
    """

    c: Number
    after: int | None = eqx.field(static=True)
    seconds: float | None = eqx.field(static=True)

    def __init__(self, c: "Float[ArrayLike, '']" = 9.0, after: int | None = None, seconds: float | None = None):
        """Keep the limit c of a squared innovation over its variance, and when a rejected number is accepted.

        It is after `after` rejections in a row, or after `seconds` of rejections; if both are None, never.
        """
        self.c = scalar("limit of the gate", c, low=TINY)
        self.after = None if after is None else check_count("after, of a gate", after)
        self.seconds = None if seconds is None else float(scalar("seconds of a gate", seconds, low=TINY))

    @property
    def gives_in(self) -> bool:
        """True if the gate accepts a number after rejecting it for too long: `after` or `seconds` set a limit."""
        return self.after is not None or self.seconds is not None

    def weights(self, e: jax.Array, squared: jax.Array, scale: jax.Array) -> jax.Array:
        """Return 1 where d^2 is at most c (used in full), else 0 (left out).

        `squared` is d^2, the squared innovation of each component over its variance (m,).
        """
        return jnp.where(squared <= self.c, 1.0, 0.0)


class StudentVB(AbstractWeightingRule):
    """Variational Bayes for Student's noise: `iterations` updates from the prior, each with the last one's weights.

    w_i = (nu + 1) / (nu + E_i / r_i) with E_i = (z_i - t_i+)^2 + V_ii+, where t is the measurement without its noise,
    t+ and V+ its mean and covariance after the update, and r_i the noise's variance. nu are the noise's degrees of
    freedom.

    Source: Piche, Sarkka and Hartikainen, Recursive outlier-robust filtering and smoothing for nonlinear systems using
    the multivariate Student-t distribution (2012).
    """

    iterations: int = eqx.field(static=True)
    degrees: Degrees

    def __init__(self, iterations: int = 4):
        """Hold the number of variational updates; the filter that uses the rule fills in the degrees of freedom nu."""
        self.iterations = check_count("iterations of variational Bayes", iterations)
        self.degrees = np.zeros(0)

    def of_law(self, degrees: Degrees) -> "StudentVB":
        """Return the same rule with the degrees of freedom of each received component's Student law."""
        rule = StudentVB(self.iterations)
        object.__setattr__(rule, "degrees", degrees)  # past the check that fields of a built object are not assigned
        return rule

    def iterate(
        self, before: PredictedMeasurement, noise: WeightedColumns, e: jax.Array, present: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return the weights (m,) of the last of `iterations` updates, and the weights that follow from it.

        A weight divides the variance of a noise. The first weights are 1. After each update they are
        w_i = (nu + 1) / (nu + E[(e_i - t_i)^2] / r_i), with nu degrees of freedom and a noise of variance r_i. t is the
        part of the innovations e that comes from the state's error.
        """
        variance = noise.diagonal
        weights = next_weights = jnp.broadcast_to(jnp.ones_like(variance), e.shape)
        for _ in range(self.iterations):
            weights = next_weights
            residual = expected_squared_residuals(before, divide_noise_by_weights(noise, weights), e, present)
            nu = jnp.asarray(self.degrees)
            next_weights = (nu + 1) / (nu + residual / variance)
        return weights, next_weights


class RobustFilter(AbstractGaussianStateFilter):
    """Mean and covariance, corrected by the score of the noise law or by one update with weighted noise.

    Built by `robust_filter`. Only the noise that may hold outliers is weighed, whose law as it arrives is `noise`. The
    channel is described without it; the covariance of the gain and the relays' noise are never weighed.

    Args:
        sensor: the sensor, or its steps.
        channel: moments of the channel without the noise that may hold outliers.
        noise: that noise as it arrives.
        rule: weights, or None for the score update.
        received_angles: indices of received components that are angles.
    """

    sensor: AnySensor
    channel: SecondOrder | OverTime
    noise: ReceivedNoise | OverTime
    rule: AbstractWeightingRule | None
    received_angles: Angles = eqx.field(static=True)

    def angles_used(self) -> FilterAngles:
        """Return the indices of states that are angles, and of components of z that are."""
        return FilterAngles(first(self.plant).angles, self.received_angles)

    @corrects
    def correct(self, state: Gaussian, z: ArrayLike, k: Step = 0) -> tuple[Gaussian, Innovation]:
        """Correct with what arrived of z, by the rule's weights or by the noise's own law.

        `self.rule` gives the components weights, for one joint update. If it is None, the noise's law is used: a
        mixture of Gaussian branches, whose posterior moments are computed one component after another (the score
        update). The law depends on `sensor_mean`, the mean of the sensor's signal, if the gain is random.
        """
        predicted, sensor_mean = self.predict_received(state, k)
        z = wrap_near(jnp.asarray(z), predicted.signal, self.received_angles)
        noise = at(self.noise, k)
        if self.rule is None:
            branches = noise.find_branches(sensor_mean)
            after = update_by_score(predicted, z, branches)
            center, variance = branches.mean_and_variance()
            return after.state, _innovation_about_mean(predicted, z, center, jnp.diag(variance), after, by_law=True)
        after = update_with_weights(predicted, z, noise.center, columns_of(noise.covariance), self.rule)
        return after.state, _innovation_about_mean(predicted, z, noise.center, noise.covariance, after)

    def for_single_precision(self) -> AbstractFilter:
        """Return the same filter of small deviations from an origin that moves with the estimate.

        Far from zero, single precision would round a state by more than its deviation; deviations keep their digits.
        """
        return make_moving_origin_filter(self)

    def predict_received(self, state: Gaussian, k: Step) -> tuple[PredictedMeasurement, jax.Array]:
        """Return the prediction of t, where z = t + the noise that may hold outliers, and E h(x) with the noise's mean.

        t is what the channel makes of the sensor's signal, with all other noise. The mean of the signal is needed where
        the gain is random: then it scales the noise's law.
        """
        sensor, channel = at(self.sensor, k), at(self.channel, k)
        initial_power = second_moments_at_start(self.plant, self)
        signal = signal_without_noise(at(self.plant, k), sensor, self.transform, state, initial_power)
        return predict_behind_channel(signal, channel), signal.mean


def signal_without_noise(
    plant: AbstractPlant,
    sensor: AbstractSensor,
    transform: AbstractTransform,
    state: Gaussian,
    initial_power: jax.Array,
) -> Signal:
    """Return the moments of the sensor's signal with the mean of its noise, but without the noise's covariance.

    The noise's law is weighed apart, as it may hold outliers.

    Args:
        plant: the plant, whose states may be angles or attitudes.
        sensor: gives h(x), and the mean of its noise.
        transform: moments of a nonlinear h.
        state: the predicted Gaussian of x.
        initial_power: E[x_i^2] before any data (n,), the size of the numbers that are rounded.
    """
    no_noise = zero_covariance(len(sensor.outputs))
    return find_signal_moments(plant, sensor, transform, state, initial_power, no_noise)


def predict_behind_channel(signal: Signal, channel: SecondOrder) -> PredictedMeasurement:
    """Return the mean, slopes and noise of t = G y + n, what a channel makes of the signal y.

    With M = E G and b = E n the mean is M E y + b, and the slopes are M times those of y. The noise is that of n, that
    of y, and (G - M) y: what a random gain adds.
    """
    gain = jnp.asarray(channel.mean_gain)  # M
    return PredictedMeasurement(
        prior=signal.prior,
        signal=gain @ signal.mean + channel.offset,
        slopes=gain @ signal.slopes,
        noise=make_received_noise(signal, channel),
    )


def _innovation_about_mean(
    before: PredictedMeasurement,
    z: jax.Array,
    center: jax.Array,
    noise: jax.Array,
    after: ScoreUpdate,
    by_law: bool = False,
) -> Innovation:
    """Return the innovation z - E z, with the covariance Cov t + Cov(noise) of the model.

    Args:
        before: prediction of t, the measurement without the noise that may hold outliers.
        z: what was received (m,), NaN where a component did not arrive.
        center: mean of that noise (m,).
        noise: its covariance (m, m).
        after: result of the update, with the weights of components.
        by_law: whether the density is that of the noise's mixture, as the score update found it; else it is Gaussian.
    """
    present = ~jnp.isnan(z)
    expected = before.signal + center
    value, covariance = z - expected, before.columns.covariance + noise
    both_present = present[:, None] & present[None]
    density = after.log_density if by_law else log_density(value, covariance, jnp.abs(z) + jnp.abs(expected))
    return Innovation(value, jnp.where(both_present, covariance, jnp.nan), density, after.weight)
