import cvxpy as cp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import heliograph as hg

PRINTED_LEVELS = (1.8, 1.7, 1.8, 1.9)
PRINTED_WEIGHTS = np.array([0.2635, 0.2634, 0.2493, 0.2237])  # they sum to .9999


def test_numbers_of_the_publication():
    best = hg.level_weights(PRINTED_LEVELS)
    # All digits stated; half a unit in the last one.
    np.testing.assert_allclose(best, [0.248842, 0.278979, 0.248842, 0.223337], rtol=0, atol=5e-7)
    assert hg.published_fused_level(PRINTED_LEVELS, best) == pytest.approx(2.539682, abs=5e-7)
    normalised = hg.published_fused_level(PRINTED_LEVELS, PRINTED_WEIGHTS / PRINTED_WEIGHTS.sum())
    assert normalised == pytest.approx(2.54188, abs=5e-6)  # the published 2.5419
    assert normalised * PRINTED_WEIGHTS.sum() == pytest.approx(2.54163, abs=5e-6)  # the level is linear in scale
    assert hg.fused_level(PRINTED_LEVELS, best) == pytest.approx(1.794, abs=5e-4)
    assert hg.published_fused_level(PRINTED_LEVELS, best) > max(PRINTED_LEVELS)  # worse than every node alone


def test_one_node():
    np.testing.assert_array_equal(hg.level_weights([1.7]), [1.0])
    assert hg.published_fused_level([2.0], [1.0]) == pytest.approx(2 * np.sqrt(2), rel=1e-15)
    assert hg.fused_level([2.0], [1.0]) == 2.0


def test_the_published_matrix_inequality_has_this_infimum():
    gamma, n = np.array(PRINTED_LEVELS), 4
    c, pi = cp.Variable(n), cp.Variable()
    scaled = cp.reshape(cp.multiply(c, gamma), (1, n), order="C")
    matrix = cp.bmat([[cp.reshape(-pi / (2 * n), (1, 1), order="C"), scaled], [scaled.T, -np.eye(n)]])
    cp.Problem(cp.Minimize(pi), [matrix << 0, cp.sum(c) == 1]).solve(solver=cp.CLARABEL)
    best = hg.published_fused_level(gamma, hg.level_weights(gamma))
    assert np.sqrt(pi.value) == pytest.approx(best, rel=1e-6)  # the solver's tolerance


@settings(max_examples=50)
@given(levels=st.lists(st.floats(0.1, 10), min_size=1, max_size=6), seed=st.integers(0, 1000))
def test_closed_form_is_optimal_and_minkowski_is_sharper(levels, seed):
    other = np.random.default_rng(seed).dirichlet(np.ones(len(levels)))
    best = hg.published_fused_level(levels, hg.level_weights(levels))
    assert best <= hg.published_fused_level(levels, other) * (1 + 1e-12)
    assert best == pytest.approx(np.sqrt(2 * len(levels) / np.sum(np.array(levels) ** -2.0)), rel=1e-12)
    # (sum c g)^2 <= N sum c^2 g^2 (Cauchy), half of the published square.
    assert hg.fused_level(levels, other) <= hg.published_fused_level(levels, other) / np.sqrt(2) * (1 + 1e-12)
    assert hg.fused_level(levels, other) <= max(levels) * (1 + 1e-12)


@settings(max_examples=50)
@given(seed=st.integers(0, 10**6))
def test_no_errors_within_the_local_levels_exceed_the_fused_norm(seed):
    rng = np.random.default_rng(seed)
    count, time, n = rng.integers(1, 5), rng.integers(1, 6), rng.integers(1, 4)
    gamma, norms = rng.uniform(0.1, 2, count), rng.uniform(0, 2, count)
    c, matrix = rng.dirichlet(np.ones(count)), rng.normal(size=(2, n))
    e = rng.normal(size=(count, time, n))
    z = e @ matrix.T
    size = gamma * norms / np.linalg.norm(z, axis=(1, 2))  # each error as large as its level allows
    d = rng.exponential(size=(count, time, n))
    mu = d * rng.uniform(-1, 1, d.shape)
    fused = np.einsum("i,itk->tk", c, z * size[:, None, None] - mu @ matrix.T)
    bound = hg.fused_error_norm(gamma, c, norms, matrix, d)
    assert np.linalg.norm(fused) <= bound * (1 + 1e-12)


def test_the_fused_norm_at_its_limits():
    args = ([1.0, 2.0], [0.5, 0.5], [3.0, 3.0], np.eye(2))
    assert hg.fused_error_norm(*args, np.zeros((2, 4, 2))) == pytest.approx(3 * hg.fused_level(*args[:2]), rel=1e-15)
    assert np.isnan(hg.fused_error_norm(*args, np.full((2, 4, 2), np.nan)))  # a quantizer saturated


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: hg.level_weights([]), "levels: expected positive numbers"),
        (lambda: hg.level_weights([1.0, -1.0]), "levels: expected positive numbers"),
        (lambda: hg.fused_level([1.0, 1.0], [0.5, 0.6]), "sum to 1"),
        (lambda: hg.published_fused_level([1.0, 1.0], [1.0]), r"shape \(2\)"),
        (
            lambda: hg.fused_error_norm([1.0], [1.0], [1.0], np.eye(2), np.zeros((1, 3, 1))),
            r"errors: expected shape \(1, any, 2\)",
        ),
        (lambda: hg.fused_error_norm([1.0], [1.0], [-1.0], np.eye(1), np.zeros((1, 3, 1))), "no negative number"),
    ],
)
def test_bad_levels(call, message):
    with pytest.raises(ValueError, match=message):
        call()
