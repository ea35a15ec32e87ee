"""A block's longest loop asks for the inputs of the next block and for the memory of its own outputs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from straightline.compiled import compile
from straightline.llvm.memory_layout import WIDEST

TURNS = 1200  # of so many a loop stays one
SUMS = jax.ShapeDtypeStruct((TURNS, 2), np.float64)


def sums_of(rows):
    """Both sums of each row, times 12 by additions, with those before it."""

    def turn(before, row):
        after = before + sum([row] * 11, row)
        return after, after

    return jax.lax.scan(turn, jnp.zeros(2), rows)[1]


def requests(code):
    """Requests of a turn: of what is read, of what is written."""
    lines = [line for line in code.code.blocks.text(WIDEST).splitlines() if "@llvm.prefetch" in line]
    return sum("i32 0, i32 2" in line for line in lines), sum("i32 1, i32 2" in line for line in lines)


def test_a_turn_asks_for_its_share_of_the_lines():
    """Two numbers of eight runs are two lines of 64 bytes, of the input and of the output."""
    assert requests(compile(sums_of, SUMS)) == (2, 2)


@pytest.mark.parametrize("runs", [1, WIDEST - 1, WIDEST, 5 * WIDEST + 3])
def test_the_last_block_asks_beyond_the_end_of_memory_and_nothing_changes(runs):
    """A request is no access: there is no next block, and the sums are NumPy's, to the bit."""
    rows = np.random.default_rng(1).normal(size=(runs, TURNS, 2))
    assert np.array_equal(compile(sums_of, SUMS)(rows), np.cumsum(sum([rows] * 11, rows), axis=1))


def test_a_short_loop_asks_for_nothing():
    """Of a thousand numbers a turn its share is a thousand lines: moving them takes as long as their memory."""

    def totals(rows):
        return jax.lax.scan(lambda before, row: (before + row, before + row), jnp.zeros(1000), rows)[1]

    assert requests(compile(totals, jax.ShapeDtypeStruct((3, 1000), np.float64))) == (0, 0)


def test_results_begin_at_a_line_of_memory():
    rows = np.zeros((3, TURNS, 2))
    assert all(compile(sums_of, SUMS)(rows).ctypes.data % 64 == 0 for _ in range(5))
