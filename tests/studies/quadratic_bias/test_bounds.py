"""The published bounds, where they apply and where they do not."""

from dataclasses import replace

import numpy as np
import pytest

import heliograph as hg
from heliograph_studies.quadratic_bias.bounds import boundedness
from tests.oracles import quadratic_bias as oracle
from tests.relay_bias import model

EXAMPLE = oracle.paper_example()


def test_example_fails_the_assumption_and_the_state_covariance_holds():
    found = boundedness(hg.linear.lifted_system(*model(EXAMPLE, 100), 2, 100))
    assert not found.lower.applies and "Cov(w)" in found.lower.reason and found.constants.process_low == 0
    assert found.constants.noise_low == pytest.approx(0.3133, abs=1e-4)
    assert found.growth.applies and found.growth.value > 1e9 and "grows without end" in found.growth.reason
    assert not found.window.applies and "needs Theorem 3" in found.window.reason
    assert found.covariance.value == pytest.approx(1.5191, abs=1e-4)
    assert found.covariance.actual <= found.covariance.value


def test_full_rank_noise_meets_it_and_the_bounds_are_far_off():
    s = replace(EXAMPLE, B=np.diag([0.05, 0.1]), w=oracle.independent(EXAMPLE.w, EXAMPLE.w))
    system = hg.linear.lifted_system(*model(s, 40), 2, 40)
    found = boundedness(system, window=10)
    assert found.lower.applies and 0 < found.lower.value <= found.lower.actual
    assert found.window.applies and found.window.value > 1e50 > found.window.actual
    short = boundedness(system, window=3)
    assert not short.window.applies and "singular" in short.window.reason


def test_a_scalar_system_by_hand():
    one = np.ones((3, 1, 1))
    steps = hg.linear.Steps(0.5 * one, 0 * one[:, 0], 2.0 * one, one, 0 * one[:, 0], 4.0 * one)
    found = boundedness(hg.linear.LinearSystem(steps, [0.0], [[1.0]], [[1.0]]), window=1)
    assert found.lower.value == pytest.approx(1 / (1 / 2 + 1 / 4))
    assert found.growth.value == pytest.approx(2 + 0.25 * (2 + 0.25 * (2 + 0.25)))
    assert "bounded for all time" in found.growth.reason
    zeta = 1 + 2 / (0.25 * found.lower.value)
    assert found.window.value == pytest.approx(1 / (1 / 4 + 2.0**2 / 4 / zeta), rel=1e-12)
    assert found.window.actual <= found.window.value


def test_a_plant_that_forgets_has_no_inverse():
    one = np.ones((3, 1, 1))
    steps = hg.linear.Steps(0 * one, 0 * one[:, 0], 2.0 * one, one, 0 * one[:, 0], 4.0 * one)
    found = boundedness(hg.linear.LinearSystem(steps, [0.0], [[1.0]], [[1.0]]), window=1)
    assert not found.window.applies and "A' A" in found.window.reason


def test_a_window_beyond_the_horizon_is_refused():
    with pytest.raises(ValueError, match="window: expected from 1 to 4 steps, got 5"):
        boundedness(hg.linear.lifted_system(*model(EXAMPLE, 5), 2, 5), window=5)
