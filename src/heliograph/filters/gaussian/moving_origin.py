"""Gaussian filters about an origin that moves with the estimate: a mean of a high and a low part, for few digits."""

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
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import at, first, unstack
from heliograph.model.plant import AbstractPlant, LinearPlant, NoiseFunction
from heliograph.model.premises.premise import with_premise
from heliograph.model.sensor import AbstractSensor, LinearSensor
from heliograph.numerics.angle import Angles, wrap_angles
from heliograph.numerics.compensated_arithmetic import Compensated, compensate, split_sum
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import Array, ArrayLike
from heliograph.random_affine.noise import AbstractNoise


class PlantAboutCenter(AbstractPlant):
    """A plant of x - center before a step and x - level after it: e -> f(center + e, u) - level, with its noise.

    Args:
        model: the plant.
        center: origin before the step (n,).
        level: origin after it (n,).
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
        """Return f(center + x, u) - level."""
        return _evaluate_about(lambda y: self.model.transition(y, u), x, self.center, self.level, self.unit)

    def noise_covariance(self, u: jax.Array) -> jax.Array:
        """Return the covariance of w."""
        return self.model.noise_covariance(u)

    def noise_mean(self) -> jax.Array:
        """Return the mean of w."""
        return self.model.noise_mean()


class SensorAboutCenter(AbstractSensor):
    """A sensor of x - center, which says y - level: e -> h(center + e) - level, with its noise.

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
        """Return h(center + x) - level."""
        return _evaluate_about(self.model.measure, x, self.center, self.level, self.unit)


