"""Products of matrices: a known zero is structure, and of what is symmetric one triangle is computed."""

from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from straightline.compiled import compile
from straightline.graph_as_jax_function import make_jax_function
from straightline.llvm.output_buffers import choose_output_buffers
from straightline.nodes import Node
from straightline.program import list_needed_items, lower_function

RANDOM = np.random.default_rng(7)
SPARSE = np.where(RANDOM.random((5, 5)) < 0.5, 0.0, RANDOM.normal(size=(5, 5)))
VALUES = np.array([np.nan, np.inf, -np.inf, 1.5, -2.0])


def operations(function, *shapes):
    """Additions and products, and numbers that a loop carries, of a function of arrays of these shapes."""
    program = lower_function(function, *(jax.ShapeDtypeStruct(s, np.float64) for s in shapes))
    nodes = [n for n in list_needed_items(choose_output_buffers(program)) if isinstance(n, Node)]
    counts = Counter(n.op for n in nodes)
    return counts["add"] + counts["sub"] + counts["mul"], counts["parameter"]


def without_zeros(matrix, x):
    """sum_j M_ij x_jk over the j with M_ij not zero, by NumPy."""
    with np.errstate(all="ignore"):
        return np.array([[row[row != 0] @ c[row != 0] for c in x.T] for row in matrix])


@pytest.mark.parametrize(
    "function",
    [
        lambda x: SPARSE @ x,
        lambda x: (x.T @ SPARSE.T).T,
        lambda x: jax.vmap(lambda c: SPARSE @ c, in_axes=1, out_axes=1)(x),
        lambda x: jnp.einsum("ij,jk->ik", SPARSE, x),
    ],
)
def test_nan_and_infinity_pass_through_a_known_matrix_to_what_depends_on_them_and_to_nothing_else(function):
    x = RANDOM.choice(VALUES, size=(300, 5, 4))
    expected = np.array([without_zeros(SPARSE, one) for one in x])
    assert np.isnan(expected).any() and np.isinf(expected).any() and np.isfinite(expected).any()
    np.testing.assert_allclose(compile(function, x[0])(x), expected, rtol=1e-14, atol=1e-14)
    program = lower_function(function, x[0])
    with jax.enable_x64(True):
        np.testing.assert_allclose(jax.vmap(make_jax_function(program))(x), expected, rtol=1e-14, atol=1e-14)


def test_nan_shows_in_what_depends_on_it_through_a_chain_of_known_matrices():
    """F P F' of a P with one variance that is no number: entry (i, j) depends on it if both states follow that one."""
    p = np.tile(np.eye(5), (5, 1, 1))
    p[np.arange(5), np.arange(5), np.arange(5)] = np.nan
    product = compile(lambda p: SPARSE @ p @ SPARSE.T, p[0])(p)
    follows = SPARSE.T != 0  # (state that is no number, state after the step)
    np.testing.assert_array_equal(np.isnan(product), follows[:, :, None] & follows[:, None, :])


@pytest.mark.parametrize(
    "function",
    [
        lambda x, zeros: 0.0 * x,
        lambda x, zeros: np.zeros(2) * x,
        lambda x, zeros: jnp.sum(np.array([0.0, 1.0]) * x)[None],
        lambda x, zeros: zeros @ x,
        lambda x, zeros: jnp.array([[0.0, np.nan]]) @ jnp.array([1.0, 2.0]) + x[1:],
        lambda x, zeros: jnp.array([[0.0, 1.0]]) @ jnp.array([np.inf, 2.0]) + x[1:],
    ],
)
def test_a_zero_that_is_data_or_a_factor_of_a_number_is_arithmetic(function):
    x, zeros = np.array([[np.nan, 1.0]]), np.zeros((1, 2, 2))
    with jax.enable_x64(True):
        expected = jax.vmap(function)(x, zeros)
    result = compile(function, x[0], zeros[0])(x, zeros)
    np.testing.assert_array_equal(result, expected)
    assert np.isnan(result).any()


def test_the_terms_of_known_zeros_are_not_computed():
    """Position and speed, twice: of a position a product and a sum, of a speed nothing."""
    f = np.kron(np.eye(2), [[1.0, 0.1], [0.0, 1.0]])
    count, _ = operations(lambda x: f @ x, (4,))
    assert count == 4
    count, _ = operations(lambda p: f @ p @ f.T, (4, 4))
    assert count == 2 * (8 + 8) - 4  # rows, then columns, of positions; four products are in both


def test_the_zeros_of_a_matrix_in_memory_are_known_too():
    """Of 400 numbers 39 are not zero; NaN moves one state on."""
    f = 0.9 * np.eye(20) + np.diag(np.full(19, 0.1), 1)
    x = np.ones((1, 20))
    x[0, 7] = np.nan
    moved = compile(lambda x: f @ x, x[0])(x)[0]
    assert np.flatnonzero(np.isnan(moved)).tolist() == [6, 7]
    assert operations(lambda x: f @ x, (20,)) == (39 + 19, 0)


def mirrored(a):
    """The upper triangle for both: what is symmetric but for rounding, written by hand."""
    return jnp.where(np.triu(np.ones(a.shape[-2:], bool)), a, jnp.swapaxes(a, -1, -2))


