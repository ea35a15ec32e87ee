"""The model of a drive: a tag that moves in the plane, and ranges with outliers, memory and biases."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph.numerics.check import check_count
from heliograph_studies.settings import NO_FILE, File

HEIGHT = 1.0  # m, of the tag: the drives are flat
SCALES = (0.71, 1.0, 1.41)  # sizes of the errors with memory: which of them a drive has, its own ranges say


class Numbers(NamedTuple):
    """Numbers of the model, in m and s.

    q: white acceleration (m^2/s^3). sigma: white error of a range. excess: mean error of a range. late: of the stamps.
    first, second: constants of the rule. frame: displacement in each axis that ranges cannot show. Errors with memory,
    as standard deviation and time: common to all anchors; constant, of each; quick, of each.
    """

    q: float
    sigma: float
    excess: float
    late: float
    first: float = 1.0
    second: float = 1.0
    frame: float = 0.0
    common: float = 0.1
    common_time: float = 5.0
    constant: float = 0.04
    constant_time: float = 1000.0
    quick: float = 0.04
    quick_time: float = 1.5


# Round numbers: a walker changes speed by 0.3 m/s in a second; by their data sheet radios are precise to 2 to 4 cm and
# accurate to 10 cm; stamps are late by a slot or two. The form of the rule with memory, its numbers, and the sizes and
# times of its errors above were chosen with los_a1, los_b3, nlos_a1 and nlos_b4 in view: only other drives test them.
WALK, LATE, ACCURACY = 0.1, 0.15, 0.1
STARTS = {
    "plain": Numbers(WALK, 1.0, ACCURACY, LATE),
    "gate": Numbers(WALK, 0.2, ACCURACY, LATE, 9.0),
    "huber": Numbers(WALK, 0.2, ACCURACY, LATE, 1.345),
    "inverse_multiquadric": Numbers(WALK, 0.2, ACCURACY, LATE, 3.0),
    "student": Numbers(WALK, 0.2, ACCURACY, LATE, 1.0),
    "contaminated": Numbers(WALK, 0.2, ACCURACY, LATE, 0.05, 5.0),
    "memory": Numbers(WALK, 0.02, ACCURACY / 2, LATE, 0.02, 5.0, ACCURACY),
}
"""Starting numbers of each rule: a drive alone is read with them, and learning starts from them."""
BEST = "memory"  # the rule of this page: contaminated noise, and errors with memory as states
MOTION = ("q", "sigma", "excess", "late")
FREE = {
    "plain": MOTION,
    "gate": (*MOTION, "first"),
    "huber": (*MOTION, "first"),
    "inverse_multiquadric": (*MOTION, "first"),
    "student": (*MOTION, "first"),
    "contaminated": (*MOTION, "first", "second"),
    "memory": MOTION,
}
"""Numbers that other drives teach; not the errors with memory, whose size differs from drive to drive."""
SHARES = ("contaminated", "memory")  # rules whose first constant is a share


@dataclass(frozen=True)
class Setting:
    """recording: folder of the drives. iterations: of learning; 0 reads every drive with the starting numbers."""

    recording: File = NO_FILE
    iterations: int = 6

    def __post_init__(self) -> None:
        check_count("iterations", self.iterations, 0)
        object.__setattr__(self, "recording", File(self.recording))


class Errors(NamedTuple):
    """States of the errors with memory: deviation and time of each, and the ranges that it is in (anchors, states)."""

    deviation: Any
    time: Any
    ranges: np.ndarray


def errors_of(rule: str, numbers: Numbers, anchors: int) -> Errors:
    """Errors with memory of a rule: none, or one that is common and two of each anchor."""
    if rule != BEST:
        return Errors(jnp.zeros(0), jnp.ones(0), np.zeros((anchors, 0)))
    every = np.ones(anchors)

    def stacked(common: Any, constant: Any, quick: Any) -> Any:
        return jnp.concatenate([jnp.reshape(common, 1), constant * every, quick * every])

    return Errors(
        stacked(numbers.common, numbers.constant, numbers.quick),
        stacked(numbers.common_time, numbers.constant_time, numbers.quick_time),
        np.hstack([np.ones((anchors, 1)), np.eye(anchors), np.eye(anchors)]),
    )


def filter_of(rule: str, numbers: Numbers, anchors: Any, start: Any) -> hg.filters.AbstractFilter:
    """The extended filter of a rule, with these numbers, from a place; its input is the time since the step before."""
    count = len(anchors)
    errors = errors_of(rule, numbers, count)

    def move(x: jax.Array, u: jax.Array) -> jax.Array:
        return jnp.concatenate([x[:2] + u[0] * x[2:4], x[2:4], x[4:] * jnp.exp(-u[0] / errors.time)])

    def spread(u: jax.Array) -> jax.Array:
        dt = u[0]
        block = jnp.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        fresh = errors.deviation**2 * -jnp.expm1(-2 * dt / errors.time)  # so that the deviation stays
        covariance: jax.Array = jax.scipy.linalg.block_diag(numbers.q * jnp.kron(block, np.eye(2)), jnp.diag(fresh))
        return covariance

    states = ["x", "y", "vx", "vy", *(f"error{i}" for i in range(errors.ranges.shape[1]))]
    plant = hg.Plant(
        move,
        spread,
        jnp.concatenate([jnp.asarray(start), jnp.zeros(len(states) - 2)]),
        jax.scipy.linalg.block_diag(jnp.eye(4), jnp.diag(errors.deviation**2)),
        states=states,
        inputs=("dt",),
    )

    def ranges(x: jax.Array) -> jax.Array:
        across = jnp.sqrt((x[0] - anchors[:, 0]) ** 2 + (x[1] - anchors[:, 1]) ** 2 + (HEIGHT - anchors[:, 2]) ** 2)
        result: jax.Array = across + numbers.excess + errors.ranges @ x[4:]
        return result

    sensor = hg.Sensor(ranges, law_of(rule, numbers, count), outputs=[f"range{i}" for i in range(count)])
    if rule == "plain":
        return hg.extended_filter(plant, sensor, hg.perfect(count))
    return hg.robust_filter(plant, sensor, hg.perfect(count), weights_of(rule, numbers), hg.filters.Linearization())


def law_of(rule: str, numbers: Numbers, count: int) -> hg.random_affine.AbstractNoise:
    """The law of a range's white error."""
    variance = numbers.sigma**2 * jnp.eye(count)
    if rule == "student":
        return hg.StudentT(variance, numbers.first)
    if rule in SHARES:
        return hg.Contaminated(variance, numbers.first, variance + numbers.second**2 * jnp.eye(count))
    return hg.Gaussian(variance)


def weights_of(rule: str, numbers: Numbers) -> Any:
    """The rule of weights; None where the law's score is used."""
    rules = {
        "gate": hg.filters.Gate,
        "huber": hg.filters.Huber,
        "inverse_multiquadric": hg.filters.InverseMultiquadric,
    }
    return rules[rule](numbers.first) if rule in rules else None


def versions(rule: str, numbers: Sequence[Any]) -> list[Numbers]:
    """The settings that run side by side: of errors with memory, single anchors' in several sizes."""
    base = Numbers(*numbers)
    if rule != BEST:
        return [base]
    sized = ("constant", "quick", "frame")
    return [base._replace(**{name: s * getattr(base, name) for name in sized}) for s in SCALES]
