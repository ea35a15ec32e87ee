"""Time of network design: an error with its gradient, a convex design, and a design of many starts.

Three states; twenty sensors over one hop or two (descents from thirty starts). Run: python
benchmarks/network_design.py. Prints milliseconds; the limits are 1 (error and gradient), 2000 (convex) and 10 000
(starts).
"""

from typing import Any

import numpy as np
from alone import milliseconds, show

import heliograph as hg
from heliograph.planning import Error
from heliograph.planning.multihop_paths.path_problem import make_power_task
from heliograph.planning.power_budget import make_unlimited

SENSORS, STARTS, REPEATS = 20, 30, 20
ERROR_LIMIT, CONVEX_LIMIT, STARTS_LIMIT = 1.0, 2000.0, 10_000.0
TRANSITION, PROCESS = np.array([[0.95, 0.1, 0], [0, 0.9, 0.2], [0, -0.1, 0.8]]), np.diag([0.1, 0.05, 0.2])
DRAW = np.random.default_rng(0)
ROWS, NOISES = DRAW.normal(size=(SENSORS, 3)), DRAW.uniform(0.3, 0.8, SENSORS)
ALPHA = DRAW.uniform(0.5, 2.0, (SENSORS, 2)) ** 3


def relayed() -> hg.Network:
    """Each sensor through a relay of its own."""
    plant = hg.LinearPlant(TRANSITION, PROCESS, np.zeros(3), np.eye(3))
    nodes = {
        f"node{i}": hg.Node(
            hg.LinearSensor(ROWS[i : i + 1], NOISES[i]), hg.amplify_and_forward([hg.hop(1.0, a) for a in ALPHA[i]]), {}
        )
        for i in range(SENSORS)
    }
    return hg.Network(plant, nodes)


def measure() -> dict[str, Any]:
    """Medians, warm; the design of many starts once."""
    paths = hg.planning.independent_paths(TRANSITION, PROCESS, ROWS, NOISES, 1.02, ALPHA[:, 0])
    few = hg.planning.independent_paths(TRANSITION, PROCESS, ROWS[:6], NOISES[:6], 1.02, ALPHA[:6, 0])
    free, even = np.ones(6, dtype=bool), np.full((1, 6), 1 / 3)
    criterion = Error().criterion(("x0", "x1", "x2"))
    problem = make_power_task(few, criterion, make_unlimited(1, 6), free, np.zeros((1, 6)), 1, 0).problem
    network = relayed()
    values = {
        "error and gradient, 6 sensors": milliseconds(lambda: problem.sensitivity(even), 10 * REPEATS),
        "one hop, 20 sensors": milliseconds(lambda: hg.design(paths, budget=5.0), REPEATS),
        "two hops, 20 sensors, 30 starts": milliseconds(lambda: hg.design(network, budget=20.0, starts=STARTS)),
    }
    limits = {
        "error and gradient, 6 sensors": ERROR_LIMIT,
        "one hop, 20 sensors": CONVEX_LIMIT,
        "two hops, 20 sensors, 30 starts": STARTS_LIMIT,
    }
    return {"unit": "ms", "values": values, "at_most": limits}


if __name__ == "__main__":
    show(measure())
