"""Second moments of a linear plant's true state and of what its sensors measure: what powers are made of.

Pi = E (x, 1)(x, 1)' is that of the state, mean included, not of an estimate's error: Pi+ = A Pi A' + Q.
"""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.linear.jump_system import JumpSystem
from heliograph.model.over_time import OverTime, at, first
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.model.sensor import AnySensor, refuse_angles
from heliograph.numerics.check import fail
from heliograph.numerics.lapack import spectral_radius
from heliograph.numerics.numpy_or_jax import is_traced, library
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.random_affine.noises.noise import AbstractNoise

DOUBLINGS = 60
EPS = float(np.finfo(np.float64).eps)


def check_stable(transition: Float[np.ndarray, "n n"]) -> None:
    """Raise ValueError where the second moments of a plant with this transition grow without limit."""
    radius = spectral_radius(transition)
    if radius >= 1:
        expected = "a stable plant, or a horizon, as what is sent of an unstable one grows without limit"
        raise fail("steady power", expected, f"spectral radius {radius:.6g}")


def steady_covariance(transition: Float[Array, "n n"], process: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the solution of X = A X A' + Q, the covariance of a stable plant in the long run.

    Args:
        transition: A, shape (n, n).
        process: Q, shape (n, n).

    Returns:
        X, shape (n, n), accurate entry by entry whatever the units of the states; traced if A or Q is.

    Raises:
        ValueError: a plant that is not stable (where A is traced nobody can see it).
    """
    a = transition
    # Traced by JAX: as the steady moments of a jump system of one step and one mode, whose axes lead.
    if is_traced(a, process):
        one_mode = JumpSystem(np.ones((1, 1, 1)), jnp.asarray(a)[None, None], jnp.asarray(process)[None, None])
        return jnp.asarray(one_mode.steady()[0, 0])
    check_stable(np.asarray(a))
    # sum_k A^k Q A'^k, with twice as many terms after each doubling.
    total, power = np.asarray(process), np.asarray(a)
    for _ in range(DOUBLINGS):
        more = power @ total @ power.T
        total, power = total + more, power @ power
        if np.all(np.abs(more) <= EPS * np.abs(total)):
            break
    return np.asarray((total + total.T) / 2)


def require_constant_noise(plant: AnyPlant) -> tuple[LinearPlant, AbstractNoise]:
    """Return the plant and noise of the first step; raise ValueError unless it is linear with noise of no inputs."""
    start = first(plant)
    if not isinstance(start, LinearPlant):
        raise fail("plant", "a LinearPlant", type(start).__name__)
    if not isinstance(start.noise, AbstractNoise):
        raise fail("noise of the plant", "a covariance or a noise law", "a function of the inputs")
    return start, start.noise


def require_design_plant(plant: AnyPlant) -> LinearPlant:
    """Return the plant of the first step; raise ValueError unless its powers can be designed.

    The plant must be linear with constant noise, without inputs and angles.
    """
    start, _ = require_constant_noise(plant)
    if start.inputs:
        raise fail("plant of a design", "no inputs", list(start.inputs))
    refuse_angles("design", start)
    return start


def steady_moment_with_one(plant: AnyPlant) -> Float[Array, "n1 n1"]:
    """Return E (x, 1)(x, 1)' (n + 1, n + 1) of the state x in the steady state of a plant without inputs.

    It holds second moments, means and 1: [[E x x', E x], [E x', 1]]. Powers of what is sent are made of it.

    Raises:
        ValueError: a plant that varies or is not stable.
    """
    start, noise = require_constant_noise(plant)
    if isinstance(plant, OverTime):
        raise fail("steady power", "a plant that does not vary (give a horizon)", "one that is an OverTime")
    spread = steady_covariance(start.matrix, noise.covariance)
    xp = library(start.matrix, noise.mean)
    mean = xp.linalg.solve(np.eye(len(start.states)) - start.matrix, noise.mean)
    return _make_second_moment(mean, spread)


def moments_with_one_over(
    plant: AnyPlant, horizon: int, inputs: ArrayLike | None = None
) -> list[Float[Array, "n1 n1"]]:
    """Return E (x, 1)(x, 1)' at each step from the plant's initial law on, the first after x_0 has moved once.

    Planners need it for the power of signals, and for the noise behind random gains, which grows with the signal.

    Args:
        plant: a linear plant, which may vary in time.
        horizon: number of steps.
        inputs: inputs at each step (horizon, inputs); zero unless given.

    Raises:
        ValueError: a plant that is not linear.
    """
    start = first(plant)
    if not isinstance(start, LinearPlant):
        raise fail("plant", "a LinearPlant", type(start).__name__)
    u = np.zeros((horizon, len(start.inputs))) if inputs is None else np.asarray(inputs)
    # (x, 1)+ = [A, b; 0, 1] (x, 1) + (w, 0): one mode at every step.
    maps, added = [], []
    for k in range(horizon):
        now = at(plant, k)
        noise_mean, noise = _compute_noise_moments(now, u[k])
        maps.append(_append_shift(now.matrix, now.input_matrix @ u[k] + noise_mean))
        added.append(library(noise).pad(noise, ((0, 1), (0, 1))))
    # A jump system with a single mode, which moves second moments by X+ = F X F' + S; its axis of modes is dropped.
    xp = library(maps, added)
    system = JumpSystem(np.ones((horizon, 1, 1)), xp.stack(maps)[:, None], xp.stack(added)[:, None])
    return [one for (one,) in system.after(_make_second_moment(start.initial_mean, start.initial_covariance)[None])]


def _compute_noise_moments(plant: LinearPlant, u: Float[np.ndarray, "inputs"]) -> tuple[Array, Array]:
    """Return the mean and covariance of the plant's noise w at inputs u; JAX may trace a noise of inputs."""
    if isinstance(plant.noise, AbstractNoise):
        return plant.noise.mean, plant.noise.covariance
    with jax.enable_x64(True):
        return np.asarray(plant.noise_mean()), np.asarray(plant.noise_covariance(jnp.asarray(u)))


def measured_moment_with_one(sensor: AnySensor, second: Float[Array, "n1 n1"], step: int = 0) -> Float[Array, "m1 m1"]:
    """Return E (y, 1)(y, 1)' (m + 1, m + 1) of what a linear sensor measures, y = C x + v.

    Args:
        sensor: the sensor, or one over time.
        second: E (x, 1)(x, 1)' of the state x.
        step: the step, for a sensor that varies over time.
    """
    sensor_now = at(sensor, step)
    matrix, noise = sensor_now.matrix, sensor_now.noise
    extended_matrix = _append_shift(matrix, noise.mean)  # from (x, 1) to (y, 1) without noise
    extended_covariance = library(noise.covariance).pad(noise.covariance, ((0, 1), (0, 1)))  # of (noise, 0)
    measured: Array = extended_matrix @ second @ extended_matrix.T + extended_covariance
    return measured


def _append_shift(matrix: Float[Array, "m n"], shift: Float[Array, "m"]) -> Float[Array, "m1 n1"]:
    """Return the matrix (m + 1, n + 1) of the map from (x, 1) to (M x + shift, 1).

    It is [[M, shift], [0, 1]].

    Args:
        matrix: M (m, n).
        shift: (m,).
    """
    n = matrix.shape[1]
    row_of_one = np.eye(1, n + 1, n)  # (0, ..., 0, 1), which keeps the 1
    xp = library(matrix, shift)
    upper_rows = xp.concatenate([matrix, shift[:, None]], axis=1)
    extended: Array = xp.concatenate([upper_rows, row_of_one])
    return extended


def _make_second_moment(mean: Float[Array, "n"], covariance: Float[Array, "n n"]) -> Float[Array, "n1 n1"]:
    """Return E (x, 1)(x, 1)' = (m, 1)(m, 1)' + [[P, 0], [0, 0]] from the mean m (n,) and covariance P (n, n) of x."""
    xp = library(mean, covariance)
    extended = xp.append(mean, 1.0)
    second: Array = xp.outer(extended, extended) + xp.pad(covariance, ((0, 1), (0, 1)))
    return second
