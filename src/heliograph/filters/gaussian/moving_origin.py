"""Gaussian filters of deviations from an origin that moves with the estimate, for single precision."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.high_low_mean_gaussian import SplitMeanGaussian, center_gaussian, center_known
from heliograph.factors.pivots import unit_of
from heliograph.filters.base import AbstractFilter, Step, corrects, estimates, make_sizes, predicts
from heliograph.filters.gaussian.gaussian_prediction import AbstractGaussianStateFilter
from heliograph.filters.wrappers.wrapper import AbstractWrapper
from heliograph.model.assumed.assumed_model import with_assumed
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import at, first, unstack
from heliograph.model.plant import AbstractPlant, LinearPlant, NoiseFunction
from heliograph.model.sensor import AbstractSensor, LinearSensor
from heliograph.numerics.angles.angle import Angles, wrap_angles
from heliograph.numerics.compensated_arithmetic import Compensated, compensate, split_sum
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import Array, ArrayLike
from heliograph.random_affine.noises.noise import AbstractNoise


class PlantAboutCenter(AbstractPlant):
    """A plant of deviations: e = x - center before a step becomes f(center + e, u) - level after it, plus its noise.

    Args:
        model: the plant, x+ = f(x, u) + w.
        center: origin before the step (n,).
        level: origin after it (n,), near f(center, u).
        unit: eps of the precision.
    """

    model: AbstractPlant
    center: Array
    level: Array
    unit: float = eqx.field(static=True)
    noise: AbstractNoise | NoiseFunction
    initial_mean: Array
    initial_covariance: Array
    deviation: AbstractNoise | None
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)

    def transition(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """Return f(center + x, u) - level (n,) for a small deviation x, without the rounding of the large numbers."""
        return _evaluate_about(lambda y: self.model.transition(y, u), x, self.center, self.level, self.unit)

    def noise_covariance(self, u: jax.Array) -> jax.Array:
        """Return Cov w (n, n), that of the plant itself: a noise is the same whatever the origin."""
        return self.model.noise_covariance(u)

    def noise_mean(self) -> jax.Array:
        """Return E w (n,), that of the plant itself."""
        return self.model.noise_mean()


class SensorAboutCenter(AbstractSensor):
    """A sensor of deviations: e = x - center gives the signal h(center + e) - level, plus its noise.

    Args:
        model: the sensor.
        center: origin of the state (n,).
        level: origin of the signal (p,).
        unit: eps of the precision.
    """

    model: AbstractSensor
    center: Array
    level: Array
    unit: float = eqx.field(static=True)
    noise: AbstractNoise
    outputs: tuple[str, ...] = eqx.field(static=True)

    def measure(self, x: jax.Array) -> jax.Array:
        """Return h(center + x) - level (p,) for a small deviation x, without the rounding of the large numbers."""
        return _evaluate_about(self.model.measure, x, self.center, self.level, self.unit)


def _evaluate_about(
    function: Callable[[jax.Array], jax.Array], e: jax.Array, center: Array, level: Array, unit: float
) -> jax.Array:
    """Return f(center + e) - level for a small e, without the rounding error of the large numbers f and level.

    The derivative by e is that of f. `unit` is eps of the precision.
    """

    @jax.custom_jvp
    def evaluate(e: jax.Array) -> jax.Array:
        """Evaluate f(center + e) as a rounded number `high` plus its rounding error `low`, and subtract level."""
        value = compensate(function, unit)(split_sum(jnp.asarray(center), e))
        return jnp.asarray((value.high - level) + value.low)

    @evaluate.defjvp
    def _(primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Return the value at e, and its derivative along a tangent: that of f(center + e), without rounding errors."""
        _, derivative = jax.jvp(lambda e: function(center + e), primals, tangents)
        return evaluate(*primals), derivative

    value: jax.Array = evaluate(e)
    return value


