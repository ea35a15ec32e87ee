"""The example's two worlds: a link that is late by chance, and two nodes of which one has a wrong clock."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph.numerics.check import check_count, check_seed

STEPS = 60
LAW = hg.Discrete([0, 1, 2], [0.4, 0.35, 0.25])
NOISE = 0.05 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
PLANT = hg.LinearPlant([[1.0, 1.0], [0.0, 0.95]], NOISE, [1.0, 0.5], np.diag([1.0, 0.2]))
SENSOR = hg.LinearSensor([[1.0, 0.0]], 0.3)
LINK = hg.hop(1.0, 0.05)
LINKS: Mapping[str, hg.random_affine.AbstractRandomAffine] = {
    "uninformed": hg.model.delayed(LINK, LAW),
    "informed": hg.model.delayed(LINK, LAW, timestamped=True),
    "constant": hg.model.delayed(LINK, 1),
    "none": LINK,
}

CLOCK_STEPS, STEP = 300, 0.5
CLOCK = hg.model.Clock(offset=0.5, drift=2e-3)
SPEED_NOISE = 0.02 * np.array([[STEP**3 / 3, STEP**2 / 2], [STEP**2 / 2, STEP]])
POSITION = hg.LinearSensor([[1.0, 0.0]], 0.04)


@dataclass(frozen=True)
class Setting:
    """How much is simulated: runs of links that are late, and of clocks."""

    late_runs: int = 4096
    clock_runs: int = 1024
    seed: int = 0

    def __post_init__(self) -> None:
        check_count("late_runs", self.late_runs, 2)
        check_count("clock_runs", self.clock_runs, 2)
        check_seed("seed", self.seed)


def moving(
    speed: float, noise: float = 1.0, spread: tuple[float, float] = (1.0, 0.01)
) -> tuple[hg.LinearPlant, dict[str, hg.model.AbstractSensor]]:
    """A plant that moves along a line, seen by a node with a true clock and by one without."""
    plant = hg.LinearPlant([[1.0, STEP], [0.0, 1.0]], noise * SPEED_NOISE, [0.0, speed], np.diag(spread))
    nodes = {"true": POSITION, "wrong": POSITION}
    larger, sensors = hg.model.with_clocks(plant, nodes, {"wrong": CLOCK}, [[0.0, 1.0], [0.0, 0.0]], STEP)
    assert isinstance(larger, hg.LinearPlant)
    return larger, dict(sensors)


def listeners(
    plant: hg.LinearPlant, sensors: Mapping[str, hg.model.AbstractSensor]
) -> dict[str, hg.filters.AbstractFilter]:
    """Filters that receive both nodes, and two that receive the wrong clock alone."""
    joint, both = hg.model.joint_sensor(sensors), hg.parallel([hg.perfect(), hg.perfect()])
    alone = hg.parallel([hg.model.silent(1, 1, 1.0), hg.perfect()])
    blind = hg.LinearSensor([[1.0, 0, 0, 0], [1.0, 0, 0, 0]], 0.04 * np.eye(2))
    exact = hg.filters.PolynomialMoments(2)
    return {
        "ignored": hg.linear_filter(plant, blind, both),
        "estimated": hg.filters.gaussian_filter(plant, joint, both, exact),
        "guarded": hg.filters.clock_filter(plant, joint, both, ["wrong"]),
        "estimated_alone": hg.filters.gaussian_filter(plant, joint, alone, exact),
        "guarded_alone": hg.filters.clock_filter(plant, joint, alone, ["wrong"]),
    }
