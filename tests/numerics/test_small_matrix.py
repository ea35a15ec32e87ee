"""Factors and solves under `vmap`: numbers of the library, whatever axes are mapped, and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heliograph.numerics import cholesky, psd_solve

RUNS, NODES = 5, 3
ROUNDING = 1e-12  # of a few hundred operations on well conditioned matrices


def psd(*shape):
    a = np.random.default_rng(1).normal(size=shape)
    return a @ np.swapaxes(a, -1, -2) + np.eye(shape[-1])


def nested(function, *args):
    """Over nodes within runs, in double precision."""
    with jax.enable_x64(True):
        return np.asarray(jax.jit(jax.vmap(jax.vmap(function)))(*args))


@pytest.mark.parametrize("n", [1, 4, 26])
def test_nested_maps_give_what_the_library_gives(n):
    a, b = psd(RUNS, NODES, n, n), np.random.default_rng(2).normal(size=(RUNS, NODES, n, 2))
    np.testing.assert_allclose(nested(cholesky, a), np.linalg.cholesky(a), atol=ROUNDING * np.abs(a).max())
    np.testing.assert_allclose(nested(psd_solve, a, b), np.linalg.solve(a, b), atol=1e3 * ROUNDING)


def test_both_kinds_of_derivatives_pass_through():
    a, b = psd(3, 3), np.ones((3, 1))

    def trace(a):
        return psd_solve(a, jnp.asarray(b)).sum()

    x = np.linalg.solve(a, b)
    with jax.enable_x64(True):
        forward, backward = jax.jit(lambda a: (jax.jacfwd(trace)(a), jax.grad(trace)(a)))(jnp.asarray(a))
    # d 1' A^-1 1 = -x' dA x; the factor reads the lower half only, so compare what a symmetric dA sees.
    for item in (forward, backward):
        np.testing.assert_allclose(item + item.T, -2 * x @ x.T, atol=1e3 * ROUNDING)


def test_a_run_without_a_factor_leaves_the_others_alone():
    a = np.stack([-np.eye(2), np.full((2, 2), np.nan), np.full((2, 2), np.inf), 4 * np.eye(2)])
    with jax.enable_x64(True):
        factors = np.asarray(jax.jit(jax.vmap(cholesky))(a))
    assert np.isnan(factors[:3]).any(axis=(1, 2)).all()
    np.testing.assert_array_equal(factors[3], 2 * np.eye(2))


def test_single_precision_stays_single():
    assert jax.jit(jax.vmap(cholesky))(np.eye(2, dtype=np.float32)[None]).dtype == np.float32


@pytest.mark.slow
def test_less_than_nothing_by_the_rounding_of_several_products_is_nothing():
    """A determinant of -5e-6 is forty units of single precision, as of a tied prior moved four steps.

    In double precision it is no rounding, and the matrix is indefinite.
    """
    a = np.array([[1.0, 1.0], [1.0, 1.0 - 5e-6]])
    with jax.enable_x64(True):
        single, double = cholesky(jnp.asarray(a, jnp.float32)), cholesky(jnp.asarray(a))
    np.testing.assert_array_equal(single, [[1.0, 0.0], [1.0, 0.0]])
    assert np.isnan(double[1, 1])
