"""Theorem 4's level: the printed numbers, one node, and the matrix inequality whose infimum it is."""

import cvxpy as cp
import numpy as np
import pytest

import heliograph as hg
from heliograph_studies.h_infinity_fusion.levels import published_fused_level

PRINTED_LEVELS = (1.8, 1.7, 1.8, 1.9)
PRINTED_WEIGHTS = np.array([0.2635, 0.2634, 0.2493, 0.2237])  # they sum to .9999


def test_numbers_of_the_publication():
    best = hg.fusion.level_weights(PRINTED_LEVELS)
    # All digits stated; half a unit in the last one.
    np.testing.assert_allclose(best, [0.248842, 0.278979, 0.248842, 0.223337], rtol=0, atol=5e-7)
    assert published_fused_level(PRINTED_LEVELS, best) == pytest.approx(2.539682, abs=5e-7)
    normalised = published_fused_level(PRINTED_LEVELS, PRINTED_WEIGHTS / PRINTED_WEIGHTS.sum())
    assert normalised == pytest.approx(2.54188, abs=5e-6)  # the published 2.5419
    assert normalised * PRINTED_WEIGHTS.sum() == pytest.approx(2.54163, abs=5e-6)  # the level is linear in scale
    assert hg.fusion.fused_level(PRINTED_LEVELS, best) == pytest.approx(1.794, abs=5e-4)
    assert published_fused_level(PRINTED_LEVELS, best) > max(PRINTED_LEVELS)  # worse than every node alone


def test_one_node_is_worse_than_itself():
    assert published_fused_level([2.0], [1.0]) == pytest.approx(2 * np.sqrt(2), rel=1e-15)


def test_the_published_matrix_inequality_has_this_infimum():
    gamma, n = np.array(PRINTED_LEVELS), 4
    c, pi = cp.Variable(n), cp.Variable()
    scaled = cp.reshape(cp.multiply(c, gamma), (1, n), order="C")
    matrix = cp.bmat([[cp.reshape(-pi / (2 * n), (1, 1), order="C"), scaled], [scaled.T, -np.eye(n)]])
    cp.Problem(cp.Minimize(pi), [matrix << 0, cp.sum(c) == 1]).solve(solver=cp.CLARABEL)
    best = published_fused_level(gamma, hg.fusion.level_weights(gamma))
    assert np.sqrt(pi.value) == pytest.approx(best, rel=1e-6)  # the solver's tolerance
