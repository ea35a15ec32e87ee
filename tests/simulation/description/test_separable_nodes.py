"""`heliograph check` says where independent sensors were written as nodes of one plant."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.simulation.description.doubts import doubts_before_data


def network(matrix):
    plant = hg.LinearPlant(matrix, 0.1 * np.eye(3), np.zeros(3), np.eye(3))
    nodes = {}
    for i, name in enumerate(["kitchen", "hall", "cellar"]):
        sensor = hg.LinearSensor(np.eye(3)[[i]], 0.1)
        nodes[name] = hg.Node(sensor, hg.perfect(), {"kalman": hg.kalman_filter(plant, sensor)})
    return hg.Network(plant, nodes)


COUPLED = np.array([[0.9, 0.1, 0.0], [0.0, 0.9, 0.0], [0.0, 0.0, 0.9]])
CHAIN = np.array([[0.9, 0.1, 0.0], [0.0, 0.9, 0.1], [0.0, 0.0, 0.9]])


@pytest.mark.parametrize(
    ("matrix", "said"), [(0.9 * np.eye(3), "'kitchen', 'hall'"), (COUPLED, "'kitchen', 'cellar'"), (CHAIN, None)]
)
def test_independent_sensors_are_better_a_fleet(matrix, said):
    lines = [doubt for doubt in doubts_before_data(network(matrix)) if "fleet" in doubt.words]
    assert len(lines) == (said is not None)
    assert all(said in line.words and not line.serious for line in lines)
