"""Sums of squares and their factors, against the matrices themselves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import straightline
from heliograph.factors import (
    WeightedColumns,
    columns_of,
    decorrelate,
    eliminate,
    join_columns,
    noise_beside_repeated,
    rounding_of,
    rounding_of_variances,
    triangularise,
    unit_lower,
)
from heliograph.factors.covariance_factors import find_covariance_root

# One program for each size, not one for each of its hundred operations.
triangularise, eliminate, decorrelate = (jax.jit(f) for f in (triangularise, eliminate, decorrelate))

EXACT = {"rtol": 1e-12, "atol": 1e-12}  # sums of some twenty products of numbers of order 1


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def columns(n, count, seed=0):
    rng = np.random.default_rng(seed)
    return WeightedColumns(rng.normal(size=(n, count)), rng.uniform(0.1, 2.0, count))


def product(c):
    return (np.asarray(c.matrix) * np.asarray(c.weights)) @ np.transpose(c.matrix)


@pytest.mark.parametrize("n", [1, 2, 5, 9, 25])
def test_both_ways_to_factors_give_the_sum(n):
    """Written out up to 24 rows, a loop above."""
    given = columns(n, n + 3)
    for factors in (triangularise(given), eliminate(given.covariance)):
        np.testing.assert_allclose(product(factors), product(given), **EXACT)
        assert np.all(np.triu(factors.matrix, 1) == 0) and np.all(np.diagonal(factors.matrix) == 1)
        assert np.all(np.asarray(factors.weights) > 0)


@pytest.mark.parametrize("n", [4, 25])
def test_a_row_made_of_others_leaves_nothing(n):
    """Exactly nothing of a row of zeros; of twice another the square of rounding, or, eliminated, rounding."""
    given = columns(n, n + 3)
    given.matrix[1], given.matrix[2] = 2 * given.matrix[0], 0.0
    orthogonal, formed = triangularise(given), eliminate(given.covariance)
    assert orthogonal.weights[2] == 0 and np.all(np.asarray(orthogonal.matrix)[3:, 2] == 0)
    assert 0 <= orthogonal.weights[1] < 1e-28 and 0 <= formed.weights[1] < 1e-13
    np.testing.assert_allclose(product(orthogonal), product(given), **EXACT)


def test_a_pivot_is_at_least_its_share():
    """[[1, 1], [1, 1 - eps]] has the pivot -eps."""
    least = 1e-14
    covariance = jnp.asarray([[1.0, 1.0], [1.0, 1 - 2.3e-16]])
    assert eliminate(covariance).weights[1] == 0
    assert eliminate(covariance, least).weights[1] == pytest.approx(least)


def test_derivatives_exist_where_variances_are_zero():
    """Of d_2 of W diag(w) W' by the weight of a column that alone carries the second row: its square."""
    matrix = np.array([[1.0, 0.0], [0.5, 3.0]])

    def second_of_columns(w):
        return triangularise(WeightedColumns(matrix, jnp.stack([0.0 * w, w]))).weights[1]

    def second_of_diagonal(v):
        return eliminate(jnp.diag(jnp.stack([v, 2 * v]))).weights[1]

    of_weight, of_pivot = (jax.jit(jax.grad(f)) for f in (second_of_columns, second_of_diagonal))
    assert of_weight(0.0) == pytest.approx(9.0) and of_pivot(0.0) == pytest.approx(2.0)


def test_decorrelated_rows_have_independent_noises():
    lower, rows = triangularise(columns(4, 7)).matrix, np.random.default_rng(1).normal(size=(4, 3))
    np.testing.assert_allclose(lower @ decorrelate(lower, rows), rows, **EXACT)


@pytest.mark.parametrize("rank", [0, 1, 2, 3])
def test_a_known_covariance_has_as_many_columns_as_its_rank(rank):
    """Whatever the units: its components' deviations differ by 1e12."""
    root = np.random.default_rng(rank).normal(size=(3, rank)) * np.array([[1e-6], [1.0], [1e6]])
    made = find_covariance_root(root @ root.T)
    unit = np.sqrt(np.maximum(np.diagonal(root @ root.T), 1e-300))
    assert made.shape == (3, rank)
    assert np.max(np.abs(made @ made.T - root @ root.T) / np.outer(unit, unit), initial=0.0) < 1e-12


