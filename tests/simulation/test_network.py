"""Nodes of one structure stand in one group."""

import numpy as np
import pytest

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


@pytest.mark.slow
def test_heartbeats_and_periods_do_not_part_nodes():
    """They are numbers: a filter has room for the longest of its network, and is the same with it."""
    plant, sensor = hg.LinearPlant([[0.98]], 0.04, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.01)
    link = hg.erasure(hg.perfect(), 0.9)

    def node(trigger):
        return hg.Node(sensor, link, {"event": hg.event_filter(plant, sensor, link, trigger)}, trigger=trigger)

    rules = [hg.SendOnDelta(0.6, heartbeat=3), hg.SendOnDelta(0.5, heartbeat=8), hg.SendOnDelta(0.4, heartbeat=5)]
    network = hg.Network(plant, {f"n{i}": node(rule) for i, rule in enumerate(rules)})
    assert network.groups == (("n0", "n1", "n2"),)
    record = hg.monte_carlo(network, 30, 1, key=3)
    for i, rule in enumerate(rules):
        alone = hg.event_filter(plant, sensor, link, rule)
        means = alone.run(record.measurements[f"n{i}"][0]).means
        # The same sums, in another order where they are made side by side.
        np.testing.assert_allclose(record.estimates[f"n{i}"]["event"].mean[0], means, rtol=1e-12, atol=1e-12)
    assert len(hg.Network(plant, {f"n{i}": node(hg.Periodic(2 + i, i)) for i in range(3)}).groups) == 1