FOUR = (4, 4)


@pytest.mark.parametrize(
    ("plain", "shapes", "count"),
    [
        (lambda f, p, q: f @ mirrored(p) @ f.T + mirrored(q), [FOUR] * 3, 192),
        (lambda f, p, q: f @ (mirrored(p) @ f.T) + mirrored(q), [FOUR] * 3, 192),
        (lambda f, p, q: jnp.einsum("ij,jk,lk->il", f, mirrored(p), f) + mirrored(q), [FOUR] * 3, 192),
        (lambda k, s, p: mirrored(p) - k @ mirrored(s) @ k.T, [(4, 2), (2, 2), FOUR], 64),
        (lambda k, s, p: mirrored(p) - k @ s @ k.T, [(4, 1), (1, 1), FOUR], 24),
        (lambda w, d, q: (w * d) @ w.T + mirrored(q), [FOUR, (4,), FOUR], 96),
        (lambda w: w @ w.T, [FOUR], 70),
        (lambda f, p: jax.vmap(lambda f, p: f @ mirrored(p) @ f.T)(f, p), [(3, *FOUR), (3, *FOUR)], 546),
    ],
)
def test_what_is_symmetric_costs_one_triangle(plain, shapes, count):
    """As many operations as the upper triangle written out: 2 n^3 - n^2, n (n + 1) / 2 (2 n - 1), n (n + 1) / 2."""
    assert operations(plain, *shapes)[0] == count
    assert operations(lambda *a: mirrored(plain(*a)), *shapes)[0] == count


def test_what_is_not_symmetric_is_computed_whole():
    f, g, p = RANDOM.normal(size=(3, 2, 4, 4))
    for function in (
        lambda f, g, p: f @ p @ f.T,
        lambda f, g, p: f @ mirrored(p) @ g.T,
        lambda f, g, p: (f * g) @ f.T,
        lambda f, g, p: (f * g[:1]) @ f,
    ):
        result = compile(function, f[0], g[0], p[0])(f, g, p)
        with jax.enable_x64(True):
            np.testing.assert_allclose(result, jax.vmap(function)(f, g, p), rtol=1e-12, atol=1e-12)


def test_a_loop_carries_one_triangle_of_what_stays_symmetric():
    def covariances(f, steps):
        return jax.lax.scan(lambda p, _: (f @ p @ f.T + 0.1 * np.eye(4), p), jnp.eye(4), steps)

    f, steps = 0.4 * RANDOM.normal(size=(3, 4, 4)), np.zeros((3, 300))
    count, carried = operations(lambda f, steps: covariances(f, steps)[0], FOUR, (300,))
    assert (count, carried) == (182 + 4, 10)  # Q has four entries beside zeros
    results = compile(covariances, f[0], steps[0])(f, steps)
    with jax.enable_x64(True):
        expected = jax.vmap(covariances)(f, steps)
    for a, b in zip(results, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)


def test_what_a_loop_stored_is_as_symmetric_when_it_is_read_again():
    """Backwards through the covariances of a loop, and one of them at a place that data say."""

    def backwards(f, steps, k):
        _, all_ = jax.lax.scan(lambda p, _: (f @ p @ f.T + 0.1 * np.eye(4), p), jnp.eye(4), steps)
        total, _ = jax.lax.scan(lambda s, p: (s + f @ p @ f.T, None), jnp.zeros((4, 4)), all_, reverse=True)
        return total, all_[k], all_[k, :, 1], all_[:, 2, 0], all_[k, k % 4]

    f, steps, k = 0.4 * RANDOM.normal(size=(3, 4, 4)), np.zeros((3, 300)), np.array([0, 7, 299])
    count, carried = operations(lambda f, steps: backwards(f, steps, 0)[0], FOUR, (300,))
    assert count == (182 + 4) + (182 + 10) + 1 and carried == 20  # one: the row counted backwards
    results = compile(backwards, f[0], steps[0], k[0])(f, steps, k)
    with jax.enable_x64(True):
        expected = jax.jit(jax.vmap(backwards))(f, steps, k)
    for a, b in zip(results, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)


def test_a_loop_carries_all_of_what_does_not_stay_symmetric():
    """A product of matrices from the identity on, beside a covariance; in a loop of some turns and a `while`."""

    def both(f, steps):
        def step(state, _):
            return (f @ state[0], f @ state[1] @ f.T + np.eye(4)), None

        return jax.lax.scan(step, (jnp.eye(4), jnp.eye(4)), steps)[0]

    def until_small(f, steps):
        def step(state):
            return f @ state[0], f @ state[1] @ f.T

        return jax.lax.while_loop(lambda s: jnp.abs(s[0]).max() > 1e-3, step, (jnp.eye(4), jnp.eye(4)))

    f, steps = 0.4 * RANDOM.normal(size=(3, 4, 4)), np.zeros((3, 300))
    f[2] = np.diag([0.5, 0.4, 0.3, 0.2])
    for function in (both, until_small):
        assert operations(function, FOUR, (300,))[1] == 26
        results = compile(function, f[0], steps[0])(f, steps)
        with jax.enable_x64(True):
            expected = jax.vmap(function)(f, steps)
        for a, b in zip(results, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-14)
