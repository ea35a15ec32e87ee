"""A kernel over runs: where vmap puts its axes, what is traced, and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heliograph.numerics.linalg import times
from heliograph.numerics.over_runs import runs_last, runs_last_of
from straightline.program import lower

RNG = np.random.default_rng(0)
A, B = RNG.normal(size=(3, 4, 2, 2)), RNG.normal(size=(2, 2))
seen: list[tuple[int, ...]] = []


@runs_last
def product(a, b):
    """A B and tr A."""
    seen.append(a.shape)
    return times(a, b), a[0, 0] + a[1, 1]


def over_two(a, b):
    return jax.vmap(jax.vmap(product, in_axes=(0, None)), in_axes=(0, None))(a, b)


def test_axes_of_vmap_are_last_in_the_kernel_and_first_outside():
    """And it is traced for one matrix and for all, not for what lies between."""
    with jax.enable_x64(True):
        seen.clear()
        result, traces = jax.jit(over_two)(A, B)
    np.testing.assert_allclose(result, A @ B, rtol=1e-15, atol=1e-15)
    np.testing.assert_allclose(traces, np.trace(A, axis1=2, axis2=3), rtol=1e-15)
    assert sorted(set(seen)) == [(2, 2), (2, 2, 4, 3)] and len(seen) == 2, seen


def test_a_kernel_that_says_its_shapes_is_traced_for_all_runs_alone():
    @runs_last_of(lambda a, b: (b.shape, ()))
    def report(a, b):
        seen.append(a.shape)
        return times(a, b), a[0, 0] + a[1, 1]

    with jax.enable_x64(True):
        seen.clear()
        result, traces = jax.jit(jax.vmap(report, in_axes=(0, None)))(A[0], B)
    assert seen == [(2, 2, 4)] and traces.dtype == np.float64, seen
    np.testing.assert_allclose(result, A[0] @ B, rtol=1e-15, atol=1e-15)
    np.testing.assert_allclose(traces, np.trace(A[0], axis1=1, axis2=2), rtol=1e-15)


def test_native_code_is_made_of_the_trace_that_gave_the_shapes():
    @runs_last
    def trace(a):
        seen.append(a.shape)
        return a[0, 0] + a[1, 1]

    seen.clear()
    program = lower(lambda a: trace(a) + trace(2 * a), B)
    assert seen == [(2, 2)] and len(program.outputs) == 1


def test_results_that_no_run_has_a_part_in_come_for_each():
    with jax.enable_x64(True):
        result, traces = jax.vmap(lambda b: product(B, b))(A[0])
    np.testing.assert_allclose(result, B @ A[0], rtol=1e-15, atol=1e-15)
    np.testing.assert_array_equal(traces, [np.trace(B)] * 4)


@pytest.mark.slow
def test_derivatives_are_those_of_the_arithmetic_forward_and_back_one_or_many():
    """Of the sum of squares of A B: 2 A' A B in B, 2 A B B' in A."""
    with jax.enable_x64(True):
        b = jnp.asarray(B)
        expected = 2 * np.einsum("rsij,rsik,kl->jl", A, A, B)
        for slopes in (jax.grad, jax.jacfwd):
            result = slopes(lambda b: jnp.sum(over_two(A, b)[0] ** 2))(b)
            np.testing.assert_allclose(result, expected, rtol=1e-14)
        items = jax.vmap(jax.grad(lambda a: jnp.sum(product(a, b)[0] ** 2)))(jnp.asarray(A[0]))
        np.testing.assert_allclose(items, 2 * A[0] @ B @ B.T, rtol=1e-14, atol=1e-14)


def test_names_of_arguments_may_be_given():
    np.testing.assert_allclose(product(A[0, 0], b=B)[0], A[0, 0] @ B, rtol=1e-6)


def test_other_devices_get_the_arithmetic_without_the_conditional():
    """The conditional keeps a processor's compiler from fusing across; another device's code has none."""
    traced = jax.jit(over_two).trace(A, B)
    lowered = {device: traced.lower(lowering_platforms=(device,)).as_text() for device in ("cpu", "cuda")}
    assert "stablehlo.case" in lowered["cpu"] and "stablehlo.case" not in lowered["cuda"]


def test_the_precision_is_that_of_the_call_though_it_is_compiled_later():
    shifted = runs_last(lambda a: a + jnp.eye(2)[..., None] if a.ndim > 2 else a + jnp.eye(2))

    def single(x):
        with jax.enable_x64(False):
            return jax.vmap(shifted)(x)

    with jax.enable_x64(True):
        result = jax.jit(single)(np.ones((3, 2, 2), np.float32))
    assert result.dtype == np.float32
    np.testing.assert_array_equal(result, [np.ones((2, 2)) + np.eye(2)] * 3)
