"""Rows of many numbers, which XLA steps: a step of one plant costs about what its own row costs."""

from time import process_time

import numpy as np
import pytest

import heliograph as hg
from heliograph.live.network_step_program import NetworkProgram


@pytest.mark.slow
def test_a_long_row_costs_little_more_than_a_row_alone(monkeypatch):
    """It cost 125 times as much: room for 512 rows was filled for one of 60,000 numbers, and 16 of them computed."""
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "xla")
    plant, link = hg.LinearPlant([[0.98]], 0.04, [0.0], 1.0), hg.erasure(hg.perfect(), arrival=0.9)
    sensor, rule = hg.LinearSensor([[1.0]], 0.01), hg.SendOnDelta(0.6, heartbeat=240, losses="numbered")
    node = hg.Node(sensor, link, {"event": hg.event_filter(plant, sensor, link, rule)}, trigger=rule)
    step = NetworkProgram(hg.Network(plant, {"a": node})).step_rows
    assert step.state.size > 10_000
    row = np.concatenate([step.start, np.full(node.received, np.nan), [0.0]])[None]
    alone, among = step(row, alone=True), step(row)  # compiled
    np.testing.assert_array_equal(step(np.repeat(row, 3, axis=0)), np.repeat(among, 3, axis=0))
    np.testing.assert_allclose(among, alone, rtol=1e-12)  # rounding: two programs
    cost = []
    for single in (True, False):
        began = process_time()
        for _ in range(20):
            step(row, alone=single)
        cost.append(process_time() - began)
    assert cost[1] < 8 * cost[0]  # measured 1.5; a fleet's call fills and copies up to 2 MB
