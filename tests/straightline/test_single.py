"""Numbers of single precision: the program that JAX traces by default, in lanes of floats, beside XLA's code for it."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import straightline
from straightline.compiled import CompiledFunction
from straightline.program import lower_function

EPS = 2.0**-23  # of float32
RANDOM = np.random.default_rng(0)


@pytest.fixture(autouse=True)
def no_defects():
    """A rule that fails warns."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        yield


def step(x, k):
    """Matrices, functions, draws, a loop with its count, a branch."""
    key = jax.random.fold_in(jax.random.key(5), k)
    a = jnp.array([[0.9, 0.1, 0.0], [0.0, 0.8, 0.2], [0.1, 0.0, 0.7]])
    x = a @ x + 0.1 * jnp.sin(x) * jax.random.normal(key, (3,))
    x = jax.lax.fori_loop(0, 300, lambda i, v: v + 1e-4 * jnp.cos(v * i), x)
    return jnp.where(x > 0, jnp.log1p(jnp.abs(x)), jax.lax.cond(x[0] > 1, jnp.exp, jnp.tanh, x)), jnp.argmax(x), key


def arguments(runs):
    """States and numbers of runs."""
    return RANDOM.normal(size=(runs, 3)).astype(np.float32), np.arange(runs, dtype=np.uint32)


def test_it_is_the_program_that_jax_traces_by_default():
    x, k = arguments(100)
    code = straightline.compile(lambda x, k: step(x, k)[:2], x[0], k[0], single=True)
    expected = jax.jit(jax.vmap(lambda x, k: step(x, k)[:2]))(x, k)
    for result, e in zip(code(x, k), expected, strict=True):
        assert result.dtype == e.dtype
        # The loop adds 300 numbers below 1e-4, each with a unit of rounding of the state.
        np.testing.assert_allclose(result, np.asarray(e), rtol=0, atol=300 * EPS)
    assert code.width == 16  # twice that of doubles


def test_numbers_of_double_precision_are_rounded_when_they_come_in():
    code = straightline.compile(lambda x: x * 2, 0.1, single=True)
    np.testing.assert_array_equal(code(np.array([0.1, 1 / 3])), np.array([0.1, 1 / 3], np.float32) * 2)


def test_draws_are_those_of_jax():
    def draws(k):
        key = jax.random.fold_in(jax.random.key(1), k)
        return (
            jax.random.bits(key, (2,)), jax.random.uniform(key, (3,)), jax.random.randint(key, (2,), 0, 9),
            jax.random.bernoulli(key, 0.3), jax.random.normal(key, (4,)), jax.random.exponential(key),
        )  # fmt: skip

    k = np.arange(3000, dtype=np.uint32)
    result = straightline.compile(draws, k[0], single=True)(k)
    *whole, normal, exponential = zip(result, map(np.asarray, jax.jit(jax.vmap(draws))(k)), strict=True)
    for a, b in whole:
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    # Normal numbers by XLA's polynomial, of a logarithm that differs by its rounding.
    np.testing.assert_allclose(*normal, rtol=8 * EPS)
    assert np.mean(normal[0] == normal[1]) > 0.9
    np.testing.assert_allclose(*exponential, rtol=4 * EPS)


def test_bits_depend_on_no_neighbour_nor_on_the_width_or_the_cores():
    x, k = arguments(77)
    one = straightline.compile(lambda x, k: step(x, k)[0], x[0], k[0], single=True)
    whole = one(x, k)
    for width in (1, 8, 32):
        other = CompiledFunction(
            lower_function(lambda x, k: step(x, k)[0], x[0], k[0], single=True), [True, True], width
        )
        np.testing.assert_array_equal(other(x, k), whole)
    np.testing.assert_array_equal(one(x[13:15], k[13:15], cores=1), whole[13:15])


@pytest.mark.parametrize("entries", [1, 7, 16, 40])
def test_arrays_of_any_length_reach_their_lanes_and_come_back(entries):
    x = RANDOM.normal(size=(37, entries)).astype(np.float32)
    code = straightline.compile(lambda x: (x[::-1], x > 0, x.astype(jnp.int32)), x[0], single=True)
    for result, expected in zip(code(x), (x[:, ::-1], x > 0, x.astype(np.int32)), strict=True):
        np.testing.assert_array_equal(result, expected)


def test_sums_over_runs_are_double():
    """A million ones, in 8 lanes each, that float32 would not count beyond 2^24, and their squares."""

    def run(value, number):
        return (value + number * 0, value * value), number * value

    code = straightline.accumulate(run, 0.0, batches=3, single=True)
    (total, squares), each = code(4097.0, runs=1_000)
    assert total.dtype == np.float64
    assert each.dtype == np.float32
    assert total.sum() == 4097e3
    assert squares.sum() == float(np.float32(4097.0) * np.float32(4097.0)) * 1e3


def test_one_run_in_memory_of_its_own():
    one = straightline.compile_one(lambda s, e: (s + e * 0.1, s * e), 0.0, 0.0, in_place={0: 0}, single=True)
    assert {x.dtype for x in (*one.inputs, *one.outputs)} == {np.dtype(np.float32)}
    one.inputs[0][...], one.inputs[1][...] = 1.0, 0.5
    one()
    assert one.outputs[0] == np.float32(1.0) + np.float32(0.5) * np.float32(0.1)


def test_both_precisions_in_one_program():
    """Float32 data under x64: JAX makes doubles where they meet doubles, and converts back where it is told to."""

    def mixed(x, y):
        wide = jnp.sum(x.astype(float) * y)
        return wide, wide.astype(np.float32), x * 2, jnp.dot(x, x), jnp.isfinite((y[0] * 1e300).astype(np.float32))

    x, y = RANDOM.normal(size=(40, 3)).astype(np.float32), RANDOM.normal(size=(40, 3))
    result = straightline.compile(mixed, x[0], y[0])(x, y)
    with jax.enable_x64(True):
        expected = jax.jit(jax.vmap(mixed))(x, y)
    for a, b in zip(result, expected, strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, np.asarray(b), rtol=4 * EPS if a.dtype == np.float32 else 1e-14)


def test_decompositions_and_special_functions():
    a = RANDOM.normal(size=(20, 3, 3)).astype(np.float32)
    a = a @ np.swapaxes(a, 1, 2) + np.eye(3, dtype=np.float32)

    def values(a):
        w, v = jnp.linalg.eigh(a)
        gamma = jax.scipy.special.gammainc(a[0, 0], a[1, 1])
        return (v * w) @ v.T, jnp.linalg.solve(a, a[0]), jnp.linalg.cholesky(a), gamma, jax.scipy.special.i0e(a[0, 0])

    result = straightline.compile(values, a[0], single=True)(a)
    for one, e in zip(result, jax.jit(jax.vmap(values))(a), strict=True):
        assert one.dtype == np.float32
        np.testing.assert_allclose(one, np.asarray(e), rtol=2e-4, atol=2e-5)  # conditions of some hundred


def test_explained():
    assert straightline.explain(lambda x: x * x + 1, 1.0, single=True) == "3 operations"
