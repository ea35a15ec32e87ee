"""Arithmetic on long arrays in memory, row by row."""

import jax
import numpy as np
import pytest

from heliograph.codegen.engine import chosen

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
        computed = chosen(function, [COVARIANCES, APART], [True, True]).results()
        expected = np.stack(
            [function(p, a) for p, a in zip(*map(jax.numpy.asarray, (COVARIANCES, APART)), strict=True)]
        )
    assert np.max(np.abs(computed - expected)) < 1e-14
