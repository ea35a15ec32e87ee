"""Recursions over rows: one code for any number of them, with the numbers of JAX's scan."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import straightline as sl

RANDOM = np.random.default_rng(3)
FIXED = {"matrix": np.array([[0.9, 0.1], [0.0, 0.8]]), "start": np.array([1.0, -1.0])}
ROW = np.int64(0), np.zeros(2)


def begin(fixed):
    """Return a state and its moments."""
    return fixed["start"], jnp.zeros((2, 2))


def step(fixed, state, row):
    """Move the state; leave out what is missing of the row."""
    (x, moments), (number, z) = state, row
    moved = fixed["matrix"] @ x + jnp.where(jnp.isnan(z), 0.0, z)
    after = fixed["matrix"] @ moments @ fixed["matrix"].T + jnp.eye(2)
    return (moved, after), {"state": moved, "moments": after, "twice": 2 * number, "empty": jnp.zeros(0)}


@pytest.mark.parametrize("rows", [1, 2, 3, 200, 3001])
def test_any_number_of_rows_is_computed_by_one_code(rows):
    """In double precision, with the shapes and types of JAX's scan; equal but for the order of sums of two terms."""
    z = RANDOM.normal(size=(rows, 2))
    z[rows // 2, 0] = np.nan
    arguments = np.arange(rows), z
    with jax.enable_x64(True):
        expected = jax.lax.scan(
            lambda state, row: step(FIXED, state, row), tuple(map(jnp.asarray, begin(FIXED))), arguments
        )
    found = CODE(FIXED, arguments)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


def test_the_bits_of_a_row_do_not_depend_on_how_many_follow():
    arguments = np.arange(500), RANDOM.normal(size=(500, 2))
    _, outputs = CODE(FIXED, arguments)
    for rows in (1, 2, 77):
        last, first = CODE(FIXED, jax.tree.map(lambda x, rows=rows: x[:rows], arguments))
        jax.tree.map(lambda a, b, rows=rows: np.testing.assert_array_equal(a, b[:rows]), first, outputs)
        np.testing.assert_array_equal(last[0], outputs["state"][rows - 1])


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ((np.arange(3), np.zeros((4, 2))), r"array 3 of the arguments: expected shape \(3, 2\), got \(4, 2\)"),
        ((np.arange(3), np.zeros((3, 5))), r"array 3 of the arguments: expected shape \(3, 2\), got \(3, 5\)"),
        ((np.arange(0), np.zeros((0, 2))), "rows: expected one row or more, got none"),
        ((np.arange(3),), "arguments: expected 4 arrays, got 3"),
    ],
)
def test_rows_unlike_the_example_are_refused(rows, message):
    """Code reads memory as the examples say: other shapes would be read beyond their end."""
    with pytest.raises(ValueError, match=message):
        CODE(FIXED, rows)


def test_an_output_that_is_the_row_itself_is_refused():
    """It would be copied in a loop that knows how many rows there are."""
    with pytest.raises(sl.Unsupported, match="an output is a row itself"):
        sl.compile_scan(lambda fixed: fixed, lambda fixed, state, row: (state + row, row), np.zeros(2), np.zeros(2))


def test_what_is_not_taken_is_refused_with_its_line():
    with pytest.raises(sl.Unsupported, match=r"svd at .*test_scan_over_rows.py:\d+"):
        sl.compile_scan(
            lambda fixed: fixed, lambda fixed, state, row: (state, jnp.linalg.svd(row)[1]), np.zeros(2), np.eye(2)
        )
    with pytest.raises(sl.Unsupported, match="a program of more than 3 operations"):
        sl.compile_scan(begin, step, FIXED, ROW, most=3)


CODE = sl.compile_scan(begin, step, FIXED, ROW)
