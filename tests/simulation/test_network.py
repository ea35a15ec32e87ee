"""Nodes of one structure stand in one group."""

import numpy as np

import heliograph as hg


def test_names_of_outputs_do_not_part_filters_of_one_structure():
    """One program steps them all: twelve event senders with names of their own took a program for each to compile."""

    def network(outputs):
        plant = hg.LinearPlant(0.9 * np.eye(2), 0.1 * np.eye(2), [0.0, 0.0], np.eye(2))
        nodes = {}
        for i, name in enumerate(outputs):
            sensor = hg.LinearSensor(np.eye(2)[[i]], 0.1, outputs=name and [name])
            nodes[f"n{i}"] = hg.Node(sensor, hg.perfect(), {"kalman": hg.kalman_filter(plant, sensor)})
        return hg.Network(plant, nodes)

    named, plain = network(["left", "right"]), network([None, None])
    assert named.groups == plain.groups == (("n0", "n1"),)
    assert named.nodes["n1"].sensor.outputs == ("right",)
    for a, b in zip(*(hg.monte_carlo(n, 5, 3, key=1).measurements.values() for n in (named, plain)), strict=True):
        np.testing.assert_array_equal(a, b)
