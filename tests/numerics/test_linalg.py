import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from heliograph.numerics import cholesky, diagonal, psd_solve, where

WRITTEN = 24  # rows up to which a matrix is written out
FACTOR = jax.jit(cholesky)


def psd(seed, n, rank=None):
    a = np.random.default_rng(seed).normal(size=(n, rank or n))
    return a @ a.T


@pytest.mark.parametrize("n", [1, 3, WRITTEN, WRITTEN + 3])
def test_factor_is_the_librarys(n):
    a = psd(n, n)
    with jax.enable_x64(True):
        np.testing.assert_allclose(cholesky(jnp.asarray(a)), np.linalg.cholesky(a), atol=1e-11 * np.abs(a).max())


@given(seed=st.integers(0, 500), n=st.sampled_from([2, 4, 10]), rank=st.integers(1, 2))
def test_singular_matrices_have_a_factor(seed, n, rank):
    a = psd(seed, n, 1)
    a[:rank] = 0.0
    a[:, :rank] = 0.0
    with jax.enable_x64(True):
        factor = np.asarray(FACTOR(jnp.asarray(a)))
    np.testing.assert_allclose(factor @ factor.T, a, atol=1e-10 * max(np.abs(a).max(), 1e-300))


def test_zero_has_the_zero_factor_and_indefinite_has_none():
    with jax.enable_x64(True):
        assert not np.any(cholesky(jnp.zeros((3, 3))))
        assert np.any(np.isnan(cholesky(jnp.asarray([[1.0, 2.0], [2.0, 1.0]]))))


@pytest.mark.parametrize("n", [1, 4, WRITTEN + 2])
def test_solve(n):
    a, b = psd(n, n) + np.eye(n), np.random.default_rng(0).normal(size=(n, 3))
    with jax.enable_x64(True):
        np.testing.assert_allclose(psd_solve(jnp.asarray(a), jnp.asarray(b)), np.linalg.solve(a, b), rtol=1e-9)


@pytest.mark.parametrize("n", [3, 5])
def test_a_component_known_exactly_leaves_the_derivatives_of_the_others(n):
    """A = diag(B(p), 0): the factor is that of B, and so is its derivative, though the root has none at 0."""
    b = np.eye(n - 1) + 0.3

    def factor(p):
        return cholesky(jnp.zeros((n, n)).at[:-1, :-1].set(p * b))

    with jax.enable_x64(True):
        slopes = jax.jit(lambda p: [jac(factor)(p) for jac in (jax.jacrev, jax.jacfwd)])(2.0)
    expected = np.zeros((n, n))
    expected[:-1, :-1] = np.linalg.cholesky(2.0 * b) / 4
    for slope in slopes:
        np.testing.assert_allclose(slope, expected, atol=1e-13)


@pytest.mark.parametrize("n", [0, 1, 3])
def test_the_diagonal_is_that_of_numpy(n):
    a = np.arange(float(n * n)).reshape(n, n)
    with jax.enable_x64(True):
        assert diagonal(a).tolist() == np.diagonal(a).tolist()


@pytest.mark.parametrize("double", [True, False])
def test_where_is_that_of_jax_in_fewer_operations(double):
    """Shapes are broadcast and types promoted as there; in a trace nothing is a function of its own."""
    rows = np.arange(6.0).reshape(2, 3)
    with jax.enable_x64(double):
        for condition, a, b in [
            (rows > 2, rows, 0.0),
            (rows[:, :1] > 2, jnp.nan, jnp.asarray(rows)),
            (np.array([True, False, True]), jnp.asarray(rows, np.float32), -1.0),
            (True, rows[0], rows),
            (rows > 2, jnp.asarray(rows, np.float32), jnp.asarray(rows)),
            (rows > 2, np.arange(3), 2),
        ]:
            expected, found = jnp.where(condition, a, b), where(condition, a, b)
            assert (found.shape, found.dtype) == (expected.shape, expected.dtype)
            np.testing.assert_array_equal(found, expected)
        traced = jax.make_jaxpr(lambda condition: where(condition, rows, 0.0))(np.ones(3, bool))
    names = {equation.primitive.name for equation in traced.eqns}
    assert names <= {"broadcast_in_dim", "select_n"}
