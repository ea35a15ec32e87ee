"""Plants driven by a dynamical bias, and sensors whose errors have memory."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.plant import AbstractPlant, LinearPlant, Plant
from heliograph.model.sensor import AbstractSensor, LinearSensor, Sensor
from heliograph.numerics.check import array, fail, instance, rank, scalar
from heliograph.numerics.traced import is_traced, library, scipy_for
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.noise import AbstractNoise, Gaussian, Independent, Vector


def with_bias(plant: LinearPlant, coupling: "Float[ArrayLike, 'n bias']", bias: LinearPlant) -> LinearPlant:
    """Return the plant driven by a dynamical bias, as one plant of X = [x; b]: x+ = A x + E b + B u + w, b+ = F b + xi.

    Every filter of the result estimates both. A name that the plant has too gets the prefix "bias_".

    Args:
        plant: the plant of x (n states).
        coupling: E (n, bias states).
        bias: the plant of b, without inputs, independent of the first.

    Raises:
        ValueError: shapes that do not fit, a bias with inputs, noise that depends on inputs.
    Source: quadratic filtering with dynamical bias, equations (1), (2) and (10).
    """
    for what, item in (("plant with bias", plant), ("bias", bias)):
        instance(what, item, LinearPlant, "a LinearPlant")
    n, extra = len(plant.states), len(bias.states)
    coupling = array("coupling of the bias", coupling, (n, extra))
    if bias.inputs:
        raise fail("bias", "a plant without inputs", list(bias.inputs))
    # (w, xi) and the two initial states are independent.
    noises = [p.noise for p in (plant, bias) if isinstance(p.noise, AbstractNoise)]
    if len(noises) < 2:
        raise fail("noise of a plant with bias", "a covariance or a noise law", "a function of the inputs")
    deviations = [p.deviation or Gaussian(p.initial_covariance) for p in (plant, bias)]
    centers = [p.initial_mean - d.mean for p, d in zip((plant, bias), deviations, strict=True)]
    xp = library(plant.matrix, coupling, bias.matrix, centers, plant.input_matrix)
    # [x; b]+ = [[A, E], [0, F]] [x; b] + [B; 0] u + [w; xi].
    renamed = {name: f"bias_{name}" if name in plant.states else name for name in bias.states}
    return LinearPlant(
        xp.block([[plant.matrix, coupling], [np.zeros((extra, n)), bias.matrix]]),
        Independent(noises),
        xp.concatenate(centers),
        Independent(deviations),
        xp.concatenate([plant.input_matrix, np.zeros((extra, len(plant.inputs)))]),
        states=(*plant.states, *renamed.values()),
        inputs=plant.inputs,
        circular=(*plant.circular, *(renamed[name] for name in bias.circular)),
    )


def with_sensor_bias(
    plant: AbstractPlant,
    sensor: AbstractSensor,
    deviation: "Float[ArrayLike, ' biases']",
    time: "Float[ArrayLike, ' biases']" = np.inf,
    dt: "Float[ArrayLike, ''] | str" = 1.0,
    loading: "Float[ArrayLike, 'outputs biases'] | None" = None,
) -> tuple[LinearPlant | Plant, LinearSensor | Sensor]:
    """Return plant and sensor with biases of the outputs as further states, y = h(x) + D b + v.

    Each is a Gauss-Markov process: b+ = exp(-dt / T) b + w with the standard deviation `deviation` at all times; of
    infinite T it is a constant. The new states are "OUTPUT_bias", or "bias0", "bias1", ... with a loading.

    Args:
        plant: the plant.
        sensor: its sensor.
        deviation: standard deviation of each bias, or one number for all.
        time: T, in which it is forgotten to 1/e, of each or of all.
        dt: time of a step, or the name of the input that says it.
        loading: D, in which outputs each bias is (outputs, biases); one bias of each output by default.

    Raises:
        ValueError: a negative deviation, a time that is not positive, another input, shapes that do not fit.
    """
    instance("plant with sensor biases", plant, AbstractPlant, "one that does not vary")
    instance("sensor with biases", sensor, AbstractSensor, "one that does not vary")
    n, outputs = len(plant.states), len(sensor.outputs)
    matrix = np.eye(outputs) if loading is None else array("loading of the biases", loading, (outputs, "biases"))
    count = matrix.shape[1]
    size = _of_each("deviation of a bias", deviation, count, 0.0)
    rate = 1 / _of_each("time of a bias", time, count, 1e-300)
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


def _of_each(name: str, value: ArrayLike, count: int, low: float) -> Any:
    """One number for each bias, (count,), from one or from as many; an infinite time stays."""
    given: Any = value
    values = [given] * count if not rank(name, value) else list(given)
    if len(values) != count:
        raise fail(name, f"one, or one for each of {count}", len(values))
    wrong = [x for x in values if not is_traced(x) and not float(x) >= low]
    if wrong:
        raise fail(name, "a positive number" if low else "a number of at least 0", f"{float(wrong[0]):g}")
    return library(*values).stack([library(x).asarray(x) for x in values])
