"""Second moments of the true state of a linear plant and of what its sensors send: what powers are made of.

Pi = E (x, 1)(x, 1)' of the state itself, mean included, not of an estimate's error: Pi+ = A Pi A' + Q.
"""

import jax
import numpy as np

from heliograph.model.over_time import OverTime, at, first
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.check import fail
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.lyapunov import steady_moment
from heliograph.random_affine.noise import AbstractNoise

Seconds = Float[np.ndarray, "time n1 n1"]


def growth(plant: LinearPlant) -> float:
    """Spectral radius of a plant: above 1 what is sent grows without limit."""
    return _radius(np.asarray(plant.matrix))


def check_stable(transition: Float[np.ndarray, "n n"]) -> None:
    """Raise ValueError where a plant's second moments grow without limit."""
    if (radius := _radius(transition)) >= 1:
        expected = "a stable plant, or a horizon, or feedback: what is sent of an unstable plant grows without limit"
        raise fail("steady power", expected, f"spectral radius {radius:.6g}")


def _radius(transition: Float[np.ndarray, "n n"]) -> float:
    return float(np.max(np.abs(np.linalg.eigvals(transition)), initial=0.0))


def check_constant_noise(plant: AnyPlant) -> tuple[LinearPlant, AbstractNoise]:
    """The plant and its noise at the first step; ValueError unless it is linear and its noise depends on no inputs."""
    start = first(plant)
    if not isinstance(start, LinearPlant):
        raise fail("plant", "a LinearPlant", type(start).__name__)
    if not isinstance(start.noise, AbstractNoise):
        raise fail("noise of the plant", "a covariance or a noise law", "a function of the inputs")
    return start, start.noise


def steady_second(plant: AnyPlant) -> Float[np.ndarray, "n1 n1"]:
    """E (x, 1)(x, 1)' in the steady state of a plant without inputs.

    Raises:
        ValueError: a plant that varies or is not stable: what its sensors send grows without limit.
    """
    start, noise = check_constant_noise(plant)
    if isinstance(plant, OverTime):
        raise fail("steady power", "a plant that does not vary (give a horizon)", "one that is an OverTime")
    a = np.asarray(start.matrix)
    check_stable(a)
    mean = np.linalg.solve(np.eye(len(a)) - a, np.asarray(noise.mean))
    return _joined(mean, steady_moment(a, np.asarray(noise.covariance)))


def seconds_over(plant: AnyPlant, horizon: int, inputs: ArrayLike | None = None) -> Seconds:
    """E (x, 1)(x, 1)' at each step from the plant's initial law, the first after x_0 has moved once.

    Raises:
        ValueError: a plant that is not linear.
    """
    start = first(plant)
    if not isinstance(start, LinearPlant):
        raise fail("plant", "a LinearPlant", type(start).__name__)
    mean, spread = np.asarray(start.initial_mean), np.asarray(start.initial_covariance)
    u = np.zeros((horizon, len(start.inputs))) if inputs is None else np.asarray(inputs)
    found = []
    for k in range(horizon):
        now = at(plant, k)
        a = np.asarray(now.matrix)
        with jax.enable_x64(True):  # the noise may be a function of the inputs in operations of JAX
            noise_mean, noise = np.asarray(now.noise_mean()), np.asarray(now.noise_covariance(u[k]))
        mean = a @ mean + np.asarray(now.input_matrix) @ u[k] + noise_mean
        spread = a @ spread @ a.T + noise
        found.append(_joined(mean, spread))
    return np.array(found)


def of_sensor(sensor: AnySensor, second: Float[np.ndarray, "n1 n1"], step: int = 0) -> Float[np.ndarray, "m1 m1"]:
    """E (y, 1)(y, 1)' of a linear sensor from that of the state."""
    now = at(sensor, step)
    c, offset = np.asarray(now.matrix), np.asarray(now.noise.mean)
    rows = np.block([[c, offset[:, None]], [np.zeros((1, c.shape[1])), np.ones((1, 1))]])
    result: np.ndarray = rows @ second @ rows.T + np.pad(np.asarray(now.noise.covariance), ((0, 1), (0, 1)))
    return result


def _joined(mean: Float[np.ndarray, "n"], spread: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n1 n1"]:
    whole = np.append(mean, 1.0)
    result: np.ndarray = np.outer(whole, whole) + np.pad(spread, ((0, 1), (0, 1)))
    return result