def _evaluate_about(
    function: Callable[[jax.Array], jax.Array], e: jax.Array, center: Array, level: Array, unit: float
) -> jax.Array:
    """Return f(center + e) - level, with the digits that rounding would take; its derivative is that of f.

    `unit`: eps of the precision.
    """

    @jax.custom_jvp
    def evaluate(e: jax.Array) -> jax.Array:
        """Evaluate f in two parts, high and low."""
        value = compensate(function, unit)(split_sum(jnp.asarray(center), e))
        return jnp.asarray((value.high - level) + value.low)

    @evaluate.defjvp
    def _(primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Differentiate f itself."""
        return evaluate(*primals), jax.jvp(lambda e: function(center + e), primals, tangents)[1]

    value: jax.Array = evaluate(e)
    return value


class CentredFilter(AbstractWrapper):
    """Gaussian or robust filter that holds its state relative to an origin, which moves with the estimate.

    The plant about a center c is e -> f(c + e) - c', of an origin c' after the step, the sensor e -> h(c + e) - y, and
    what is received z - M y: what the filter within sees is as large as its deviations, however far the center is.
    Both are evaluated with what rounding takes (`numerics/compensated_arithmetic.py`); of
    linear ones F e + (F c - c') is that. After each half of a step the mean c + e is c again as it is rounded, and e
    what is left.

    A gain that is random acts on the whole signal: behind one y is 0.

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
        """Return that there are none."""
        return ()

    @in_float64
    def init(self) -> SplitMeanGaussian:
        """Return the prior about its mean as single precision has it."""
        return center_known(self.base.init())

    @predicts
    def predict(self, state: SplitMeanGaussian, u: ArrayLike = (), k: Step = 0) -> SplitMeanGaussian:
        """Predict about the origin, which becomes what the center moves to.

        The state is a center (`high`) and a Gaussian of small deviations about it. `compensate` evaluates a function
        with the rest that rounding takes (`low`); `unit`: eps of the precision.
        """
        plant, u = at(self.base.plant, k), jnp.asarray(u)
        center, x = jnp.asarray(state.high), state.about_center
        unit = unit_of(center)
        if isinstance(plant, LinearPlant):
            # F (c + e) = (F c, in two parts) + F e.
            center_after = compensate(lambda c: plant.transition_matrix(u) @ c, unit)(Compensated(center))
            after = _start_at_zero(self.base).predict(x, u, k)
            return center_gaussian(center_after.high, after._replace(mean=after.mean + center_after.low))
        # The plant about the center, evaluated with what rounding takes.
        center_after = compensate(lambda c: plant.transition(c, u), unit)(Compensated(center, x.mean))
        plant_about_center = _center_plant(plant, center, center_after.high, unit)
        base = eqx.tree_at(lambda f: f.plant, _start_at_zero(self.base), plant_about_center)
        return center_gaussian(center_after.high, base.predict(x, u, k))

    @corrects
    def correct(self, state: SplitMeanGaussian, z: ArrayLike, k: Step = 0) -> tuple[SplitMeanGaussian, Innovation]:
        """Correct about the origin: subtract the signal of the center from z, and correct the small deviations from it.

        `compensate` evaluates the signal in two parts, `high` and the rest that rounding takes, `low`; `unit`: eps of
        the precision.
        """
        sensor, channel, center = at(self.base.sensor, k), at(self.base.channel, k), jnp.asarray(state.high)
        unit, z = unit_of(center), jnp.asarray(z)
        base, signal = _start_at_zero(self.base), compensate(sensor.measure, unit)(Compensated(center))
        # A random gain multiplies the whole signal: nothing of it may be subtracted.
        if not self.known_gain:
            signal = Compensated(jnp.zeros_like(signal.high), jnp.zeros_like(signal.high))
        z = z - channel.mean_gain @ signal.high
        if isinstance(sensor, LinearSensor) and self.known_gain:
            z = z - channel.mean_gain @ signal.low
        else:
            base = eqx.tree_at(lambda f: f.sensor, base, _center_sensor(sensor, center, signal.high, unit))
        after, innovation = base.correct(state.about_center, z, k)
        return center_gaussian(center, after), innovation

    @estimates
    def estimate(self, state: SplitMeanGaussian) -> Estimate:
        """Return the mean as it is rounded, angles between -pi and pi, and the covariance."""
        mean = wrap_angles(jnp.asarray(state.high), first(self.base.plant).angles)
        return Estimate(mean, state.about_center.covariance, self.claim)

    def after_step(self, state: SplitMeanGaussian, k: Step) -> Estimate:
        """Return mean and covariance after step k."""
        return self.estimate(state)


def make_moving_origin_filter(filter: AbstractGaussianStateFilter) -> AbstractFilter:
    """Return a filter about an origin that moves with the estimate.

    States far from zero then keep the digits of small changes. A filter whose plant has attitudes, or several modes of
    motion, is returned as it is. `known_gain` is True if no gain of the channel is random or uncertain.

    Args:
        filter: one that uses its fields plant, sensor and channel alone.
    """
    base: Any = filter
    if not isinstance(first(base.plant), AbstractPlant) or first(base.plant).attitude:
        return filter
    has_known_gain = all(not np.any(step.gain_spread) and not step.uncertain for step in unstack(base.channel))
    about_origin = CentredFilter(base=base, known_gain=has_known_gain, **make_sizes(base.claim, base, base.received))
    return with_premise(about_origin, base.premise)


def _start_at_zero(base: Any) -> Any:
    """Return the filter with an initial mean of 0, so that its numbers are as large as its deviations."""
    return eqx.tree_at(lambda f: f.initial_mean, base, np.zeros(np.shape(base.initial_mean)))


def _center_plant(model: AbstractPlant, center: Array, level: Array, unit: float) -> PlantAboutCenter:
    """Return the plant of deviations from a center, whose state starts at zero.

    `level` is the origin after the step, which is subtracted from f. `unit` is eps of the precision.
    """
    return PlantAboutCenter(
        model=model, center=center, level=level, unit=unit, noise=model.noise, deviation=None,
        initial_mean=np.zeros(np.shape(model.initial_mean)), initial_covariance=model.initial_covariance,
        states=model.states, inputs=model.inputs, circular=model.circular,
    )  # fmt: skip


def _center_sensor(model: AbstractSensor, center: Array, level: Array, unit: float) -> SensorAboutCenter:
    """Return the sensor of deviations from a center.

    `level` is the signal h of the center, which is subtracted from h. `unit` is eps of the precision.
    """
    return SensorAboutCenter(
        model=model, center=center, level=level, unit=unit, noise=model.noise, outputs=model.outputs,
        circular=model.circular,
    )  # fmt: skip
