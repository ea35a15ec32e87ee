"""Arrays of runs reach the lanes and come back, whatever their length, type and count."""

import jax
import numpy as np
import pytest

import straightline


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.uint32, np.int64, np.bool_])
def test_rows_of_every_length_come_back_in_order(kind):
    """Rows of few numbers are moved as registers, longer ones in squares, the last ones and a part of a block alone."""
    random = np.random.default_rng(0)
    for size in (1, 2, 3, 5, 7, 8, 9, 16, 19):
        with jax.enable_x64(True):
            code = straightline.compile(lambda x: (x[::-1], x), np.zeros(size, kind))
        for runs in (1, 5, 8, 15, 16, 33):
            x = (100 * random.normal(size=(runs, size))).astype(kind)
            backwards, same = code(x)
            np.testing.assert_array_equal(backwards, x[:, ::-1])
            np.testing.assert_array_equal(same, x)


@pytest.mark.parametrize("few", [1, 2, 3, 6])
def test_a_run_is_the_same_among_any_others(few):
    """Also beside floats of which most of the work is, with twice as many runs in a vector."""

    def draw(key, x):
        return x + jax.random.normal(key, x.shape, np.float32).astype(float)

    with jax.enable_x64(True):
        code = straightline.compile(draw, np.zeros(2, np.uint32), np.zeros(few))
    keys = np.random.default_rng(1).integers(2**32, size=(37, 2), dtype=np.uint32)
    x = np.random.default_rng(2).normal(size=(37, few))
    whole = code(keys, x)
    for runs in (1, 9, 17, 36):
        np.testing.assert_array_equal(code(keys[-runs:], x[-runs:]), whole[-runs:])
