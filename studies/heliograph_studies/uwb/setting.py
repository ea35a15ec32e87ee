"""The model of a drive: a tag that moves in the plane, ranges with outliers, and a slow bias of each anchor."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph.numerics.check import check_count

HEIGHT = 1.0  # m, of the tag: the drives are flat


class Numbers(NamedTuple):
    """What is learned: white acceleration q (m^2/s^3), deviation of a range (m), mean excess of a range (m), how late
    stamps are (s), the rule's constants, and the deviation (m) and time (s) of each anchor's bias."""

    q: float
    sigma: float
    excess: float
    late: float
    first: float = 1.0
    second: float = 1.0
    bias: float = 0.1
    time: float = 8000.0


STARTS = {
    "plain": Numbers(1.0, 6.0, 0.2, 0.175),
    "gate": Numbers(0.4, 0.2, 0.1, 0.175, 8.0),
    "huber": Numbers(0.5, 0.2, 0.1, 0.175, 0.3),
    "student": Numbers(0.4, 0.3, 0.1, 0.175, 0.3),
    "contaminated": Numbers(0.4, 0.16, 0.1, 0.175, 0.9, 4.0),
    "bias": Numbers(0.2, 0.12, 0.1, 0.175, 0.96, 5.0, 0.06, 8000.0),
}
"""Where learning starts, in round numbers, and what a drive alone is read with."""
# Leading numbers that are learned.
FREE = {
    "plain": 4,
    "gate": 5,
    "huber": 5,
    "student": 5,
    "contaminated": 6,
    "bias": 8,
}

SHARES = ("contaminated", "bias")  # rules whose first constant is a share


@dataclass(frozen=True)
class Setting:
    """recording: the folder of the drives. iterations: of learning."""

    recording: str = ""
    iterations: int = 10

    def __post_init__(self) -> None:
        check_count("iterations", self.iterations, 0)


def move(x: jax.Array, u: jax.Array, time: jax.Array) -> jax.Array:
    """Constant velocity over u = (dt,); biases fade with their time."""
    moved = jnp.concatenate([x[:2] + u[0] * x[2:4], x[2:4]])
    return jnp.concatenate([moved, x[4:] * jnp.exp(-u[0] / time)])


def spread(u: jax.Array, numbers: Numbers, biases: int) -> jax.Array:
    """Covariance of what is added: white acceleration, and what keeps the biases' deviation."""
    dt = u[0]
    block = jnp.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    place = numbers.q * jnp.kron(block, np.eye(2))
    fresh = numbers.bias**2 * -jnp.expm1(-2 * dt / numbers.time)
    return jax.scipy.linalg.block_diag(place, fresh * np.eye(biases)) if biases else place


def filter_of(rule: str, numbers: Numbers, anchors: np.ndarray, start: np.ndarray) -> hg.filters.AbstractFilter:
    """The extended filter of a rule, with these numbers, from a place."""
    count = len(anchors) if rule == "bias" else 0
    plant = hg.Plant(
        lambda x, u: move(x, u, jnp.asarray(numbers.time)),
        lambda u: spread(u, numbers, count),
        jnp.concatenate([jnp.asarray(start), jnp.zeros(2 + count)]),
        np.eye(4) if not count else jax.scipy.linalg.block_diag(jnp.eye(4), numbers.bias**2 * jnp.eye(count)),
        states=("x", "y", "vx", "vy", *(f"bias{i}" for i in range(count))),
        inputs=("dt",),
    )
    variance = numbers.sigma**2 * jnp.eye(len(anchors))
    laws = {
        "student": lambda: hg.StudentT(variance, numbers.first),
        "contaminated": lambda: _contaminated(variance, numbers),
        "bias": lambda: _contaminated(variance, numbers),
    }
    law = laws[rule]() if rule in laws else hg.Gaussian(variance)

    def ranges(x: jax.Array) -> jax.Array:
        across = jnp.sqrt((x[0] - anchors[:, 0]) ** 2 + (x[1] - anchors[:, 1]) ** 2 + (HEIGHT - anchors[:, 2]) ** 2)
        return across + numbers.excess + (x[4:] if count else 0.0)

    sensor = hg.Sensor(ranges, law, outputs=[f"range{i}" for i in range(len(anchors))])
    direct = hg.perfect(len(anchors))
    if rule == "plain":
        return hg.extended_filter(plant, sensor, direct)
    choice = {"gate": hg.filters.Gate(numbers.first), "huber": hg.filters.Huber(numbers.first)}.get(rule)
    return hg.robust_filter(plant, sensor, direct, choice, hg.filters.Linearization())


def _contaminated(variance: jax.Array, numbers: Numbers) -> hg.Contaminated:
    return hg.Contaminated(variance, numbers.first, variance + numbers.second**2 * jnp.eye(len(variance)))
