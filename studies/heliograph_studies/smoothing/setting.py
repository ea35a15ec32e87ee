"""Two plants: a moving point behind two fading hops, and a swinging pendulum."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph.numerics.check import check_count, check_seed

STEPS = 100
STEADY = 1000  # steps after which the relays' receiver does not change any more
PENDULUM_STEP = 0.05  # s
SWINGS = {"tame": ((0.4, 0.0), 0.05), "large": ((2.8, 0.0), 0.3)}  # mean angle and speed at the start, variance of both


@dataclass(frozen=True)
class Setting:
    """How much is simulated."""

    runs: int = 1000
    seed: int = 0

    def __post_init__(self) -> None:
        check_count("runs", self.runs, 2)
        check_seed("seed", self.seed)


def moving_point() -> tuple[hg.LinearPlant, hg.LinearSensor, hg.random_affine.AbstractRandomAffine]:
    """Places and speeds in two directions, both places sent with one gain over two Rayleigh hops."""
    direction = np.array([[1.0, 1.0], [0.0, 1.0]])
    noise = 1e-3 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    plant = hg.LinearPlant(
        np.kron(np.eye(2), direction),
        np.kron(np.eye(2), noise),
        [0.0, 0.1, 0.0, -0.05],
        np.diag([1.0, 0.01, 1.0, 0.01]),
        states=["x", "vx", "y", "vy"],
    )
    sensor = hg.LinearSensor(np.eye(4)[[0, 2]], 0.25)
    hops = [
        hg.hop(hg.Rayleigh(0.8), 0.02, dimension=2),
        hg.hop(hg.Rayleigh(0.8), 0.01, amplification=1.2, dimension=2),
    ]
    return plant, sensor, hg.amplify_and_forward(hops)


def swing(x: jax.Array, u: jax.Array) -> jax.Array:
    """Angle and its speed over one step."""
    return jnp.stack([x[0] + PENDULUM_STEP * x[1], x[1] - PENDULUM_STEP * 9.81 * jnp.sin(x[0])])


def sine(x: jax.Array) -> jax.Array:
    """How far the pendulum is aside."""
    return jnp.sin(x[:1])


def pendulum(name: str) -> hg.Network:
    """A pendulum that starts tame or with a large swing, seen from below through a link of three gains."""
    (angle, speed), variance = SWINGS[name]
    h = PENDULUM_STEP
    noise = 0.01 * np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]])
    plant = hg.Plant(swing, noise, [angle, speed], variance * np.eye(2), states=["angle", "speed"])
    sensor = hg.Sensor(sine, noise=0.02, outputs=["aside"])
    link = hg.hop(hg.Discrete([0.7, 1.0, 1.2], [0.2, 0.6, 0.2]), 0.01)
    return hg.Network(plant, {"node": hg.Node(sensor, link, {"extended": hg.extended_filter(plant, sensor, link)})})
