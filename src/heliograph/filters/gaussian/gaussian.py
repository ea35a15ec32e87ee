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
from heliograph.numerics.angle import Angles, wrap_near
from heliograph.numerics.check import instance
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.random_affine.moments.second_moments import SecondOrder
from heliograph.random_affine.words.rounding_noise import find_rounded_noises


class GaussianFilter(AbstractGaussianStateFilter):
    """Predict by a transform, redraw, measure by the same transform, correct by an update that knows the channel.

    A linear plant or sensor needs no transform: its moments are exact.

    `channel` is the filter's model; the world may have another. Its innovation covariance is M Cov(y) M' plus the
    spread of the random gain under the nominal law; its likelihood is Gaussian with it, whatever the update bounds.

    `linear`: plant and sensor are, no gain is random and nothing is an angle, so that nothing but the mean depends on
    data. `observed_angles`: which components of z are angles; z is then read within half a turn of its expectation.
    """

    sensor: AnySensor
    channel: SecondOrder | OverTime
    rule: AbstractUpdate
    linear: bool = eqx.field(static=True)
    observed_angles: Angles = eqx.field(static=True)

    @property
    def attitude(self) -> Angles:
        """Return the places of the plant's attitudes, which it turns."""
        places: Angles = first(self.plant).manifold.rotations
        return places

    def angles_used(self) -> FilterAngles:
        """Return the angles of its plant, and those that its channel delivers."""
        return FilterAngles(first(self.plant).angles, self.observed_angles)

    def predict_signal(self, state: Gaussian, k: Step) -> Signal:
        """Return the moments of the sensor's signal y at step k, from the state before its measurement."""
        plant, sensor = at(self.plant, k), at(self.sensor, k)
        return find_signal_moments(plant, sensor, self.transform, state, second_moments_at_start(self.plant, self))

    @compile_in_float64
    def expect_signals(
        self, z: Float[Array, "*runs steps m"], u: Float[Array, "steps inputs"]
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return mean (steps, p) and covariance (steps, p, p) of the signal before each row, and z.

        Angles in z are turned by whole turns to near what is expected of them.

        Args:
            z: measurements of a run, or of several.
            u: inputs, the same of all runs.
        """

        def step(state: Gaussian, row: tuple[jax.Array, ...]) -> tuple[Gaussian, tuple[jax.Array, ...]]:
            """Filter one row (k, z, u); return the state, and the triple (mean, covariance, z).

            Mean and covariance are those of the row's signal before z. Angles in the returned z are within half a turn
            of their expected values.
            """
            k, z_k, u_k = row
            prior = self.predict(state, u_k, k)
            channel, y = at(self.channel, k), self.predict_signal(prior, k)
            near = wrap_near(z_k, channel.mean_gain @ y.mean + channel.offset, self.observed_angles)
            return self.correct(prior, z_k, k)[0], (y.mean, y.covariance, near)

        def expect(z: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            """Return for all rows the mean and covariance of the signal before z, and z with angles near their mean.

            `step` filters one row. u holds the inputs of all rows.
            """
            start, rows = jax.tree.map(jnp.asarray, self.init()), (jnp.arange(len(z)), z, jnp.asarray(u))
            mean, covariance, near = jax.lax.scan(step, start, rows)[1]
            return mean, covariance, near

        several_runs = jnp.ndim(z) == 3
        return (jax.vmap(expect) if several_runs else expect)(jnp.asarray(z))

    @corrects
    def correct(self, state: Gaussian, z: ArrayLike, k: Step = 0) -> tuple[Gaussian, Innovation]:
        """Correct with the measurement z, with moments of h(x) about the prediction.

        `unknown` is the part of the signal that decides gain and covariance. Where all is linear, the signal's mean is
        left out, so that they depend on no data. `settle` turns corrected attitudes back to their group.
        """
        channel, signal = at(self.channel, k), self.predict_signal(state, k)
        unknown = signal.about_mean() if self.linear else signal
        after, innovation = correct_signal(signal, channel, self.rule, jnp.asarray(z), self.observed_angles, unknown)
        return settle(at(self.plant, k).manifold, state.mean, after), innovation

    @property
    def is_linear(self) -> bool:
        """True where the gains depend on no data."""
        return self.linear

    @property
    def has_known_gain(self) -> bool:
        """Whether no gain is random and all is linear, so that no moment before data matters."""
        return self.linear

    @property
    def law_at_start(self) -> HasInitialMoments:
        """The filter itself, which may start from another law of the first state than its plant."""
        return self

    def trace_log_likelihood(
        self, plain: Callable[..., jax.Array], z: Float[Array, "steps m"], u: Float[Array, "steps inputs"]
    ) -> jax.Array:
        """Return plain(self, z, u), the log-likelihood; of the Kalman filter with derivatives by its covariances."""
        if not self.linear or stack_over_time(self.channel).uncertain or find_rounded_noises(self.sensor):
            return super().trace_log_likelihood(plain, z, u)
        from heliograph.filters.linear.traced_likelihood import trace_log_likelihood  # not before a trace needs it

        return trace_log_likelihood(plain, self, z, u)

    def for_single_precision(self) -> AbstractFilter:
        """Return the filter about an origin that moves."""

        return make_moving_origin_filter(self)

    def planned(self, inputs: Float[Array, "horizon inputs"]) -> AbstractFilter:
        """Precompute all covariances and gains, where they do not depend on data."""
        return plan_filter(self, inputs) if self.linear else self


def correct_signal(
    signal: Signal,
    channel: SecondOrder,
    rule: AbstractUpdate,
    z: jax.Array,
    angles: Angles = (),
    unknown: Signal | None = None,
) -> tuple[Gaussian, Innovation]:
    """Condition a signal's prior on the components of z that arrived; without any, it stays as it is.

    `unknown`: what of the signal decides gain and covariance, where that is less than all. The innovation has the
    covariance and the density of the nominal law, whatever the rule bounds.
    """
    unknown = signal if unknown is None else unknown
    expected = jnp.asarray(channel.mean_gain @ signal.mean + channel.offset)
    # By the nominal law: the best update of a known one.
    slopes, noise = jnp.asarray(channel.mean_gain) @ unknown.slopes, make_received_noise(unknown, channel)
    nominal, innovation = condition_on_measurement(unknown.prior, slopes, noise, z, expected, angles)
    received = ArrivedInnovation(jnp.asarray(innovation.value), ~jnp.isnan(z))
    return rule.condition(unknown, channel, received, nominal), innovation


def describe_channel_moments(channel: Channel, update: AbstractUpdate) -> SecondOrder | OverTime:
    """Describe the channel's second moments in the form of the update, for each step where it varies."""
    described: SecondOrder | OverTime = at_each_step(update.describe, channel)
    return described


def make_perfect_channel(sensor: AnySensor) -> Channel:
    """Return the channel that delivers all outputs of a sensor as they are."""
    return perfect(len(instance("sensor", first(sensor), AbstractSensor, "a Sensor or LinearSensor").outputs))
