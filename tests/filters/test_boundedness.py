"""The condition of Theorem 3 and the ceilings that take its place."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.filters.boundedness import empirical_ceiling, growth_condition, provable_ceiling
from tests.machine import PRINTED, plant
from tests.oracles.cubature_fusion import jacobian

ROTATION = 0.9 * np.array([[np.cos(1.0), -3 * np.sin(1.0)], [np.sin(1.0) / 3, np.cos(1.0)]])  # rho = 0.9, norm > 1


def linear(matrix):
    return hg.LinearPlant(matrix, 0.1 * np.eye(2), [0.0, 0.0], np.eye(2))


def test_gains_are_those_of_the_analytic_jacobian():
    states = np.random.default_rng(0).normal(size=(20, 5))
    found = growth_condition(plant(PRINTED), states, 1e-6)
    expected = np.linalg.norm(jacobian(states, PRINTED), 2, axis=(-2, -1)) ** 2
    np.testing.assert_allclose(found.gains, expected, rtol=1e-12)  # rounding of two ways to one matrix
    assert found.factor == pytest.approx((1 + 1e-6) * expected.max(), rel=1e-12)
    np.testing.assert_array_equal(found.worst_state, states[np.argmax(expected)])


def test_the_machine_never_meets_the_condition():
    # Column 5 of the Jacobian holds a 1 on its diagonal, whatever the state, so sigma_max >= 1.
    states = np.random.default_rng(1).normal(scale=10.0, size=(200, 5))
    found = growth_condition(plant(PRINTED), states)
    assert np.all(found.gains >= 1) and not found.satisfiable and found.excess == found.factor - 1


def test_a_contraction_meets_the_condition():
    found = growth_condition(linear(0.5 * np.eye(2)), np.zeros((1, 2)), 0.1)
    assert found.satisfiable and found.factor == pytest.approx(1.1 * 0.25, rel=1e-14)


def test_no_filter_exceeds_the_provable_ceiling():
    system, start, beta = linear(ROTATION), 0.5 * np.eye(2), 0.1
    assert not growth_condition(system, np.zeros((1, 2)), beta).satisfiable  # the ceiling needs less than the theorem
    law = hg.Discrete([0.0, 1.0], [0.5, 0.5], 0.05)
    sensor = hg.LinearSensor([[1.0, 0.0]], [[1e6]])
    update = hg.Polytope(hg.Scalars(beta, 1e-2))
    item = hg.cubature_filter(system, sensor, hg.hop(law, 0.1), update, initial_covariance=start)
    state, largest = item.init(), 0.0
    for _ in range(60):
        state, estimate = item.step(state, np.zeros(1))
        largest = max(largest, np.linalg.norm(estimate.covariance, 2))
    ceiling = provable_ceiling(system, start, beta)
    assert ceiling.kind == "provable" and largest <= ceiling.value * (1 + 1e-12)  # rounding
    assert largest >= 0.99 * ceiling.value  # this sensor is almost blind: the ceiling is nearly reached


def test_the_provable_ceiling_without_scalars_is_the_lyapunov_solution_or_the_way_there():
    system, limit = linear(ROTATION), np.zeros((2, 2))
    for _ in range(400):  # 0.9^800 is below rounding
        limit = ROTATION @ limit @ ROTATION.T + 0.1 * np.eye(2)
    assert provable_ceiling(system, np.zeros((2, 2))).value == pytest.approx(np.linalg.norm(limit, 2), rel=1e-10)
    assert provable_ceiling(system, 100 * np.eye(2)).value > 100  # a large start grows first: the norm is above 1


def test_the_provable_ceiling_is_refused_where_none_is_provable():
    with pytest.raises(ValueError, match="spectral radius below 1"):
        provable_ceiling(linear(0.99 * np.eye(2)), np.eye(2), 0.1)


def test_the_empirical_ceiling_says_what_it_is():
    sequence = np.array([np.eye(2), np.diag([1.0, 3.0]), 2 * np.eye(2)])
    found = empirical_ceiling(sequence, "claimed covariance")
    assert (found.kind, found.value, found.step) == ("empirical", pytest.approx(3.0, rel=1e-14), 1)
    assert "3 steps" in found.reason


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="states: expected shape"):
        growth_condition(plant(PRINTED), np.zeros((3, 4)))
    with pytest.raises(ValueError, match="first scalar"):
        growth_condition(plant(PRINTED), np.zeros((1, 5)), -0.1)
    with pytest.raises(ValueError, match="finite"):
        empirical_ceiling(np.full((1, 2, 2), np.nan))
