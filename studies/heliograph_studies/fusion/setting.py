"""The example's networks: a moving point, three rooms, and nodes drawn at random; how much of each is worked out."""

from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph.numerics.check import check_count, check_seed, fail
from heliograph_studies.cubature_fusion import setting as machine

Part = tuple[np.ndarray, float, float, float, float]  # C, variance of v, mean and variance of the gain, variance of n


@dataclass(frozen=True)
class Setting:
    """How much is worked out, and how much is simulated.

    crossed_nodes: nodes of which all cross-covariances are computed over many_steps, as in a tree of tree_nodes and
    degree;
    intervals, thresholds: reports every d-th step and on event, over traffic_steps of which the second half is judged.
    """

    runs: int = 2000
    steps: int = 200
    measured_steps: int = 30
    crossed_nodes: int = 1000
    many_steps: int = 100
    tree_nodes: int = 10_000
    degree: int = 10
    machine_runs: int = 256
    machine_nodes: int = len(machine.NODES)
    intervals: tuple[int, ...] = (1, 2, 3, 4, 6)
    thresholds: tuple[float, ...] = (0.05, 0.15, 0.4)
    traffic_steps: int = 36  # a multiple of all intervals
    seed: int = 0

    def __post_init__(self) -> None:
        check_count("runs", self.runs, 8)
        for name in ("steps", "measured_steps", "crossed_nodes", "many_steps", "machine_runs", "traffic_steps"):
            check_count(name, getattr(self, name), 1)
        check_count("degree", self.degree, 2)
        check_count("tree_nodes", self.tree_nodes, self.crossed_nodes)
        check_seed("seed", self.seed)
        if not 2 <= self.machine_nodes <= len(machine.NODES):
            raise fail("machine_nodes", f"a number from 2 to {len(machine.NODES)}", self.machine_nodes)
        for d in self.intervals:
            check_count("intervals", d, 1)
            if self.traffic_steps % d:
                raise fail("traffic_steps", f"a multiple of {d}", self.traffic_steps)


def moving_point() -> hg.LinearPlant:
    """Place and damped velocity in two directions."""
    matrix = 0.98 * np.kron(np.eye(2), [[1, 1], [0, 0.97]])
    noise = np.kron(np.eye(2), 0.02 * np.array([[1 / 3, 1 / 2], [1 / 2, 1]]))
    return hg.LinearPlant(matrix, noise, np.zeros(4), np.eye(4), states=["x", "vx", "y", "vy"])


def described(name: str) -> tuple[hg.LinearPlant, list[Part]]:
    """Plant and nodes of a case."""
    unit = np.eye(4)
    if name == "three_rooms":
        matrix = np.diag([0.9, 0.8, 0.95]) + 0.1 * np.diag([1, 1], 1)
        rooms = hg.LinearPlant(matrix, 0.1 * np.eye(3), np.zeros(3), np.eye(3))
        return rooms, [(np.eye(3)[[i]], 0.1, 0.8, 0.06, 0.05) for i in range(3)]
    if name == "three_partial":
        outputs = unit[[0]], unit[[2]], (unit[[0]] + unit[[2]]) / np.sqrt(2)
        numbers = (0.8, 0.05), (0.9, 0.1), (0.7, 0.08)
        return moving_point(), [(c, 0.2, *gain, 0.1) for c, gain in zip(outputs, numbers, strict=True)]
    return moving_point(), [(unit[[0, 2]], 0.3, 0.8, 0.1, 0.2)] * 4


def received_by(part: Part) -> tuple[hg.LinearSensor, hg.random_affine.AbstractRandomAffine]:
    """Sensor and channel of a node; only mean and variance of the gain matter."""
    matrix, noise, mean, variance, hop_noise = part
    gain = hg.Discrete([mean - np.sqrt(variance), mean + np.sqrt(variance)], [0.5, 0.5])
    return hg.LinearSensor(matrix, noise * np.eye(len(matrix))), hg.hop(gain, hop_noise * np.eye(len(matrix)))


def node_parts(count: int, seed: int) -> list[Part]:
    """Nodes with random outputs."""
    draw = np.random.default_rng(seed)
    return [(draw.normal(size=(2, 4)), 0.3, 0.75, 1 / 16, 0.2 + 0.2 * draw.random()) for _ in range(count)]
