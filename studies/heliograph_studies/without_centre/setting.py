"""The example's network: nodes in a square, half of them without a sensor, whose messages get lost."""

from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph.fusion import DiffusionWeights, MatrixWeights, TraceIntersection
from heliograph.numerics.check import check_count, check_seed, scalar

FILTER = "alone"  # of a node that receives nobody
MOTION = 0.98 * np.kron(np.eye(2), [[1.0, 1.0], [0.0, 0.97]])  # position and speed along two axes
NOISE = np.kron(np.eye(2), 0.02 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]))
PLANT = hg.LinearPlant(MOTION, NOISE, np.zeros(4), np.eye(4), states=["x", "vx", "y", "vy"])
RULES: dict[str, hg.fusion.AbstractFusion] = {
    "best": MatrixWeights(),
    "intersection": TraceIntersection(),
    "diffusion": DiffusionWeights(),
}


@dataclass(frozen=True)
class Setting:
    """A graph of nodes within `radius` of each other in the unit square, and how much of it is simulated."""

    nodes: int = 40
    radius: float = 0.26
    loss: float = 0.2
    steps: int = 60
    runs: int = 192
    seed: int = 1

    def __post_init__(self) -> None:
        check_count("nodes", self.nodes, 4)
        check_count("steps", self.steps, 4)
        check_count("runs", self.runs, 2)
        check_seed("seed", self.seed)
        scalar("radius", self.radius, 0.01)
        scalar("loss", self.loss, 0.0, 0.9)


def positions(setting: Setting) -> dict[str, np.ndarray]:
    """Places of the nodes in the unit square, drawn until every node can be reached from every other."""
    generator = np.random.default_rng(setting.seed)
    while True:
        places = {f"n{i}": generator.random(2) for i in range(setting.nodes)}
        near = hg.fusion.neighbours_within(places, setting.radius)
        seen, ahead = {"n0"}, ["n0"]
        while ahead:
            new = set(near[ahead.pop()]) - seen
            seen |= new
            ahead += new
        if len(seen) == setting.nodes:
            return places


def network(setting: Setting) -> hg.Network:
    """Every other node measures x or y, the rest nothing; a fusion between neighbours by each rule."""
    generator = np.random.default_rng(setting.seed + 1)
    places = positions(setting)
    nodes: dict[str, hg.Node | None] = {}
    for i, name in enumerate(places):
        sensor = hg.LinearSensor([[1.0, 0, 0, 0] if i % 4 else [0, 0, 1.0, 0]], 0.2 * (1 + 2 * generator.random()))
        nodes[name] = hg.Node(sensor, hg.perfect(), {FILTER: hg.kalman_filter(PLANT, sensor)}) if i % 2 == 0 else None
    near, link = hg.fusion.neighbours_within(places, setting.radius), hg.erasure(hg.perfect(), 1 - setting.loss)
    return hg.Network(PLANT, nodes, {k: hg.Fusion(FILTER, r, neighbours=near, link=link) for k, r in RULES.items()})