def test_a_covariance_that_is_traced_is_eliminated():
    whole = columns(4, 4).matrix
    whole = whole @ whole.T
    whole[2] = whole[:, 2] = 0.0  # a state without noise
    made = jax.jit(columns_of)(whole)
    np.testing.assert_allclose(product(made), whole, **EXACT)
    assert np.all(np.asarray(made.weights) >= 0)


def test_covariances_add_as_columns():
    first, second = columns(3, 2), columns(3, 4, 1)
    np.testing.assert_allclose(product(join_columns(first, second)), product(first) + product(second), **EXACT)
    turn = np.random.default_rng(2).normal(size=(2, 3))
    np.testing.assert_allclose(first.through(turn).covariance, turn @ product(first) @ turn.T, **EXACT)


def test_rounding_is_noise_of_four_units():
    np.testing.assert_allclose(product(rounding_of(np.array([1.0, 1e8]))), np.diag([1.0, 1e8]) * (4 * 2**-52) ** 2)


def test_a_variance_is_off_by_no_more_than_the_rounding_of_its_products():
    """Of 30 products in single precision, against the same in double."""
    numbers = np.random.default_rng(3).normal(size=(500, 30)).astype(np.float32)
    single = np.sum(numbers**2, axis=1, dtype=np.float32)
    error = np.abs(single - np.sum(numbers.astype(float) ** 2, axis=1))
    assert np.all(error < rounding_of_variances(single, 30)) and error.max() > 0


def test_what_is_repeated_says_nothing_beside_its_noise():
    """Of a number of size 1e6 only slopes of rounding are left: their share of its variance is rounding too."""
    size = np.array([1e6])
    left = (2**-52 * size) ** 2
    assert left / (left + noise_beside_repeated(size)) < 2**-51


def test_a_lower_matrix_is_made_of_its_entries():
    np.testing.assert_array_equal(unit_lower(np.array([2.0, 3.0, 4.0])), [[1, 0, 0], [2, 1, 0], [3, 4, 1]])
    assert unit_lower(np.zeros((5, 0))).shape == (5, 1, 1)


@pytest.mark.parametrize("n", [2, 30])
def test_a_variance_below_zero_by_rounding_leaves_no_pivot_below_zero(n):
    """Of a difference of moments: eps of them on either side of zero."""
    with jax.enable_x64(True):
        for least in (0.0, 2e-14):
            weights = eliminate(jnp.diag(jnp.where(np.arange(n) % 2, 1.0, -1e-16)), least).weights
            assert np.all(np.asarray(weights) >= 0)


@pytest.mark.parametrize("n", [12, 26])
def test_natively_the_noise_of_many_outputs_on_their_own_costs_what_that_of_each_costs(n):
    """Its columns are two of each output: its variance is a sum of two squares, and nothing is correlated.

    By operations: reading 2 n numbers, of each output a sum of two squares and no more than ten to judge it, for the
    n (n + 1) 2 n products of rows that are full.
    """

    def noise(w):
        factors = triangularise(
            WeightedColumns(jnp.concatenate([jnp.diag(w[:n]), jnp.diag(w[n:])], axis=1), jnp.ones(2 * n))
        )
        return factors.matrix, factors.weights, eliminate(jnp.diag(w[:n])).weights

    w = np.random.default_rng(2).uniform(0.5, 2.0, size=(3, 2 * n))
    code = straightline.compile(noise, w[0])
    assert code.operations < 20 * n
    matrix, weights, eliminated = code(w)
    np.testing.assert_array_equal(matrix, np.broadcast_to(np.eye(n), (3, n, n)))
    np.testing.assert_allclose(weights, w[:, :n] ** 2 + w[:, n:] ** 2, rtol=1e-15)
    np.testing.assert_array_equal(eliminated, w[:, :n])
