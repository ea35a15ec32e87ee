"""Simulated plants with limits: the world does not know them, and says so where it leaves them."""

import warnings

import numpy as np
import pytest

import heliograph as hg

READ = hg.LinearSensor([[1.0]], 0.1, ["level"])


def network(noise, limits):
    plant = hg.LinearPlant([[1.0]], noise, [0.5], 1e-4, states=["level"], limits=limits)
    return hg.Network(plant, {"a": hg.Node(READ, hg.perfect(1), {"f": hg.kalman_filter(plant, READ)})})


def test_a_drawn_path_that_leaves_the_limits_is_said_with_its_step_and_stays_what_it_is():
    free = hg.monte_carlo(network(0.04, {}), 20, 8, 0)
    left = (free.truth[..., 0] < 0) | (free.truth[..., 0] > 1)
    expected = f"the true 'level' leaves its limits 0 to 1 in {left.any(axis=1).sum()} of 8 runs, first at step "
    with pytest.warns(UserWarning, match=expected + str(np.argmax(left.any(axis=0)))):
        limited = hg.monte_carlo(network(0.04, {"level": (0, 1)}), 20, 8, 0)
    np.testing.assert_array_equal(limited.truth, free.truth)
    assert np.all(limited.estimates["a"]["f"].mean <= 1)


def test_one_that_keeps_them_is_not():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hg.simulate(network(1e-8, {"level": (0, None)}), 20, 0)
