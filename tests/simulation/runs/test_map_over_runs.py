"""Many runs at once: the same numbers as one by one, for any number of runs and cores."""

import os

import jax
import numpy as np
import pytest

import heliograph as hg

PLANT = hg.LinearPlant([[0.9, 0.1], [0.0, 0.8]], 0.1, np.zeros(2), np.eye(2))
STEPS = 5


def follow(gains, z):
    """A Kalman filter whose sensor has another known gain at each step and run."""

    def step(state, item):
        gain, measurement = item
        sensor = hg.LinearSensor(gain * np.eye(1, 2), 0.1)
        state, estimate = hg.extended_filter(PLANT, sensor, hg.perfect()).step(state, measurement)
        return state, estimate.mean

    start = hg.extended_filter(PLANT, hg.LinearSensor(np.eye(1, 2), 0.1), hg.perfect()).init()
    last, means = jax.lax.scan(step, start, (gains, z))
    return means, last.covariance


def one_by_one(gains, z):
    """The textbook's formulas."""
    mean, spread, means = np.zeros(2), np.eye(2), []
    for gain, measurement in zip(gains, z, strict=True):
        mean, spread = PLANT.matrix @ mean, PLANT.matrix @ spread @ PLANT.matrix.T + 0.1 * np.eye(2)
        c = gain * np.eye(1, 2)
        k = spread @ c.T / (c @ spread @ c.T + 0.1)
        mean, spread = mean + k @ (measurement - c @ mean), spread - k @ c @ spread
        means.append(mean)
    return np.array(means), spread


@pytest.mark.parametrize("runs", [1, 7, 300])
@pytest.mark.parametrize("cores", [1, 3])
def test_every_run_is_the_textbooks_filter(monkeypatch, runs, cores):
    """Rounding only."""
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    random = np.random.default_rng(runs)
    gains, z = random.uniform(0.5, 1.5, (runs, STEPS)), random.normal(size=(runs, STEPS, 1))
    means, last = hg.simulation.over_runs(follow, gains, z, width=64)
    assert means.shape == (runs, STEPS, 2) and last.shape == (runs, 2, 2) and means.dtype == np.float64
    for i in {0, runs // 2, runs - 1}:
        expected = one_by_one(gains[i], z[i])
        np.testing.assert_allclose(means[i], expected[0], rtol=1e-11, atol=1e-13)
        np.testing.assert_allclose(last[i], expected[1], rtol=1e-11, atol=1e-13)


def test_arrays_without_a_common_axis_are_refused():
    for arrays in ((), (np.zeros((3, 2)), np.zeros((4, 2))), (np.zeros((0, 2)),), (1.0,)):
        with pytest.raises(ValueError, match=r"arrays over runs: expected one leading axis of runs, at least one"):
            hg.simulation.over_runs(follow, *arrays)


def test_results_have_the_precision_that_their_numbers_have():
    """Rows of float32 by themselves stay so; a filter's numbers are doubles, and what it makes of the rows is, too."""
    random = np.random.default_rng(4)
    gains, z = (random.uniform(0.5, 1.5, shape).astype(np.float32) for shape in ((3, STEPS), (3, STEPS, 1)))
    assert hg.simulation.over_runs(lambda row: 2 * row, z).dtype == np.float32
    single, double = (hg.simulation.over_runs(follow, gains.astype(kind), z.astype(kind)) for kind in ("f4", "f8"))
    for one, other in zip(single, double, strict=True):
        assert one.dtype == np.float64
        np.testing.assert_array_equal(one, other)
