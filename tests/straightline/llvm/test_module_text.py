"""What all runs share is where the function of blocks reads it."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import straightline
from tests.straightline.over_runs import over_runs

RANDOM = np.random.default_rng(0)
TABLES, STATES, PLACES = RANDOM.normal(size=(30, 9, 9)), RANDOM.normal(size=(5, 9)), np.arange(5)


def products(tables, x, at):
    """Products with a matrix of each step that all runs share, too long to be nodes."""

    def turn(x, table):
        x = jnp.tanh(jnp.sin(table) @ x)
        return x, x

    return jax.lax.scan(turn, x, tables)[1]


def rows(tables, x, at):
    """Rows of such a matrix, by a place that differs between runs."""

    def turn(x, table):
        sines = jnp.sin(table)
        x = jnp.tanh(sines @ x) + sines[at % 9]
        return x, x

    return jax.lax.scan(turn, x, tables)[1]


def guarded(tables, x, at):
    """Products where some runs need them."""

    def turn(x, table):
        sines = jnp.sin(table)
        x = jax.lax.cond(x[0] > 0, lambda: jnp.tanh(sines @ (sines @ (sines @ x))), lambda: x - 1.0)
        return x, x

    return jax.lax.scan(turn, x, tables)[1]


@pytest.mark.parametrize("function", [products, rows, guarded], ids=lambda f: f.__name__)
def test_what_runs_share_in_a_loop_is_that_of_each_turn(function):
    """Of each row of the tables, not of the last; sums of nine products differ by their order: 30 steps, 1e-12."""
    with jax.enable_x64(True):
        computed = over_runs(function, TABLES, STATES, PLACES, shared=[0])
        expected = np.stack([jax.jit(function)(TABLES, x, at) for x, at in zip(STATES, PLACES, strict=True)])
    assert np.max(np.abs(computed - expected)) < 1e-12


def counted(x):
    """Turns of 1,500 lines, with a guard of as many."""

    def turn(x, _):
        x = x @ x @ x / 50.0
        return jax.lax.cond(x[0, 0] > 0, lambda: x @ x @ x + 1.0, lambda: x + 1.0), x[0]

    return jax.lax.scan(turn, x, None, 3)


def conditional(x):
    """Turns of as many lines until a number is large, which runs reach at different times."""
    return jax.lax.while_loop(lambda x: x[0, 0] < 9.0, lambda x: jnp.abs(x @ x @ x) / 9.0 + x, x)


@pytest.mark.parametrize("function", [counted, conditional], ids=lambda f: f.__name__)
def test_long_turns_are_written_in_several_basic_blocks(function):
    """Of 500 lines at most, and one statement's: LLVM's time grows faster than their number. Results are XLA's."""
    x = np.random.default_rng(1).uniform(0.5, 1.5, size=(5, 9, 9)) * np.array([1.0, -1.0, 1.0, 0.5, 0.1])[:, None, None]
    x[1] = -x[1] if function is conditional else x[1]
    with jax.enable_x64(True):
        code = straightline.compile(function, x[0])
        computed, expected = code(x), jax.vmap(function)(x)
    lengths = [part.count("\n") for part in re.split(r"\n[\w.]+:\n", code.code.blocks.text(4))]
    assert 400 < max(lengths) < 600 and len(lengths) > 6
    # Sums of nine products by fused operations, some twenty one after another.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11), computed, expected)
