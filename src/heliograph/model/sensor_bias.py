"""Sensors whose errors have memory: biases of their outputs as states."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.enlarged import with_bias
from heliograph.model.plant import AbstractPlant, LinearPlant, Plant
from heliograph.model.sensor import AbstractSensor, LinearSensor, Sensor, check_sensor
from heliograph.numerics.check import TINY, array, fail, instance, rank, scalar
from heliograph.numerics.traced import is_traced, library, scipy_for
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.noise import AbstractNoise, Gaussian, Independent, Vector


def with_sensor_bias(
    plant: "AbstractPlant",
    sensor: "AbstractSensor",
    deviation: "Float[ArrayLike, ' biases']",
    time: "Float[ArrayLike, ' biases']" = np.inf,
    dt: "Float[ArrayLike, ''] | str" = 1.0,
    loading: "Float[ArrayLike, 'outputs biases'] | None" = None,
) -> "tuple[LinearPlant | Plant, LinearSensor | Sensor]":
    """Return plant and sensor with biases of the outputs as further states, y = h(x) + D b + v.

    Each is a Gauss-Markov process: b+ = exp(-dt / T) b + w with the standard deviation `deviation` at all times; of
    infinite T it is a constant. The new states are "OUTPUT_bias", or "bias0", "bias1", ... with a loading.

    Args:
        plant: the plant.
        sensor: its sensor.
        deviation: standard deviation of each bias (biases,), or one number for all.
        time: T, in which it is forgotten to 1/e, of each (biases,) or of all.
        dt: time of a step, or the name of the input that says it.
        loading: D, in which outputs each bias is (outputs, biases); one bias of each output by default.

    Raises:
        ValueError: a negative deviation, a time that is not positive, another input, shapes that do not fit.
    """
    instance("plant with sensor biases", plant, AbstractPlant, "one that does not vary")
    instance("sensor with biases", sensor, AbstractSensor, "one that does not vary")
    n, outputs = len(plant.states), len(sensor.outputs)
    check_sensor(sensor, n)
    matrix = np.eye(outputs) if loading is None else array("loading of the biases", loading, (outputs, "biases"))
    count = matrix.shape[1]
    sizes = [scalar("deviation of a bias", x, 0.0) for x in _of_each("deviation of a bias", deviation, count)]
    rates = [_rate(x) for x in _of_each("time of a bias", time, count)]
    size, rate = (library(values).stack([library(x).asarray(x) for x in values]) for values in (sizes, rates))
    named = [f"{name}_bias" for name in sensor.outputs] if loading is None else [f"bias{i}" for i in range(count)]
    return _with_states(plant, named, size, rate, dt), _with_loading(sensor, matrix, n)


def _with_loading(sensor: AbstractSensor, loading: np.ndarray, states: int) -> LinearSensor | Sensor:
    """The sensor of a plant with further states, which are added to its outputs."""
    if isinstance(sensor, LinearSensor):
        stacked = library(sensor.matrix, loading).concatenate([sensor.matrix, loading], axis=1)
        return LinearSensor(stacked, sensor.noise, sensor.outputs, sensor.circular)

    def measure(x: jax.Array) -> jax.Array:
        return sensor.measure(x[:states]) + jnp.asarray(loading) @ x[states:]

    return Sensor(measure, sensor.noise, sensor.outputs, sensor.circular)


def _with_states(
    plant: AbstractPlant, names: list[str], deviation: np.ndarray, rate: np.ndarray, dt: ArrayLike | str
) -> LinearPlant | Plant:
    """The plant and Gauss-Markov processes: b+ = a b + w, a = exp(-dt / T), Var w = (1 - a^2) deviation^2."""
    n, xp = len(plant.states), library(plant.initial_mean, deviation, rate)
    variance = xp.diag(deviation**2)
    if isinstance(dt, str) and dt not in plant.inputs:
        raise fail("dt", f"a number, or one of the inputs {list(plant.inputs)}", repr(dt))
    step = None if isinstance(dt, str) else scalar("time of a step", dt, 0.0)
    if step is not None and isinstance(plant, LinearPlant) and isinstance(plant.noise, AbstractNoise):
        fresh = xp.diag(deviation**2 * -xp.expm1(-2 * step * rate))
        drift = LinearPlant(xp.diag(xp.exp(-step * rate)), fresh, np.zeros(len(names)), variance, states=names)
        return with_bias(plant, np.zeros((n, len(names))), drift)

    # Steps of a length that an input says, or a plant that is not linear: both as functions.
    def passed(u: jax.Array) -> jax.Array:
        return jnp.asarray(u[plant.inputs.index(str(dt))] if step is None else step)

    def move(x: jax.Array, u: jax.Array) -> jax.Array:
        moved = plant.transition(x[:n], u) + plant.noise_mean()
        return jnp.concatenate([moved, x[n:] * jnp.exp(-passed(u) * rate)])

    def spread(u: jax.Array) -> jax.Array:
        fresh = jnp.asarray(deviation) ** 2 * -jnp.expm1(-2 * passed(u) * rate)
        return jnp.asarray(jax.scipy.linalg.block_diag(plant.noise_covariance(u), jnp.diag(fresh)))

    # Both parts of the initial state are independent; a Gaussian one is its covariance.
    center: Vector = plant.initial_mean
    start: Any = plant.initial_covariance
    if plant.deviation is None:
        start = scipy_for(start, variance).linalg.block_diag(start, variance)
    else:
        center, start = center - plant.deviation.mean, Independent([plant.deviation, Gaussian(variance)])
    center = xp.concatenate([center, np.zeros(len(names))])
    return Plant(move, spread, center, start, (*plant.states, *names), plant.inputs, plant.circular)


def _of_each(name: str, value: ArrayLike, count: int) -> list[Any]:
    """Values of the biases, from one or from as many."""
    given: Any = value
    values = list(given) if rank(name, value) else [given] * count
    if len(values) != count:
        raise fail(name, f"one, or one for each of {count}", len(values))
    return values


def _rate(time: Any) -> Any:
    """1 / T, 0 of an infinite one."""
    constant = not is_traced(time) and isinstance(time, float | np.floating) and time == np.inf
    return 0.0 if constant else 1 / scalar("time of a bias", time, TINY)
