"""Known numbers and traced ones are distinguished wherever they stand."""

import jax
import numpy as np
import pytest

from heliograph.numerics.traced import is_traced


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
