"""The condition of Theorem 3."""

import numpy as np
import pytest

import heliograph as hg
from heliograph_studies.cubature_fusion.one_step import growth_condition
from tests.machine import PRINTED, plant
from tests.oracles.relayed_machine import jacobian


def linear(matrix):
    return hg.LinearPlant(matrix, 0.1 * np.eye(2), [0.0, 0.0], np.eye(2))


@pytest.mark.slow
def test_gains_are_those_of_the_analytic_jacobian():
    states = np.random.default_rng(0).normal(size=(20, 5))
    result = growth_condition(plant(PRINTED), states, 1e-6)
    expected = np.linalg.norm(jacobian(states, PRINTED), 2, axis=(-2, -1)) ** 2
    np.testing.assert_allclose(result.gains, expected, rtol=1e-12)  # rounding of two ways to one matrix
    assert result.factor == pytest.approx((1 + 1e-6) * expected.max(), rel=1e-12)
    np.testing.assert_array_equal(result.worst_state, states[np.argmax(expected)])


def test_the_machine_never_meets_the_condition():
    # Column 5 of the Jacobian holds a 1 on its diagonal, whatever the state, so sigma_max >= 1.
    states = np.random.default_rng(1).normal(scale=10.0, size=(200, 5))
    result = growth_condition(plant(PRINTED), states, 0.0)
    assert np.all(result.gains >= 1) and not result.satisfiable and result.excess == result.factor - 1


def test_a_contraction_meets_the_condition():
    result = growth_condition(linear(0.5 * np.eye(2)), np.zeros((1, 2)), 0.1)
    assert result.satisfiable and result.factor == pytest.approx(1.1 * 0.25, rel=1e-14)


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="states: expected shape"):
        growth_condition(plant(PRINTED), np.zeros((3, 4)), 0.0)
    with pytest.raises(ValueError, match="first scalar"):
        growth_condition(plant(PRINTED), np.zeros((1, 5)), -0.1)
