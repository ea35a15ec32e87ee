"""Sums of squares by their factors, against the matrices themselves."""

import jax.numpy as jnp
import numpy as np
import pytest

from heliograph.filters.gaussian.factors import (
    Columns,
    columns_of,
    columns_of_known,
    decorrelated,
    factors_of,
    gram_schmidt,
    measured,
    sum_of,
)
from heliograph.numerics.float64 import in_float64

# Products of a few numbers of order 1 in double precision.
EXACT = {"rtol": 1e-13, "atol": 1e-13}


@pytest.fixture
def columns():
    rng = np.random.default_rng(0)
    return Columns(rng.normal(size=(4, 7)), rng.uniform(0.1, 2.0, 7))


def test_factors_are_those_of_the_sum(columns):
    factors = in_float64(factors_of)(columns)
    expected = (columns.matrix * columns.weights) @ columns.matrix.T
    np.testing.assert_allclose(in_float64(lambda: factors.covariance())(), expected, **EXACT)
    np.testing.assert_allclose(in_float64(sum_of)(columns), expected, **EXACT)
    assert np.all(factors.variances > 0)


def test_a_row_made_of_others_leaves_nothing(columns):
    """Exactly nothing where it is zero; to rounding where it is twice another."""
    twice = columns.matrix.copy()
    twice[1], twice[2] = 2 * twice[0], 0.0
    lower, variances = in_float64(gram_schmidt)(columns._replace(matrix=twice))
    assert variances[2] == 0 and np.all(lower[3, 2] == 0) and 0 <= variances[1] < 1e-28
    expected = (twice * columns.weights) @ twice.T
    np.testing.assert_allclose((lower * variances) @ lower.T, expected, **EXACT)


def test_decorrelated_rows_have_independent_noises(columns):
    lower = in_float64(gram_schmidt)(columns)[0]
    rows = np.random.default_rng(1).normal(size=(4, 3))
    np.testing.assert_allclose(lower @ in_float64(decorrelated)(lower, rows), rows, **EXACT)


def test_one_measurement_is_kalman_s(columns):
    """P - P h h' P / s and P h / s; a further row moves as one of the state's."""
    rng, noise = np.random.default_rng(2), 0.3
    factors = in_float64(factors_of)(columns)
    root, d = in_float64(lambda: factors.matrix())(), factors.variances
    h, other = rng.normal(size=(2, 4))
    rows = np.vstack([root, other @ root])
    after, left, gain = in_float64(measured)(rows, d, h @ root, np.float64(noise))
    whole = (rows * d) @ rows.T
    cross, total = whole[:, :4] @ h, h @ whole[:4, :4] @ h + noise
    np.testing.assert_allclose(gain, cross / total, **EXACT)
    np.testing.assert_allclose((after * left) @ after.T, whole - np.outer(cross, cross) / total, **EXACT)
    assert np.all(np.triu(after[:4], 1) == 0) and np.all(np.diagonal(after) == 1)


def test_a_precise_measurement_keeps_its_digits():
    """In single precision, where P - K h' P would be zero: a variance of 1 measured with 1e-8 leaves 1e-8."""
    rows, item = np.ones((1, 1), np.float32), np.ones(1, np.float32)
    _, left, _ = measured(rows, item, item, np.float32(1e-8))
    assert left.dtype == np.float32
    np.testing.assert_allclose(left, 1e-8, rtol=3e-7)  # two roundings of 6e-8 and that of 1e-8 itself


def test_nothing_known_and_nothing_said_changes_nothing():
    rows, none = np.eye(2), np.zeros(2)
    after, left, gain = in_float64(measured)(rows, none, np.ones(2), np.float64(0.0))
    assert np.all(after == rows) and np.all(left == 0) and np.all(gain == 0)


@pytest.mark.parametrize("rank", [0, 1, 2, 3])
def test_a_known_covariance_has_as_many_columns_as_its_rank(rank):
    root = np.random.default_rng(rank).normal(size=(3, rank)) * np.array([[1e-6], [1.0], [1e6]])
    made = columns_of(root @ root.T)
    assert made.matrix.shape == (3, rank)
    unit = np.sqrt(np.maximum(np.diagonal(root @ root.T), 1e-300))
    gap = (made.matrix @ made.matrix.T - root @ root.T) / np.outer(unit, unit)
    assert np.max(np.abs(gap), initial=0.0) < 1e-12


def test_a_covariance_of_the_input_is_eliminated(columns):
    whole = columns.matrix @ columns.matrix.T
    whole[2] = whole[:, 2] = 0.0  # a state without noise
    made = in_float64(lambda: columns_of(jnp.asarray(whole)))()
    np.testing.assert_allclose((made.matrix * made.weights) @ made.matrix.T, whole, **EXACT)
    assert np.all(np.asarray(made.weights) >= 0)


def test_what_is_no_covariance_is_refused():
    with pytest.raises(ValueError, match="no covariance"):
        columns_of_known(np.array([[1.0, 2.0], [2.0, 1.0]]))
