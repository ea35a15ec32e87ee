import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from heliograph.random_affine.moments import (
    count_monomials,
    evaluate_monomials,
    list_exponents,
    multiply_polynomials,
    position,
    symmetric_power,
)

EXACT = 1e-12  # relative: products of at most four numbers, each rounded once


def test_degree_one_is_the_vector_itself():
    y = np.array([2.0, 3.0])
    assert np.array_equal(evaluate_monomials(y, 1), [2.0, 3.0, 1.0])


def test_degree_two_in_order():
    assert np.array_equal(evaluate_monomials(np.array([2.0, 3.0]), 2), [4.0, 6.0, 2.0, 9.0, 3.0, 1.0])


@pytest.mark.parametrize(("variables", "degree"), [(1, 4), (3, 2), (4, 3), (5, 4)])
def test_count_and_positions(variables, degree):
    assert len(list_exponents(variables, degree)) == count_monomials(variables, degree)
    assert all(list_exponents(variables, degree)[i] == p for p, i in position(variables, degree).items())


@given(seed=st.integers(0, 1000), degree=st.integers(1, 4), rows=st.integers(1, 3), columns=st.integers(1, 3))
def test_symmetric_power_maps_monomials(seed, degree, rows, columns):
    rng = np.random.default_rng(seed)
    h = np.zeros((rows + 1, columns + 1))
    h[:-1] = rng.normal(size=(rows, columns + 1))
    h[-1, -1] = 1.0
    y = rng.normal(size=columns)
    z = h[:-1] @ np.append(y, 1.0)
    np.testing.assert_allclose(
        symmetric_power(h, degree) @ evaluate_monomials(y, degree), evaluate_monomials(z, degree), rtol=1e-9, atol=1e-9
    )  # sums of up to 70 products that may cancel


@given(seed=st.integers(0, 1000), degree=st.integers(1, 4))
def test_symmetric_power_of_a_product(seed, degree):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(3, 4)), rng.normal(size=(4, 2))
    left, right = symmetric_power(a @ b, degree), symmetric_power(a, degree) @ symmetric_power(b, degree)
    np.testing.assert_allclose(left, right, rtol=1e-9, atol=1e-9 * np.abs(left).max())


def test_jax_and_numpy_agree():
    h = np.random.default_rng(0).normal(size=(3, 3))
    with jax.enable_x64(True):
        np.testing.assert_allclose(jax.jit(lambda a: symmetric_power(a, 3))(h), symmetric_power(h, 3), rtol=EXACT)


def test_multiply_is_the_product_of_values():
    rng = np.random.default_rng(1)
    a, b, y = rng.normal(size=count_monomials(3, 2)), rng.normal(size=count_monomials(3, 1)), rng.normal(size=2)
    value = multiply_polynomials(a, 2, b, 1, 3) @ evaluate_monomials(y, 3)
    np.testing.assert_allclose(value, (a @ evaluate_monomials(y, 2)) * (b @ evaluate_monomials(y, 1)), rtol=1e-10)


def test_a_lift_that_is_too_large_names_its_size():
    with pytest.raises(ValueError, match=r"moments of order 4.*4,\d\d\d,\d\d\d,\d\d\d entries"):
        symmetric_power(np.eye(34), 4)
