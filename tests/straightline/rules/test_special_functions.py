"""Special functions against SciPy, over many decades of the argument."""

import jax
import numpy as np
import pytest
from scipy import special

from tests.straightline.over_runs import over_runs


def masses(a, x):
    return jax.scipy.special.gammainc(a, x), jax.scipy.special.gammaincc(a, x)


def computed(a, x):
    """P and Q of each run's shape and argument, by native code."""
    return over_runs(masses, np.asarray(a), np.asarray(x))


def test_masses_below_and_above_are_scipys():
    shapes = np.geomspace(0.05, 500, 40)
    a, x = map(np.ravel, np.meshgrid(shapes, np.geomspace(1e-6, 30, 60)))
    x = a * x
    p, q = computed(a, x)
    # The exponent of x^a e^-x / Gamma(a) has terms up to 1,500 at these shapes: 1e-12 are some 4 of their roundings.
    np.testing.assert_allclose(p, special.gammainc(a, x), rtol=1e-12, atol=1e-300)
    np.testing.assert_allclose(q, special.gammaincc(a, x), rtol=1e-12, atol=1e-300)


def test_masses_of_large_shapes_are_scipys_and_end():
    """Also where a series would take as many terms as the root of the shape; in both tails."""
    a = np.repeat([2001.0, 5e3, 1e5, 2.0**31, 1e10, 1e17], 9)
    x = a + np.tile([-30.0, -8.0, -2.0, -0.3, 0.0, 0.3, 2.0, 8.0, 30.0], 6) * np.sqrt(a)
    known = (a < 1e6) | (np.abs(x - a) < 3 * np.sqrt(a))  # SciPy's far tails of larger shapes have no digit
    a, x = a[known], x[known]
    p, q = computed(a, x)
    np.testing.assert_allclose(p, special.gammainc(a, x), rtol=1e-11, atol=1e-300)
    np.testing.assert_allclose(q, special.gammaincc(a, x), rtol=1e-11, atol=1e-300)


@pytest.mark.parametrize(
    ("a", "x", "p"),
    [(1.0, 0.0, 0.0), (1.0, np.inf, 1.0), (-1.0, 1.0, np.nan), (1.0, -1.0, np.nan), (np.nan, 1.0, np.nan)],
)
def test_at_the_ends_and_beyond(a, x, p):
    both = computed([a], [x])
    np.testing.assert_array_equal([both[0][0], both[1][0]], [p, 1 - p])


@pytest.mark.parametrize("name", ["i0e", "i1e", "digamma"])
def test_functions_of_one_number_are_scipys(name):
    """Bessel functions' series have up to 60 terms, each rounded: 2e-14; where digamma is 0 an error of 1e-15 is left.

    By its poles SciPy's is off by 1e-13, against the recurrence from beyond them.
    """
    zero = [] if name == "digamma" else [0.0]  # a pole, at which JAX has NaN
    x = np.concatenate([zero, np.geomspace(1e-8, 1e8, 400), [29.9999, 30.0, 30.0001, 1.4616321449683622]])
    for sign in (1, -1):
        values = over_runs(getattr(jax.scipy.special, name), sign * x)
        rtol = 3e-13 if sign < 0 and name == "digamma" else 2e-14
        np.testing.assert_allclose(values, getattr(special, name)(sign * x), rtol=rtol, atol=1e-15)


@pytest.mark.parametrize("name", ["i0e", "i1e"])
def test_scaled_bessel_functions_keep_their_tails_where_two_pi_x_overflows(name):
    """1 / root(2 pi x) to the end of the doubles, and 0 beyond it."""
    x = np.array([1e20, 1e300, 1e308, np.finfo(float).max, np.inf])
    values = over_runs(getattr(jax.scipy.special, name), x)
    np.testing.assert_allclose(values, [*(1 / np.sqrt(2 * np.pi) / np.sqrt(x[:4])), 0.0], rtol=1e-14)
