"""Loops that carry arrays too long for numbers of their own: they are carried in memory."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from straightline import compile
from straightline.size_limits import WRITTEN_OUT

SIDE = 46
RUNS = 9
assert SIDE**2 > WRITTEN_OUT

MATRICES = np.random.default_rng(3).normal(size=(2, RUNS, SIDE, SIDE))


def eliminated(a, b):
    """Some steps of an elimination, row after row, of rows that the turns before changed; b goes along, transposed."""

    def turn(j, carry):
        a, b = carry
        return a - jnp.outer(a[:, j], a[j]) * 0.01, b.T + a[j]

    return jax.lax.fori_loop(0, 5, turn, (a, b))


def exchanged(a, b):
    """Two arrays that change places: each is read before either is filled."""
    return jax.lax.fori_loop(0, 3, lambda j, carry: (carry[1], 2 * carry[0]), (a, b))


def repeated(a, b):
    """A loop in a loop: the inner one begins anew in each turn of the outer one, from what that carries."""

    def turn(a, row):
        a = jax.lax.fori_loop(0, 3, lambda j, x: x + jnp.outer(x[:, j], row) * 0.01, a)
        return a, a[1, 2]

    return jax.lax.scan(turn, a, b[:4])


def beside(a, b):
    """A carried array that is changed by each turn of another one: of what runs share, a turn's numbers are needed."""

    def turn(j, carry):
        a, b = carry
        return a - jnp.outer(a[:, j], a[j]) * 0.01, b + a[j] * b[j][0] + a[:, 3]

    return jax.lax.fori_loop(0, 5, turn, (a, b))


def after(a, b):
    """What only the end of a loop decides."""
    return jax.lax.fori_loop(0, 5, lambda j, a: a - jnp.outer(a[:, j], a[j]) * 0.01, a) @ b[0]


@pytest.mark.parametrize("function", [eliminated, exchanged, repeated, beside, after])
@pytest.mark.parametrize("shared", [(), (0,)])
def test_a_long_array_is_carried_in_memory(function, shared):
    """As JAX computes it, to the rounding of some products; also where all runs share what the loop begins with."""
    a, b = MATRICES
    a = a[0] if shared else a
    with jax.enable_x64(True):
        expected = jax.vmap(function, (None if shared else 0, 0))(a, b)
    ours = compile(function, MATRICES[0, 0], MATRICES[1, 0], shared=shared)(a, b)
    for x, y in zip(jax.tree.leaves(ours), jax.tree.leaves(expected), strict=True):
        assert np.allclose(x, np.asarray(y), rtol=0, atol=1e-14 * np.abs(x).max())


def test_what_all_runs_share_is_computed_once():
    """The loop of an array that all share, however its turns change it; a run has a product with a vector left."""
    alone, shared = (compile(after, *MATRICES[:, 0], shared=shared).code for shared in ((), (0,)))
    assert shared.blocks.work < 3 * SIDE**2 < alone.blocks.work / 10


def test_a_product_of_many_terms_is_a_loop_over_rows():
    """Of 60 x 60 matrices, 216,000 terms: more than a whole program may have, as numbers of their own."""
    draws = np.random.default_rng(4).normal(size=(2, 3, 60))

    def function(x, y):
        return jnp.outer(x, jnp.cos(y)) @ jnp.outer(y, x + 1) @ jnp.sin(jnp.outer(x, y))

    code = compile(function, draws[0, 0], draws[1, 0])
    with jax.enable_x64(True):
        expected = np.asarray(jax.vmap(function)(*draws))
    assert code.operations < 60_000
    assert np.allclose(code(*draws), expected, rtol=0, atol=1e-12 * np.abs(expected).max())