class CentredFilter(AbstractWrapper):
    """Gaussian or robust filter of small deviations e from an origin c, which moves with the estimate: x = c + e.

    The base filter runs on deviations. Its plant is e -> f(c + e) - c', with an origin c' after the step. Its sensor is
    e -> h(c + e) - y with y = h(c), and it receives z - M y, with the mean gain M. So its numbers are as small as its
    deviations, however far away c is, and single precision keeps their digits. f and h are evaluated with their
    rounding errors (`numerics/compensated_arithmetic.py`); of a linear plant, F e + (F c - c') is that. After each
    prediction and each correction c becomes the rounded mean, and the mean of e its rounding error.

    A random gain multiplies the whole signal, of which nothing may be subtracted: then y = 0.

    Args:
        base: the filter.
        known_gain: whether the channel has a known gain.
        claim: its claim.
        states: names of the states.
        inputs: names of the inputs.
        received: number of received components m.
    """

    base: Any  # one that predicts and corrects a Gaussian by its fields plant, sensor and channel
    known_gain: bool = eqx.field(static=True)

    @property
    def attitude(self) -> Angles:
        """Indices of attitudes among the states: none, since plants with attitudes are not treated about an origin."""
        return ()

    @in_float64
    def init(self) -> SplitMeanGaussian:
        """Return the base filter's prior about an origin: its mean rounded to single precision (`high`).

        The rest of the mean, `low`, is the mean of the deviation e = x - high.
        """
        return center_known(self.base.init())

    @predicts
    def predict(self, state: SplitMeanGaussian, u: ArrayLike = (), k: Step = 0) -> SplitMeanGaussian:
        """Predict the deviations e = x - c; the next origin is c' = f(c, u), rounded.

        The state is c (`high`) and the Gaussian of e. `compensate` evaluates a function as a rounded number (`high`)
        plus its rounding error (`low`). `unit` is eps of the precision.
        """
        plant, u = at(self.base.plant, k), jnp.asarray(u)
        center, x = jnp.asarray(state.high), state.about_center
        unit = unit_of(center)
        if isinstance(plant, LinearPlant):
            # F (c + e) - c' = F e + (F c - c'), where F c - c' is the rounding error `low` of F c.
            next_center = compensate(lambda c: plant.transition_matrix(u) @ c, unit)(Compensated(center))
            prediction = _start_at_zero(self.base).predict(x, u, k)
            return center_gaussian(next_center.high, prediction._replace(mean=prediction.mean + next_center.low))
        # The plant of deviations, e -> f(c + e, u) - c' + w; c' is f at the mean c + E e, rounded.
        next_center = compensate(lambda c: plant.transition(c, u), unit)(Compensated(center, x.mean))
        plant_about_center = _center_plant(plant, center, next_center.high, unit)
        base = eqx.tree_at(lambda f: f.plant, _start_at_zero(self.base), plant_about_center)
        return center_gaussian(next_center.high, base.predict(x, u, k))

    @corrects
    def correct(self, state: SplitMeanGaussian, z: ArrayLike, k: Step = 0) -> tuple[SplitMeanGaussian, Innovation]:
        """Correct the deviations e = x - c with z - M h(c): M is the mean gain, and h(c) the origin's signal.

        `compensate` evaluates h(c) as a rounded number (`high`) plus its rounding error (`low`). The next origin is the
        rounded mean.
        """
        sensor, channel, center = at(self.base.sensor, k), at(self.base.channel, k), jnp.asarray(state.high)
        unit, z = unit_of(center), jnp.asarray(z)
        base, signal = _start_at_zero(self.base), compensate(sensor.measure, unit)(Compensated(center))
        # A random gain multiplies the whole signal: nothing of it may be subtracted.
        if not self.known_gain:
            signal = Compensated(jnp.zeros_like(signal.high), jnp.zeros_like(signal.high))
        z = z - channel.mean_gain @ signal.high
        if isinstance(sensor, LinearSensor) and self.known_gain:
            # H (c + e) = H c + H e: the base filter's own sensor measures e, once all of H c is subtracted.
            z = z - channel.mean_gain @ signal.low
        else:
            # Else the sensor of deviations, e -> h(c + e) - `signal.high`.
            base = eqx.tree_at(lambda f: f.sensor, base, _center_sensor(sensor, center, signal.high, unit))
        after, innovation = base.correct(state.about_center, z, k)
        return center_gaussian(center, after), innovation

    @estimates
    def estimate(self, state: SplitMeanGaussian) -> Estimate:
        """Return the rounded mean, with angles between -pi and pi, and the covariance.

        The rounding error of the mean (`state.low`) is left out: the precision in use cannot hold the sum.
        """
        mean = wrap_angles(jnp.asarray(state.high), first(self.base.plant).angles)
        return Estimate(mean, state.about_center.covariance, self.claim)

    def after_step(self, state: SplitMeanGaussian, k: Step) -> Estimate:
        """Return the mean and covariance after step k, as `estimate` does: nothing is looked up by k."""
        return self.estimate(state)


def make_moving_origin_filter(filter: AbstractGaussianStateFilter) -> AbstractFilter:
    """Return the filter of deviations from an origin that moves with the estimate.

    States far from zero then keep the digits of small changes. A filter whose plant has several modes of motion has no
    single origin, and attitudes cannot be subtracted: such filters are returned as they are.

    Args:
        filter: a filter that uses no models but its fields plant, sensor and channel.
    """
    base: Any = filter
    if not isinstance(first(base.plant), AbstractPlant) or first(base.plant).attitude:
        return filter
    has_known_gain = all(not np.any(step.gain_covariance) and not step.uncertain for step in unstack(base.channel))
    about_origin = CentredFilter(base=base, known_gain=has_known_gain, **make_sizes(base.claim, base, base.received))
    return with_assumed(about_origin, base.assumed)


def _start_at_zero(base: Any) -> Any:
    """Return a copy of the filter with an initial mean of 0.

    Filters take the rounding of their numbers from the second moments at the start. Deviations from an origin begin at
    0, so that only the initial covariance counts.
    """
    return eqx.tree_at(lambda f: f.initial_mean, base, np.zeros(np.shape(base.initial_mean)))


def _center_plant(model: AbstractPlant, center: Array, level: Array, unit: float) -> PlantAboutCenter:
    """Return the plant of deviations e = x - center, e -> f(center + e, u) - level + w, whose state starts at zero.

    `level` (n,) is the origin after the step. `unit` is eps of the precision. `deviation`, a law by which simulations
    draw the first state, is not needed.
    """
    return PlantAboutCenter(
        model=model, center=center, level=level, unit=unit, noise=model.noise, deviation=None,
        initial_mean=np.zeros(np.shape(model.initial_mean)), initial_covariance=model.initial_covariance,
        states=model.states, inputs=model.inputs, circular=model.circular,
    )  # fmt: skip


def _center_sensor(model: AbstractSensor, center: Array, level: Array, unit: float) -> SensorAboutCenter:
    """Return the sensor of deviations e = x - center, e -> h(center + e) - level.

    `level` (p,) is the signal h(center), rounded, or 0. `unit` is eps of the precision.
    """
    return SensorAboutCenter(
        model=model, center=center, level=level, unit=unit, noise=model.noise, outputs=model.outputs,
        circular=model.circular,
    )  # fmt: skip
