"""Arithmetic on long arrays in memory, row by row."""

import jax
import numpy as np
import pytest

from straightline import explain
from tests.straightline.over_runs import over_runs

RANDOM = np.random.default_rng(0)
RUNS = 3
COVARIANCES, APART = RANDOM.normal(size=(RUNS, 2, 9, 9)), RANDOM.normal(size=(RUNS, 2, 2, 9, 9))
FUNCTIONS = {
    "one row for all": lambda p, a: jax.lax.add(a, p[:, None]).sum(0),
    "the only one": lambda p, a: p[:1] - a[0],
    "a number for all": lambda p, a: p[0, 1, 1] * p[1] + a[0, 0],
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_what_has_one_row_or_fewer_axes_is_that_of_each_row(name):
    """As of JAX, to rounding of sums of two numbers of size 10: 1e-14."""
    function = FUNCTIONS[name]
    with jax.enable_x64(True):
        computed = over_runs(function, COVARIANCES, APART)
        expected = np.stack(
            [function(p, a) for p, a in zip(*map(jax.numpy.asarray, (COVARIANCES, APART)), strict=True)]
        )
    assert np.max(np.abs(computed - expected)) < 1e-14


def test_a_table_with_numbers_that_are_written_out_is_written_out_too():
    """Of the upper triangle of x x', mirrored, only that is computed: of 9 numbers, 45 products and sums."""

    def mirrored(x):
        square = x[:, None] * x[None]
        return jax.numpy.where(np.triu(np.ones((9, 9), bool)), square + x[0], (square + x[0]).T)

    assert explain(mirrored, np.zeros(9)) == "99 operations"


def test_a_number_times_a_table_of_few_entries_is_written_out():
    """(n I) x of ten numbers and a whole n, which is finite: eleven are read, n made a double, and ten products.

    So as if the table of a hundred were n itself. A full table goes through a loop, to the same digits.
    """
    sparse, full, x = np.eye(10), RANDOM.normal(size=(10, 10)), RANDOM.normal(size=(RUNS, 10))
    assert explain(lambda n, x: (n * sparse) @ x, 2, x[0]) == "22 operations"
    with jax.enable_x64(True):
        for table in (sparse, full):
            scaled = over_runs(lambda n, x, table=table: (n * table) @ x, np.full(RUNS, 2), x)
            np.testing.assert_allclose(scaled, x @ (2.0 * table).T, rtol=1e-14, atol=1e-14)


def test_of_a_product_by_a_long_known_matrix_its_zeros_are_left_out():
    """G x, and sum_ab T_ijab x_a x_b, of 40 outputs on their own: 40 entries that are read and one product each."""
    gain, spread = np.diag(np.arange(1.0, 41.0)), np.zeros((40, 40, 41, 41))
    spread[(np.arange(40),) * 4] = 2.0
    x = RANDOM.normal(size=(RUNS, 40))

    def moment(x):
        y = jax.numpy.append(x, 1.0)
        return jax.numpy.einsum("ijab,ab->ij", spread, y[:, None] * y)

    assert explain(lambda x: gain @ x, x[0]) == "79 operations"  # of the first the product by 1 is none
    assert explain(moment, x[0]) == "120 operations"
    with jax.enable_x64(True):
        np.testing.assert_allclose(over_runs(lambda x: gain @ x, x), x @ gain, rtol=0)
        np.testing.assert_allclose(over_runs(moment, x), [np.diag(2 * y * y) for y in x], rtol=1e-15)


def test_a_sum_over_all_entries_of_long_arrays_is_accumulated():
    """Arrays that are not loaded whole, (65, 65): to rounding of 4,225 terms of size 1, whose sum is some 65."""
    table = np.random.default_rng(1).normal(size=(65, 65))

    def total(x):
        square = x[:, None] * x[None]
        return jax.numpy.einsum("ab,ab->", table, square), jax.numpy.vdot(square, square)

    data = np.random.default_rng(2).normal(size=(3, 65))
    with jax.enable_x64(True):
        computed = over_runs(total, data)
        expected = [[x @ table @ x for x in data], [(x @ x) ** 2 for x in data]]
    np.testing.assert_allclose(computed, expected, rtol=1e-12)
