"""The model of a drive: a tag that moves in the plane, and ranges with outliers, memory and biases."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph.model.plant import AbstractPlant
from heliograph_studies import NO_FILE, File, check_fields

HEIGHT = 1.0  # m, of the tag: the drives are flat
SIZES = 1.3 ** np.arange(-2.0, 3.0)
"""Sizes of the errors with memory, equally likely before any range: which of them a drive has, its own ranges say."""


class Numbers(NamedTuple):
    """Numbers of the model, in m and s.

    q: white acceleration (m^2/s^3). sigma: white error of a range. excess: mean error of a range. late: of the stamps.
    first, second: constants of the rule. frame: displacement in each axis that ranges cannot show. Errors with
    memory, as standard deviation and time: common to all anchors; constant, of each; quick, of each.
    """

    q: float
    sigma: float
    excess: float
    late: float
    first: float = 1.0
    second: float = 1.0
    frame: float = 0.0
    common: float = 0.0
    common_time: float = 5.0
    constant: float = 0.0
    constant_time: float = 1000.0
    quick: float = 0.0
    quick_time: float = 1.5


# Round numbers: a walker changes speed by 0.3 m/s in a second; by their data sheet radios are precise to 2 to 4 cm and
# accurate to 10 cm; stamps are late by a slot or two. The form of the rule with memory, its numbers, and the sizes and
# times of its errors were chosen with los_a1, los_b3, nlos_a1 and nlos_b4 in view: only other drives test them.
WALK, LATE, ACCURACY = 0.1, 0.15, 0.1
WHITE = {
    "plain": Numbers(WALK, 1.0, ACCURACY, LATE),
    "gate": Numbers(WALK, 0.2, ACCURACY, LATE, 9.0),
    "huber": Numbers(WALK, 0.2, ACCURACY, LATE, 1.345),
    "wolf": Numbers(WALK, 0.2, ACCURACY, LATE, 1.265),
    "inverse_multiquadric": Numbers(WALK, 0.2, ACCURACY, LATE, 3.0),
    "student": Numbers(WALK, 0.2, ACCURACY, LATE, 1.0),
    "contaminated": Numbers(WALK, 0.2, ACCURACY, LATE, 0.05, 5.0),
    "one_sided": Numbers(WALK, 0.2, ACCURACY, LATE, 0.05, 5.0),
}
"""Rules that take the error of a range for white."""
BIASED = [rule for rule in WHITE if rule not in ("plain", "one_sided")]
BIAS = "_bias"  # of a rule's name: with a bias of each anchor that hardly changes
BEST = "memory"  # the rule of this page: contaminated noise, and errors with memory as states
STARTS = {
    **WHITE,
    **{rule + BIAS: WHITE[rule]._replace(constant=ACCURACY, constant_time=8000.0) for rule in BIASED},
    BEST: Numbers(WALK, 0.02, ACCURACY / 2, LATE, 0.02, 5.0, frame=ACCURACY, common=0.07, constant=0.04, quick=0.04),
}
"""Starting numbers of each rule: a drive alone is read with them, and learning starts from them."""
MOTION = ("q", "sigma", "excess", "late")
CONSTANTS = {"plain": (), "contaminated": ("first", "second"), "one_sided": ("first", "second")}
FREE = {
    **{rule: (*MOTION, *CONSTANTS.get(rule, ("first",))) for rule in WHITE},
    **{rule + BIAS: (*MOTION, *CONSTANTS.get(rule, ("first",)), "constant") for rule in BIASED},
    BEST: MOTION,
}
"""Numbers that other drives teach; not the errors with memory, whose size differs from drive to drive."""
SHARES = ("contaminated", "one_sided", "contaminated_bias", BEST)  # rules whose first constant is a share


@dataclass(frozen=True)
class Setting:
    """recording: folder of the drives. iterations: of learning; 0 reads every drive with the starting numbers."""

    recording: File = NO_FILE
    iterations: int = 6

    def __post_init__(self) -> None:
        check_fields(self, iterations=0)
        object.__setattr__(self, "recording", File(self.recording))


class Errors(NamedTuple):
    """States of the errors with memory: deviation and time of each, and the ranges that it is in (anchors, states)."""

    deviation: Any
    time: Any
    ranges: np.ndarray


def errors_of(rule: str, numbers: Numbers, anchors: int) -> Errors | None:
    """Errors with memory of a rule: none, a bias of each anchor, or one that is common and two of each anchor."""
    every, single = np.ones(anchors), np.eye(anchors)
    if rule.endswith(BIAS):
        return Errors(numbers.constant * every, numbers.constant_time * every, single)
    if rule != BEST:
        return None

    def stacked(common: Any, constant: Any, quick: Any) -> Any:
        return jnp.concatenate([jnp.reshape(common, 1), constant * every, quick * every])

    return Errors(
        stacked(numbers.common, numbers.constant, numbers.quick),
        stacked(numbers.common_time, numbers.constant_time, numbers.quick_time),
        np.hstack([every[:, None], single, single]),
    )


def filter_of(rule: str, numbers: Numbers, anchors: Any, start: Any) -> hg.filters.AbstractFilter:
    """The extended filter of a rule, with these numbers, from a place; its input is the time since the step before."""
    count = len(anchors)

    # A walk of the speed in the plane.
    def move(x: jax.Array, u: jax.Array) -> jax.Array:
        return jnp.concatenate([x[:2] + u[0] * x[2:], x[2:]])

    def spread(u: jax.Array) -> jax.Array:
        dt = u[0]
        block = jnp.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        motion: jax.Array = numbers.q * jnp.kron(block, np.eye(2))
        return motion

    plant: AbstractPlant = hg.Plant(
        move,
        spread,
        jnp.concatenate([jnp.asarray(start), jnp.zeros(2)]),
        np.eye(4),
        states=["x", "y", "vx", "vy"],
        inputs=("dt",),
    )

    # Ranges to the anchors, and errors with memory as states.
    def ranges(x: jax.Array) -> jax.Array:
        across = jnp.sqrt((x[0] - anchors[:, 0]) ** 2 + (x[1] - anchors[:, 1]) ** 2 + (HEIGHT - anchors[:, 2]) ** 2)
        result: jax.Array = across + numbers.excess
        return result

    sensor: Any = hg.Sensor(ranges, law_of(rule, numbers, count), outputs=[f"range{i}" for i in range(count)])
    if errors := errors_of(rule, numbers, count):
        plant, sensor = hg.model.with_bias(plant, sensor, errors.deviation, errors.time, "dt", loading=errors.ranges)
    if rule == "plain":
        return hg.extended_filter(plant, sensor, hg.perfect(count))
    return hg.robust_filter(plant, sensor, hg.perfect(count), weights_of(rule, numbers), hg.filters.Linearization())


def law_of(rule: str, numbers: Numbers, count: int) -> hg.random_affine.AbstractNoise:
    """The law of a range's white error; the outliers of one side are too short."""
    variance = numbers.sigma**2 * jnp.eye(count)
    if rule.startswith("student"):
        return hg.StudentT(variance, numbers.first)
    if rule == "one_sided":
        single = hg.Contaminated.one_sided(numbers.sigma**2, numbers.first, -numbers.second)
        return hg.random_affine.Independent([single] * count)
    if rule in SHARES:
        return hg.Contaminated(variance, numbers.first, variance + numbers.second**2 * jnp.eye(count))
    return hg.Gaussian(variance)


def weights_of(rule: str, numbers: Numbers) -> Any:
    """The rule of weights; None where the law's score is used."""
    rules = {
        "gate": hg.filters.Gate,
        "huber": hg.filters.Huber,
        "wolf": hg.filters.WoLF,
        "inverse_multiquadric": hg.filters.InverseMultiquadric,
    }
    name = rule.removesuffix(BIAS)
    return rules[name](numbers.first) if name in rules else None


def versions(rule: str, base: Numbers) -> list[Numbers]:
    """The settings that run side by side: of errors with memory, single anchors' in several sizes."""
    if rule != BEST:
        return [base]
    sized = ("constant", "quick", "frame")
    return [base._replace(**{name: s * getattr(base, name) for name in sized}) for s in SIZES]
