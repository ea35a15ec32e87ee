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
    result = boundedness(hg.linear.lifted_system(*model(EXAMPLE, 100), 2, 100))
    assert not result.lower.applies and "Cov(w)" in result.lower.reason and result.constants.process_low == 0
    assert result.constants.noise_low == pytest.approx(0.3133, abs=1e-4)
    assert result.growth.applies and result.growth.value > 1e9 and "grows without end" in result.growth.reason
    assert not result.window.applies and "needs Theorem 3" in result.window.reason
    assert result.covariance.value == pytest.approx(1.5191, abs=1e-4)
    assert result.covariance.actual <= result.covariance.value


def test_full_rank_noise_meets_it_and_the_bounds_are_far_off():
    s = replace(EXAMPLE, B=np.diag([0.05, 0.1]), w=oracle.independent(EXAMPLE.w, EXAMPLE.w))
    system = hg.linear.lifted_system(*model(s, 40), 2, 40)
    result = boundedness(system, window=10)
    assert result.lower.applies and 0 < result.lower.value <= result.lower.actual
    assert result.window.applies and result.window.value > 1e50 > result.window.actual
    short = boundedness(system, window=3)
    assert not short.window.applies and "singular" in short.window.reason


def test_a_scalar_system_by_hand():
    values = np.ones((3, 1, 1))
    steps = hg.linear.Steps(0.5 * values, 0 * values[:, 0], 2.0 * values, values, 0 * values[:, 0], 4.0 * values)
    result = boundedness(hg.linear.LinearSystem(steps, [0.0], [[1.0]], [[1.0]]), window=1)
    assert result.lower.value == pytest.approx(1 / (1 / 2 + 1 / 4))
    assert result.growth.value == pytest.approx(2 + 0.25 * (2 + 0.25 * (2 + 0.25)))
    assert "bounded for all time" in result.growth.reason
    zeta = 1 + 2 / (0.25 * result.lower.value)
    assert result.window.value == pytest.approx(1 / (1 / 4 + 2.0**2 / 4 / zeta), rel=1e-12)
    assert result.window.actual <= result.window.value


def test_a_plant_that_forgets_has_no_inverse():
    values = np.ones((3, 1, 1))
    steps = hg.linear.Steps(0 * values, 0 * values[:, 0], 2.0 * values, values, 0 * values[:, 0], 4.0 * values)
    result = boundedness(hg.linear.LinearSystem(steps, [0.0], [[1.0]], [[1.0]]), window=1)
    assert not result.window.applies and "A' A" in result.window.reason


def test_a_window_beyond_the_horizon_is_refused():
    with pytest.raises(ValueError, match="window: expected from 1 to 4 steps, got 5"):
        boundedness(hg.linear.lifted_system(*model(EXAMPLE, 5), 2, 5), window=5)
