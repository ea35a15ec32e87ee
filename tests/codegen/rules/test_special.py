"""Incomplete gamma functions against SciPy, over nine decades of the argument."""

import jax
import numpy as np
import pytest
from scipy import special

from heliograph.codegen.engine import chosen


def masses(a, x):
    return jax.scipy.special.gammainc(a, x), jax.scipy.special.gammaincc(a, x)


def computed(a, x):
    """P and Q of each run's shape and argument, by native code."""
    choice = chosen(masses, (np.asarray(a), np.asarray(x)), [True, True])
    assert choice.code is not None, choice.why
    return choice.results()


def test_masses_below_and_above_are_scipys():
    shapes = np.geomspace(0.05, 500, 40)
    a, x = map(np.ravel, np.meshgrid(shapes, np.geomspace(1e-6, 30, 60)))
    x = a * x
    p, q = computed(a, x)
    # The exponent of x^a e^-x / Gamma(a) has terms up to 1,500 at these shapes: 1e-12 are some 4 of their roundings.
    np.testing.assert_allclose(p, special.gammainc(a, x), rtol=1e-12, atol=1e-300)
    np.testing.assert_allclose(q, special.gammaincc(a, x), rtol=1e-12, atol=1e-300)


@pytest.mark.parametrize(
    ("a", "x", "p"),
    [(1.0, 0.0, 0.0), (1.0, np.inf, 1.0), (-1.0, 1.0, np.nan), (1.0, -1.0, np.nan), (np.nan, 1.0, np.nan)],
)
def test_at_the_ends_and_beyond(a, x, p):
    both = computed([a], [x])
    np.testing.assert_array_equal([both[0][0], both[1][0]], [p, 1 - p])
