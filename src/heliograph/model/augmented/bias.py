"""Biases with a motion of their own as states: they drive a plant, or are errors of its sensor, or both."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.model.plant import AbstractPlant, JointNoise, LinearPlant, MatrixOfInputs, Plant, matrix_under_inputs
from heliograph.model.sensor import AbstractSensor, LinearSensor, Sensor, check_sensor
from heliograph.numerics.check import TINY, array, fail, instance, rank, scalar
from heliograph.numerics.module import Module
from heliograph.numerics.numpy_or_jax import is_traced, library
from heliograph.numerics.types import Array, ArrayLike, Float, rename
from heliograph.random_affine.noises.noise import AbstractNoise, Gaussian, Independent

Biases = TypeAliasType("Biases", Float[ArrayLike, " biases"])  # or one number for all
OfBiases = TypeAliasType("OfBiases", Float[ArrayLike, "rows biases"])


def with_bias(
    plant: "AbstractPlant",
    sensor: "AbstractSensor",
    bias: "LinearPlant | Biases",
    time: Biases = np.inf,
    dt: "float | str" = 1.0,
    coupling: "OfBiases | None" = None,
    loading: "OfBiases | None" = None,
) -> "tuple[LinearPlant | Plant, LinearSensor | Sensor]":
    """Return plant and sensor with a bias b as further states: x+ = f(x, u) + E b + w, y = h(x) + D b + v.

    The bias moves by b+ = F b + xi, and every filter of the result estimates both. By default each output has one and
    the plant none, E = 0, D = I; with a coupling E the outputs have none. Biases of given deviations are Gauss-Markov
    processes, F = exp(-dt / T), of the same deviation at all times; of infinite T they are constants. Their states are
    "OUTPUT_bias", or "bias0", "bias1", ... with a coupling or loading. A state of a plant of b with a name that x has
    gets the prefix "bias_".

    Args:
        plant: the plant of x (n states).
        sensor: its sensor.
        bias: standard deviation of each bias (biases,), or one for all; or the plant of b, independent of the first,
            whose inputs are some of its.
        time: T, in which a bias of a given deviation is forgotten to 1/e, of each (biases,) or of all (default inf).
        dt: time of a step, or the name of the input that says it (default 1).
        coupling: E, how each bias drives the plant (n, biases) (default none).
        loading: D, in which outputs each bias is (outputs, biases) (default none).

    Raises:
        ValueError: a negative deviation, a time that is not positive, another input, shapes that do not fit.
    Source: quadratic filtering with dynamical bias, equations (1), (2) and (10).
    """
    instance("plant with a bias", plant, AbstractPlant, "one that does not vary")
    instance("sensor with a bias", sensor, AbstractSensor, "one that does not vary")
    n, outputs = len(plant.states), len(sensor.outputs)
    check_sensor(sensor, n)
    # How many biases there are: a plant of b says, or the outputs, or the columns of E. Else the columns of D say, and
    # `count` stays a name, with which `array` takes any number of them.
    by_output = coupling is None and loading is None
    count: int | str = "biases"
    if isinstance(bias, LinearPlant):
        count = len(bias.states)
    elif by_output:
        count = outputs
    # E (n, biases) and D (outputs, biases).
    E = None if coupling is None else array("coupling of the bias", coupling, (n, count))
    count = count if E is None else E.shape[1]
    D: Any = loading
    if loading is None:
        D = np.eye(outputs) if by_output else np.zeros((outputs, count))
    D = array("loading of the bias", D, (outputs, count))
    E = np.zeros((n, D.shape[1])) if E is None else E
    # Biases of given deviations: their plant is that of Gauss-Markov processes.
    if not isinstance(bias, LinearPlant):
        names = [f"bias{i}" for i in range(D.shape[1])]
        if by_output:
            names = [rename(name, f"{name}_bias") for name in sensor.outputs]
        bias = _make_gauss_markov(plant, names, bias, time, dt)
    return append_driving_plant(plant, bias, E), _add_bias_to_sensor(sensor, D, n)


def _make_gauss_markov(
    plant: AbstractPlant, names: list[str], deviation: ArrayLike, time: ArrayLike, dt: ArrayLike | str
) -> LinearPlant:
    """Return the plant of Gauss-Markov processes: b+ = a b + xi, a = exp(-dt / T), Var xi = (1 - a^2) deviation^2.

    Such a process models a sensor's bias that drifts slowly and stays bounded; the processes are independent.

    Args:
        plant: the plant that they drive or are measured with, for the names of its inputs.
        names: names of the processes.
        deviation: standard deviation of each process at all times, or one for all.
        time: T, after which a bias is forgotten, of each process or one for all.
        dt: length of a step, or the name of the input that says it.
    """
    count, what = len(names), "deviation of a bias"
    deviations = [scalar(what, x, 0.0) for x in _broadcast_to_biases(what, deviation, count)]
    # 1 / T of each.
    rates = [_invert_time_constant(x) for x in _broadcast_to_biases("time of a bias", time, count)]
    # Deviation and 1 / T of each bias, as arrays (biases,), JAX's where a number is traced.
    sd, rate = (library(values).stack([library(x).asarray(x) for x in values]) for values in (deviations, rates))
    xp = library(sd, rate)
    start, center = xp.diag(sd**2), np.zeros(count)  # covariance and mean of b_0
    # A step that is a number makes constants; else the matrices are functions of the input that says it.
    if not isinstance(dt, str):
        step = scalar("time of a step", dt, 0.0)
        noise = xp.diag(sd**2 * -xp.expm1(-2 * step * rate))
        return LinearPlant(xp.diag(xp.exp(-step * rate)), noise, center, start, states=names)
    if dt not in plant.inputs:
        raise fail("dt", f"a number, or one of the inputs {list(plant.inputs)}", repr(dt))

    def matrix_over(u: jax.Array) -> jax.Array:
        """Return diag(a) over a step of length u[0]."""
        return jnp.diag(jnp.exp(-u[0] * rate))

    def noise_over(u: jax.Array) -> jax.Array:
        """Return the covariance of xi over a step of length u[0]."""
        return jnp.diag(jnp.asarray(sd) ** 2 * -jnp.expm1(-2 * u[0] * rate))

    return LinearPlant(matrix_over, noise_over, center, start, states=names, inputs=[dt])


class DrivenTransition(Module):
    """Transition (f(x, u) + E b, F b + B u) of the plant of [x; b], x+ = f(x, u) + E b + w and b+ = F b + B u + xi.

    Args:
        plant: the plant of x.
        bias: that of b.
        coupling: E.
        indices: of the inputs of b among those of x.
    """

    plant: AbstractPlant
    bias: LinearPlant
    coupling: Array
    indices: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """Return the next state [f(x, u) + E b; f_b(b, u_b)] from [x; b], the state of the plant and the biases.

        E is `self.coupling`, through which the biases drive the plant. u_b are the inputs at `self.indices`, which move
        the biases.
        """
        n = len(self.plant.states)
        state, biases = x[:n], x[n:]
        next_state = self.plant.transition(state, u) + jnp.asarray(self.coupling) @ biases
        return jnp.concatenate([next_state, self.bias.transition(biases, u[np.array(self.indices, int)])])


def append_driving_plant(plant: AbstractPlant, bias: LinearPlant, coupling: np.ndarray) -> LinearPlant | Plant:
    """Return the plant of [x; b]: x+ = f(x, u) + E b + w and b+ = F b + B u + xi, linear if f is.

    b may be a slow disturbance that drives x, which a filter then estimates with x. x and b start independently of each
    other, and w and xi are independent.

    Args:
        plant: the plant of x.
        bias: the plant of b, whose inputs are some of those of x.
        coupling: E (n, biases), how b enters x.

    Raises:
        ValueError: a plant of b with another input, a coupling to attitudes.
    """
    models = plant, bias
    if set(bias.inputs) - set(plant.inputs):
        raise fail("bias", f"a plant whose inputs are some of {list(plant.inputs)}", list(bias.inputs))
    # Names of the states of b, changed where x has one of the same name.
    new_names = {name: rename(name, f"bias_{name}") if name in plant.states else name for name in bias.states}
    states = (*plant.states, *new_names.values())
    circular = (*plant.circular, *(new_names[name] for name in bias.circular))
    limits = (*plant.limits, *((new_names[name], ends) for name, ends in bias.limits))
    # An initial state is a center and a draw of a law, whose mean may be another than 0 (a mixture, say).
    laws = [model.deviation or Gaussian(model.initial_covariance) for model in models]
    centers = [model.initial_mean - law.mean for model, law in zip(models, laws, strict=True)]
    center, start = library(*centers).concatenate(centers), Independent(laws)
    # The noises are one law if both are laws. Else one of them is a covariance that depends on the inputs.
    indices = tuple(plant.inputs.index(name) for name in bias.inputs)
    constant_noises = [model.noise for model in models if isinstance(model.noise, AbstractNoise)]
    all_inputs = tuple(range(len(plant.inputs)))
    both_are_laws = len(constant_noises) == len(models)
    noise = Independent(constant_noises) if both_are_laws else JointNoise(models, (all_inputs, indices))
    if not isinstance(plant, LinearPlant):
        if np.any(np.asarray(coupling)[list(plant.manifold.rotations)]):
            raise fail("bias of a plant", "a coupling of 0 to attitudes, which have no sum", list(plant.attitude))
        move = DrivenTransition(plant, bias, coupling, indices)
        return Plant(move, noise, center, start, states, plant.inputs, circular, plant.attitude, limits)
    # Both are linear: the matrices of [x; b]. `inputs_of_bias` @ u is the inputs of b.
    inputs_of_bias = np.eye(len(plant.inputs))[list(indices)]
    matrix, input_matrix = _make_driven_matrices(plant, bias, coupling, inputs_of_bias)
    return LinearPlant(matrix, noise, center, start, input_matrix, states, plant.inputs, circular, limits)


def _make_driven_matrices(plant: LinearPlant, bias: LinearPlant, E: np.ndarray, inputs_of_bias: Any) -> tuple[Any, Any]:
    """Return the transition matrix [[A, E], [0, F]] and the input matrix [B; B_b] of the joint state (x, b).

    The plant x+ = A x + E b + B u is driven by biases b+ = F b + B_b u_b. If a matrix of the plant or of the biases is
    a function of the inputs u (`MatrixOfInputs`), as of the length of a step, both results are functions of u; else
    both are arrays.

    Args:
        plant: the plant of x, with A and B.
        bias: the plant of b, with F and B_b.
        E: the coupling (n, biases).
        inputs_of_bias: the matrix of zeros and ones with u_b = `inputs_of_bias` @ u.
    """
    zeros = np.zeros((len(bias.states), len(plant.states)))
    depends_on_inputs = any(isinstance(v, MatrixOfInputs) for model in (plant, bias) for v in vars(model).values())
    if not depends_on_inputs:
        xp = library(plant.matrix, E, bias.matrix, plant.input_matrix, bias.input_matrix)
        matrix = xp.block([[plant.matrix, E], [zeros, bias.matrix]])
        return matrix, xp.concatenate([plant.input_matrix, bias.input_matrix @ inputs_of_bias])

    def transition_matrix(u: jax.Array) -> jax.Array:
        """Return [[A, E], [0, F]] under the inputs u: of the plant, of the coupling E, and of the bias."""
        A, F = plant.transition_matrix(u), bias.transition_matrix(inputs_of_bias @ u)
        return jnp.block([[A, jnp.asarray(E)], [jnp.asarray(zeros), F]])

    def input_matrix(u: jax.Array) -> jax.Array:
        """Return [B; B_b] under the inputs u: the input matrices of the plant and of the bias.

        `inputs_of_bias` @ u are the inputs that move the bias.
        """
        B = matrix_under_inputs(plant.input_matrix, u)
        of_bias = matrix_under_inputs(bias.input_matrix, inputs_of_bias @ u)
        return jnp.concatenate([B, of_bias @ inputs_of_bias])

    return transition_matrix, input_matrix


class BiasedMeasurement(Module):
    """Measurement h(x) + D b of the state [x; b], of which the first `states` are x; h of `sensor`, D = `loading`."""

    sensor: AbstractSensor
    loading: Array
    states: int = eqx.field(static=True)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Return the expected outputs h(x) + D b, with D = `self.loading` and x, b the two parts of the argument."""
        return self.sensor.measure(x[: self.states]) + jnp.asarray(self.loading) @ x[self.states :]


