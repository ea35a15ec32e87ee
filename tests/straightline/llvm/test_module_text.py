"""What all runs share is where the function of blocks reads it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

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
