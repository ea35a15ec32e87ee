"""Gaussian filter: mean and covariance by a transform (cubature, Jacobian), on the channel's second moments."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.factors.factored_gaussian import Gaussian
from heliograph.factors.gaussian_on_group import settle
from heliograph.filters.base import AbstractFilter, FilterAngles, Step, corrects
from heliograph.filters.gaussian.gaussian_prediction import (
    AbstractGaussianStateFilter,
    HasInitialMoments,
    second_moments_at_start,
)
from heliograph.filters.gaussian.moving_origin import make_moving_origin_filter
from heliograph.filters.gaussian.signal_moments import (
    ArrivedInnovation,
    Signal,
    condition_on_measurement,
    find_signal_moments,
    make_received_noise,
)
from heliograph.filters.gaussian.uncertain_channel_updates import AbstractUpdate
from heliograph.filters.linear.precomputed_filter import plan_filter
from heliograph.model.channel import Channel, perfect
from heliograph.model.estimate import Innovation
from heliograph.model.over_time import OverTime, at, at_each_step, first, stack_over_time
from heliograph.model.sensor import AbstractSensor, AnySensor
from heliograph.numerics.angles.angle import Angles, wrap_near
from heliograph.numerics.check import instance
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.random_affine.moments.second_moments import SecondOrder
from heliograph.random_affine.words.rounding_noise import find_rounded_noises


class GaussianFilter(AbstractGaussianStateFilter):
    """Predict by a transform, redraw, measure by the same transform, correct by an update that knows the channel.

    A linear plant or sensor needs no transform: its moments are exact.

    `channel` has the second moments of the filter's model of z = G y + n; the world may differ. With M = E G, the
    innovation's covariance is M Cov(y) M' + Cov((G - M) y + n) by the nominal law, and the likelihood is Gaussian with
    it. `rule` says how the error covariance is bounded if the law of G is uncertain.

    `linear`: plant and sensor are linear, no gain is random and nothing is an angle, so that only the mean depends on
    data. `observed_angles`: which components of z are angles; z is then read within half a turn of its expectation.
    """

    sensor: AnySensor
    channel: SecondOrder | OverTime
    rule: AbstractUpdate
    linear: bool = eqx.field(static=True)
    observed_angles: Angles = eqx.field(static=True)

    @property
    def attitude(self) -> Angles:
        """Indices of the plant's attitudes: a correction rotates them instead of adding."""
        indices: Angles = first(self.plant).manifold.rotations
        return indices

    def angles_used(self) -> FilterAngles:
        """Return the indices of states that are angles, and of components of z that are."""
        return FilterAngles(first(self.plant).angles, self.observed_angles)

    def predict_signal(self, state: Gaussian, k: Step) -> Signal:
        """Return the moments of the sensor's signal y = h(x) + v at step k, from the predicted Gaussian of x.

        They are E y, the slopes of y in the factors of x, and Cov v with the curvature of h. `self.transform` finds
        them where h is not linear.
        """
        plant, sensor = at(self.plant, k), at(self.sensor, k)
        return find_signal_moments(plant, sensor, self.transform, state, second_moments_at_start(self.plant, self))

    @compile_in_float64
    def expect_signals(
        self, z: Float[Array, "*runs steps m"], u: Float[Array, "steps inputs"]
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the predicted mean (steps, p) and covariance (steps, p, p) of the sensor's signal y, and z.

        y = h(x) + v is what the sensor sends, p numbers; the channel makes z = G y + n of it. Each row's moments are
        those given all rows before it. Angles in the returned z have full turns added, so that they are within half a
        turn of their expected values. With several runs all results have a leading axis of runs.

        Args:
            z: measurements of a run (steps, m), or of several (runs, steps, m).
            u: inputs (steps, inputs), the same of all runs.
        """

        def step(state: Gaussian, row: tuple[jax.Array, ...]) -> tuple[Gaussian, tuple[jax.Array, ...]]:
            """Filter one row (k, z, u); return the state after it, and the triple (E y, Cov y, z) of its signal y.

            Angles in the returned z are within half a turn of their expected values.
            """
            k, z_k, u_k = row
            prior = self.predict(state, u_k, k)
            channel, y = at(self.channel, k), self.predict_signal(prior, k)
            expected_z = channel.mean_gain @ y.mean + channel.offset  # E z = E[G] E y + E n
            z_near_expected = wrap_near(z_k, expected_z, self.observed_angles)
            after, _ = self.correct(prior, z_k, k)
            return after, (y.mean, y.covariance, z_near_expected)

        def expect(z: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            """Filter all rows of one run z (steps, m), and return what `step` returns of each, stacked."""
            start = jax.tree.map(jnp.asarray, self.init())
            rows = jnp.arange(len(z)), z, jnp.asarray(u)
            _, (mean, covariance, z_near_expected) = jax.lax.scan(step, start, rows)
            return mean, covariance, z_near_expected

        several_runs = jnp.ndim(z) == 3
        return (jax.vmap(expect) if several_runs else expect)(jnp.asarray(z))

    @corrects
    def correct(self, state: Gaussian, z: ArrayLike, k: Step = 0) -> tuple[Gaussian, Innovation]:
        """Condition the predicted Gaussian of x on z = G y + n, where y = h(x) + v is the sensor's signal.

        Moments of y come from the transform. `self.rule` bounds the error covariance if the law of G is uncertain.
        """
        channel, signal = at(self.channel, k), self.predict_signal(state, k)
        # Gain and covariance: behind a known gain they do not depend on E y, which is data. So it is set to 0 there.
        moments_for_gain = signal.about_mean() if self.linear else signal
        after, innovation = correct_signal(
            signal=signal,
            channel=channel,
            rule=self.rule,
            z=jnp.asarray(z),
            angles=self.observed_angles,
            moments_for_gain=moments_for_gain,
        )
        # Attitudes: the corrected mean is a rotation vector from the predicted attitude, which is rotated by it.
        return settle(at(self.plant, k).manifold, state.mean, after), innovation

    @property
    def is_linear(self) -> bool:
        """True if gains and covariances do not depend on data: all is linear, and no gain of the channel is random."""
        return self.linear

    @property
    def has_known_gain(self) -> bool:
        """True if all gains of the channel are known.

        A random gain multiplies the whole signal, so that covariances would need E[x x'] before any data. `linear` says
        that no gain is random, and that plant and sensor are linear, too: only such filters are asked.
        """
        return self.linear

    @property
    def law_at_start(self) -> HasInitialMoments:
        """What holds the law of the first state: this filter, which may start from another law than its plant's."""
        return self

    def trace_log_likelihood(
        self, plain: Callable[..., jax.Array], z: Float[Array, "steps m"], u: Float[Array, "steps inputs"]
    ) -> jax.Array:
        """Return the log-likelihood of rows inside a traced function, for derivatives by free parameters.

        Args:
            plain: computes it by the filter's own steps, plain(self, z, u). JAX differentiates these.
            z: measurements, NaN for what did not arrive.
            u: inputs.

        A linear filter (Kalman's) computes the same value with a derivative that goes by covariances instead of their
        factors, which is faster.
        """
        # The faster derivative is that of Kalman's filter alone: no bounds over laws, no rounding by a quantizer.
        if not self.linear or stack_over_time(self.channel).uncertain or find_rounded_noises(self.sensor):
            return super().trace_log_likelihood(plain, z, u)
        from heliograph.filters.linear.traced_likelihood import trace_log_likelihood  # imported only where it is used

        return trace_log_likelihood(plain, self, z, u)

    def for_single_precision(self) -> AbstractFilter:
        """Return the filter of small deviations from an origin that moves with the estimate.

        Far from zero, single precision would round a state by more than its deviation; deviations keep their digits.
        """
        return make_moving_origin_filter(self)

    def planned(self, inputs: Float[Array, "horizon inputs"]) -> AbstractFilter:
        """Return the filter with all covariances and gains computed in advance, for these inputs and complete data.

        Only a linear filter can: elsewhere they depend on data, and the filter is returned as it is.
        """
        return plan_filter(self, inputs) if self.linear else self


def correct_signal(
    signal: Signal,
    channel: SecondOrder,
    rule: AbstractUpdate,
    z: jax.Array,
    angles: Angles = (),
    moments_for_gain: Signal | None = None,
) -> tuple[Gaussian, Innovation]:
    """Condition the state on z = G y + n, where the signal y = E y + slopes xi + v comes from x = m + L xi.

    Args:
        signal: mean and slopes of y, and the prior of x: its mean m and factor L.
        channel: second moments of the random gain G and the noise n.
        rule: how the error covariance is bounded if the law of G is uncertain, as one of a set of laws.
        z: measurement (m,), NaN where a component did not arrive. If none arrived, the prior is returned.
        angles: which components of z are angles.
        moments_for_gain: moments of y that gain and covariance use, by default `signal`; a linear filter gives those
            before any data, so that its gains depend on no data.

    Returns:
        The posterior of x, and the innovation with the covariance and density of the nominal law of G, its center.
    """
    moments_for_gain = signal if moments_for_gain is None else moments_for_gain
    expected = jnp.asarray(channel.mean_gain @ signal.mean + channel.offset)  # E z = M E y + E n
    # The Kalman update by the nominal law: z = E z + M slopes xi + noise, M = E G. The noise has the covariance of all
    # else in z: of (G - M) y, of M v and of n.
    slopes = jnp.asarray(channel.mean_gain) @ moments_for_gain.slopes
    noise = make_received_noise(moments_for_gain, channel)
    nominal, innovation = condition_on_measurement(moments_for_gain.prior, slopes, noise, z, expected, angles)
    # The rule returns `nominal` if the law is known, else an update that minimises a bound.
    received = ArrivedInnovation(jnp.asarray(innovation.value), ~jnp.isnan(z))
    return rule.condition(moments_for_gain, channel, received, nominal), innovation


def describe_channel_moments(channel: Channel, update: AbstractUpdate) -> SecondOrder | OverTime:
    """Return the moments of z = G y + n (E G, Cov G, Cov n, and bounds over uncertain laws) that the update works by.

    For a channel that varies over time they are those of each step.
    """
    described: SecondOrder | OverTime = at_each_step(update.describe, channel)
    return described


def make_perfect_channel(sensor: AnySensor) -> Channel:
    """Return the channel that delivers all outputs of a sensor as they are."""
    return perfect(len(instance("sensor", first(sensor), AbstractSensor, "a Sensor or LinearSensor").outputs))
