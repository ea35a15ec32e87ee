"""Known numbers and traced ones are distinguished wherever they stand."""

import jax
import numpy as np
import pytest
import scipy.linalg

from heliograph.numerics import block_diagonal, is_traced


@pytest.mark.parametrize("hold", [lambda x: x, lambda x: [1.0, x], lambda x: {"a": (np.ones(2), x)}])
def test_a_traced_number_is_found_where_it_stands(hold):
    results = []

    def requested(x):
        results.append((is_traced(np.ones(2), 3, hold(x)), is_traced(hold(2.0))))
        return x

    jax.make_jaxpr(requested)(1.0)
    assert results == [(True, False)]


@pytest.mark.parametrize(
    "value", [1, 2.0, True, np.float64(3), np.ones(2), None, "text", [1.0, np.ones(2)], (), iter([1.0])]
)
def test_what_is_known_is_not_traced(value):
    assert not is_traced(value)


def test_blocks_along_the_diagonal_are_those_of_scipy_known_and_traced():
    c = np.random.default_rng(0)
    blocks = [c.standard_normal(shape) for shape in ((2, 3), (1, 1), (0, 2), (3, 1))]
    expected = scipy.linalg.block_diag(*blocks)
    np.testing.assert_array_equal(block_diagonal(blocks), expected)
    np.testing.assert_array_equal(jax.jit(lambda *traced: block_diagonal(traced))(*blocks), expected.astype(np.float32))
