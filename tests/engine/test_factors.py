"""Eigenvalues and factors of small matrices that are written out entry by entry."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from heliograph.filters import gaussian_innovation
from heliograph.numerics import cholesky, psd_solve
from straightline.compiled import compile

RANDOM = np.random.default_rng(6)


@pytest.mark.parametrize("n", [1, 2, 3, 6, 9, pytest.param(20, marks=pytest.mark.slow)])
def test_eigenvalues_are_those_of_the_library(n):
    """To rounding of the largest; also where scales differ by ten decades, of equal eigenvalues and of zero."""
    a = RANDOM.normal(size=(20, n, n))
    a = a @ a.transpose(0, 2, 1)
    scales = 10.0 ** RANDOM.uniform(-5, 5, size=(20, n))
    a[10:] *= scales[10:, :, None] * scales[10:, None]
    a[0], a[1] = np.eye(n), 0.0
    values, vectors = compile(lambda a: tuple(jnp.linalg.eigh(a)), a[0])(a)
    size = np.linalg.norm(a, axis=(1, 2))[:, None]
    assert np.all(np.diff(values, axis=1) >= 0)
    assert np.max(np.abs(values - np.linalg.eigvalsh(a)) / (size + 1e-300)) < 1e-14
    again = np.einsum("rij,rj,rkj->rik", vectors, values, vectors)
    assert np.max(np.abs(again - a) / (size[..., None] + 1e-300)) < 1e-14
    turned = np.einsum("rij,rik->rjk", vectors, vectors)
    assert np.max(np.abs(turned - np.eye(n))) < 1e-14


def test_eigenvalues_of_what_is_no_number_are_none():
    a = np.array([[[1.0, np.nan], [np.nan, 2.0]], [[1.0, 0.5], [0.5, 2.0]]])
    values, vectors = compile(lambda a: tuple(jnp.linalg.eigh(a)), a[0])(a)
    assert np.isnan(values[0]).all() and np.isnan(vectors[0]).all() and np.isfinite(values[1]).all()


@pytest.mark.parametrize("scale", [2.0**900, 2.0**-900, 2.0**-1040])
def test_eigenvalues_of_huge_and_tiny_matrices_are_those_of_the_matrix_in_other_units(scale):
    """Whose squares overflow or vanish; a power of two is exact, but for entries that are subnormal numbers then."""
    a = np.array([[[6.0, 2.0, 1.0], [2.0, 5.0, 3.0], [1.0, 3.0, 4.0]]])
    values, vectors = compile(lambda a: tuple(jnp.linalg.eigh(a)), a[0])(scale * a)
    expected, others = compile(lambda a: tuple(jnp.linalg.eigh(a)), a[0])(a)
    np.testing.assert_allclose(values / scale, expected, rtol=4e-16 if scale > 2.0**-1000 else 1e-9)
    np.testing.assert_allclose(vectors, others, rtol=1e-15)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_systems_are_solved_with_the_largest_entry_first(n):
    """Also where the first entry of a column is zero; to rounding times the matrix's condition."""
    a, b = RANDOM.normal(size=(20, n, n)), RANDOM.normal(size=(20, n, 2))
    if n > 1:
        a[:, 0, 0] = 0.0
    x, determinant = compile(lambda a, b: (jnp.linalg.solve(a, b), jnp.linalg.det(a)), a[0], b[0])(a, b)
    limit = 1e-15 * 10 * n * np.linalg.cond(a)[:, None, None]
    expected = np.linalg.solve(a, b)
    assert np.all(np.abs(x - expected) <= limit * np.abs(expected).max(axis=(1, 2), keepdims=True))
    np.testing.assert_allclose(determinant, np.linalg.det(a), rtol=1e-12)


@pytest.mark.parametrize("n", [1, 5, pytest.param(27, marks=pytest.mark.slow)])
def test_definite_systems_roots_and_densities_are_those_of_the_library(n):
    """Also of matrices that XLA factors in a loop over columns; to rounding times the matrix's condition."""
    a, b = RANDOM.normal(size=(20, n, n)), RANDOM.normal(size=(20, n, 2))
    a = a @ a.transpose(0, 2, 1) + np.eye(n)

    def single(a, b):
        return psd_solve(a, b), cholesky(a), gaussian_innovation(b[:, 0], jnp.zeros(n), a).log_likelihood

    x, root, density = compile(single, a[0], b[0])(a, b)
    limit = 1e-15 * 10 * n * np.linalg.cond(a)[:, None, None]
    assert np.all(np.abs(x - np.linalg.solve(a, b)) <= limit * np.abs(x).max(axis=(1, 2), keepdims=True))
    assert np.all(np.abs(root @ root.transpose(0, 2, 1) - a) <= limit * np.abs(a).max(axis=(1, 2), keepdims=True))
    expected = [multivariate_normal(np.zeros(n), a).logpdf(b[:, 0]) for a, b in zip(a, b, strict=True)]
    np.testing.assert_allclose(density, expected, rtol=1e-12 * n)


def test_products_of_long_arrays_are_those_of_the_library():
    """By a loop over the left or the right argument's rows, or to one number."""
    a, b, v = RANDOM.normal(size=(4, 17, 17)), RANDOM.normal(size=(4, 17, 17)), RANDOM.normal(size=(4, 17))
    products = compile(
        lambda a, b, v: (a @ b, v @ a, a @ v, jnp.sum(a * b), jnp.einsum("ij,ij", a, b)), a[0], b[0], v[0]
    )
    whole = np.einsum("rij,rij->r", a, b)
    expected = a @ b, np.einsum("ri,rij->rj", v, a), np.einsum("rij,rj->ri", a, v), whole, whole
    for x, y in zip(products(a, b, v), expected, strict=True):
        np.testing.assert_allclose(x, y, atol=1e-13 * 17)
