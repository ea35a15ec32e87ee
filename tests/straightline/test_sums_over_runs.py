"""Results summed over runs by batch, others run by run, what all runs share once; what is known not to be missing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from straightline import present
from straightline.lowering import list_nodes
from straightline.machine_code import MachineCode
from straightline.program import SummedOutputs, fold_rows_into_batches, lower_function, row_length_of_sums
from straightline.sums_over_runs import SummingProgram

BATCHES, STEPS = 50, 4


def walk(start, number):
    """Squares of a walk (time,), the walk itself, and a table that no run changes."""

    def step(x, k):
        x = x + number.astype(float) * k
        return x, (x * x, x)

    squares, positions = jax.lax.scan(step, start, jnp.arange(STEPS))[1]
    return squares, positions, jnp.arange(3.0) * start


@pytest.fixture(scope="module")
def begun():
    with jax.enable_x64(True):
        program = lower_function(walk, np.float64(0), np.uint32(0))
    return SummingProgram(program, SummedOutputs((True, False, False), BATCHES, 1)).bind_arguments(
        [np.float64(2.0)], 40
    )


def expected(runs):
    positions = 2.0 + runs[:, None] * np.cumsum(np.arange(STEPS))
    squares = np.stack([np.bincount(runs % BATCHES, row, BATCHES) for row in positions.T**2])
    return squares, positions


@pytest.mark.parametrize("count", [1, 16, 33, 480])
def test_runs_are_added_to_their_batches(begun, count):
    """From any first run on, also where a block of lanes is not full or goes around the last batch."""
    for first in (0, 32, 96):
        runs, sums = np.arange(first, first + count), begun.make_zero_sums()
        collected = begun.add_runs(runs, sums)
        squares, positions = expected(runs)
        np.testing.assert_allclose(fold_rows_into_batches(sums[0], BATCHES), squares, rtol=1e-14)
        np.testing.assert_array_equal(collected[1], positions)
        assert collected[0] is None and collected[2] is None
    np.testing.assert_array_equal(begun.shared[2], [0.0, 2.0, 4.0])
    assert begun.shared[0] is None


def test_sums_go_on(begun):
    sums = begun.make_zero_sums()
    for start in range(0, 320, 32):
        begun.add_runs(np.arange(start, start + 32), sums)
    np.testing.assert_allclose(fold_rows_into_batches(sums[0], BATCHES), expected(np.arange(320))[0], rtol=1e-14)


def test_sums_have_the_same_bits_whatever_the_number_of_runs_in_a_vector():
    """Each run adds to the same place of a row, also beyond the last batch: code in haste has narrower vectors."""

    def uneven(start, number):
        return (jnp.exp(jnp.sin(start + 0.1 * number)),)

    with jax.enable_x64(True):
        program = lower_function(uneven, np.float64(0), np.uint32(0))
    code = SummingProgram(program, SummedOutputs((True,), BATCHES, 1)).bind_arguments([np.float64(2.0)], 40)
    results = []
    for width in (1, 2, 4, 8):
        code._machine, sums = MachineCode(code.program.code.blocks, 0, width), code.make_zero_sums()
        for start, count in ((0, 37), (37, 120), (160, 53)):
            code.add_runs(np.arange(start, start + count), sums)
        results.append(sums[0])
    assert results[0][BATCHES:].any()
    for result in results[1:]:
        np.testing.assert_array_equal(result, results[0])


def test_rows_are_folded_once():
    row = np.arange(row_length_of_sums(16, BATCHES), dtype=float)
    np.testing.assert_array_equal(
        fold_rows_into_batches(row, BATCHES), np.where(np.arange(50) < 15, 2 * row[:50] + 50, row[:50])
    )


def test_a_sum_of_what_is_used_again():
    """Its memory holds sums, which are not read as one run's numbers: refused, or computed beside them."""

    def twice(start, number):
        squares = walk(start, number)[0]
        return squares, jax.lax.scan(lambda total, x: (total + x, total), 0.0, squares)[1]

    with jax.enable_x64(True):
        program = lower_function(twice, np.float64(0), np.uint32(0))
    code, runs = (
        SummingProgram(program, SummedOutputs((True, False), BATCHES, 1)).bind_arguments([np.float64(2.0)], 40),
        np.arange(40),
    )
    sums = code.make_zero_sums()
    squares, positions = expected(runs)
    before = np.cumsum(positions**2, axis=1) - positions**2
    np.testing.assert_allclose(code.add_runs(runs, sums)[1], before, rtol=1e-14)
    np.testing.assert_allclose(fold_rows_into_batches(sums[0], BATCHES), squares, rtol=1e-14)


def test_what_has_arrived_is_never_requested():
    def filled(x):
        return jnp.where(jnp.isnan(x), 0.0, 2 * x), jnp.where(jnp.isnan(present(x)), 0.0, 3 * x)

    program = lower_function(filled, np.zeros(2))
    asking, plain = ([node.op for node in list_nodes(output)] for output in program.outputs)
    assert asking == ["select", "select"] and plain == ["mul", "mul"]
    np.testing.assert_array_equal(jax.jit(jax.vmap(present))(np.array([1.0, np.nan])), [1.0, np.nan])
