"""Starts of a fit to a long recording: its first rows say where they begin, all rows where they end."""

import numpy as np
import pytest

import heliograph as hg

ROWS, LATE = 140_000, 20_000
RNG = np.random.default_rng(3)
LEVEL = np.cumsum(0.3 * RNG.normal(size=ROWS))
NEAR, FAR = LEVEL + 0.5 * RNG.normal(size=ROWS), LEVEL + 2.0 * RNG.normal(size=ROWS)


def build():
    plant = hg.LinearPlant([[1.0]], hg.free(1.0, "q", "positive"), [0.0], 1.0)
    nodes = {
        name: hg.Node(hg.LinearSensor([[1.0]], hg.free(1.0, name, "positive")), hg.perfect(), {})
        for name in ("near", "far")
    }
    return hg.Network(plant, nodes)


@pytest.mark.slow
def test_numbers_that_the_first_rows_do_not_know_are_found():
    """The far sensor is silent in all rows that say where drawn starts begin."""
    recording = {"near": NEAR, "far": np.where(np.arange(ROWS) < LATE, np.nan, FAR)}
    one, several = hg.fit(build, recording, starts=1), hg.fit(build, recording, starts=4)
    assert one.converged and several.converged
    for name, value in {"q": 0.09, "near": 0.25, "far": 4.0}.items():
        assert several.values[name] == pytest.approx(one.values[name], rel=1e-6)
        assert several.values[name] == pytest.approx(value, rel=0.05)  # a hundred thousand rows: errors below 1 %
    # Both rounds of climbs, and one from near the end of each number's domain: all end at the one maximum.
    assert len(several.ends) == 4 + 3 + 3
    np.testing.assert_allclose(several.ends, several.log_likelihood, atol=1e-3)