def _add_bias_to_sensor(sensor: AbstractSensor, loading: np.ndarray, states: int) -> LinearSensor | Sensor:
    """Return the sensor y = h(x) + D b + v of the state [x; b] with biases b.

    `loading`: D. `states`: the length of x.
    """
    if not isinstance(sensor, LinearSensor):
        return Sensor(BiasedMeasurement(sensor, loading, states), sensor.noise, sensor.outputs, sensor.circular)
    xp = library(sensor.matrix, loading)  # NumPy, or JAX's for traced numbers
    C_and_D = xp.concatenate([sensor.matrix, loading], axis=1)  # [C, D] of the state [x; b]
    return LinearSensor(C_and_D, sensor.noise, sensor.outputs, sensor.circular)


def _broadcast_to_biases(name: str, value: ArrayLike, count: int) -> list[Any]:
    """Return a list of `count` values, one for each bias, from a single value or from `count` values."""
    number_or_sequence: Any = value
    values = list(number_or_sequence) if rank(name, value) else [number_or_sequence] * count
    if len(values) != count:
        raise fail(name, f"one, or one for each of {count}", len(values))
    return values


def _invert_time_constant(time: Any) -> Any:
    """Return the rate 1 / T at which a bias is forgotten, 0 for an infinite T: a constant bias.

    Raises:
        ValueError: a time that is not positive.
    """
    is_infinite = not is_traced(time) and isinstance(time, float | np.floating) and time == np.inf
    return 0.0 if is_infinite else 1 / scalar("time of a bias", time, TINY)
