"""Lowered programs: with known arguments everything folds, and the numbers are JAX's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from straightline.graph import Graph
from straightline.lowering import Lowering, list_nodes, trace_function
from straightline.nodes import Unsupported
from straightline.program import list_needed_items, lower_function
from tests.straightline.over_runs import over_runs


def folded(function, *arguments):
    """The results of a function whose arguments are known: numbers of constants."""
    program, tree = trace_function(function, *arguments)
    lowering = Lowering()
    with jax.enable_x64(True):
        results = lowering.inline_program(
            program, [lowering.make_known_array(np.asarray(x)) for x in jax.tree.leaves(arguments)]
        )
    nodes = [lowering.nodes(r) for r in results]
    numbers = [np.array([n.value for n in r.ravel()]).reshape(r.shape) for r in nodes]
    return jax.tree.unflatten(tree, numbers)


def agree(function, *arguments):
    with jax.enable_x64(True):
        expected = function(*map(jnp.asarray, arguments))
    for a, b in zip(jax.tree.leaves(folded(function, *arguments)), jax.tree.leaves(expected), strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-15)  # sums in another order


X = np.random.default_rng(3).normal(size=(3, 4))
S = X @ X.T + np.eye(3)


@pytest.mark.parametrize(
    "function",
    [
        lambda x: (x.T @ x, x[1:, ::2], x[::-1], jnp.concatenate([x, -x], axis=1)),
        lambda x: (jnp.pad(x, ((1, 2), (0, 1))), x[jnp.array([2, 0]), 1], x.at[1, 2].set(7.0), x.at[0].add(1.0)),
        lambda x: (jnp.max(x), jnp.argmin(x, axis=1), jnp.cumsum(x, axis=0), jnp.any(x > 0, axis=0), x**3, x**-2),
        lambda x: (jnp.where(x > 0, x, jnp.nan), jnp.clip(x, -0.5, 0.5), jnp.arctan2(x, 2.0), jnp.maximum(x, jnp.nan)),
        lambda x: (jnp.einsum("ij,kj->ik", x, x), jax.lax.rsqrt(x * x), jnp.round(x * 0 + 2), jnp.tile(x, (2, 1))),
        lambda x: (x @ (x[0] > 0), jnp.arange(3) @ x, (x > 0) @ jnp.arange(4)),
        lambda x: jax.lax.scan(lambda c, row: (c * 0.5 + row, c.sum()), jnp.zeros(4), x, reverse=True),
        lambda x: jax.lax.cond(x[0, 0] > 0, lambda: x[0], lambda: x[1]),
    ],
)
def test_operations_give_the_numbers_of_jax(function):
    agree(function, X)


ROWS = jnp.array([0, 0, 2])


@pytest.mark.parametrize(
    "function",
    [
        lambda x: (x[:, [2, 0, 9, -1]], x[[0, 1, 2], [1, 3, 2]], x[[2, 1], :, [0, 4]], x[:, [1, 2], [3, 4]]),
        lambda x: (x.at[1, :, [2, 3]].set(7.0), x.at[ROWS].add(x[ROWS]), x.at[ROWS + 3].mul(2.0, mode="drop")),
        lambda x: (jnp.take(x, jnp.array([1, 7]), axis=2), jnp.take_along_axis(x, 0 * x[:, :2].astype(int) + 1, 1)),
        lambda x: (jax.vmap(lambda a, i: a[i])(x, ROWS + 2), jax.vmap(lambda a, i: a.at[i].set(0.0))(x, ROWS)),
    ],
)
def test_what_is_gathered_and_scattered_is_what_jax_does(function):
    """Repeated places, places beyond the edges, and indices that go with a batch."""
    agree(function, np.random.default_rng(5).normal(size=(3, 4, 5)))


def test_factors_and_triangular_systems():
    agree(lambda s, x: (jnp.linalg.cholesky(s), jax.scipy.linalg.solve_triangular(s, x, lower=True)), S, X)
    agree(lambda s, x: jax.scipy.linalg.solve_triangular(s, x, trans=1, lower=True), S, X)
    assert np.isnan(folded(jnp.linalg.cholesky, -S)[0, 0])


def test_equal_expressions_are_one_node_and_what_nothing_needs_is_dropped():
    program = lower_function(lambda x: (x[0] * x[1] + x[1] * x[0], jnp.sin(x[2]))[0], np.zeros(3))
    nodes = list_needed_items(list_nodes(program.outputs[0]))
    assert sorted(n.op for n in nodes if hasattr(n, "op")) == ["add", "load", "load", "mul"]


def test_a_product_with_zero_is_zero_only_of_finite_numbers():
    graph = Graph()
    zero, data = graph.constant(0.0, "f64"), graph.make_fresh_node("load", "f64", (), graph.top, None)
    flag = graph.node("gt", "bool", data, zero)
    assert graph.node("mul", "f64", zero, data).op == "mul"
    assert graph.node("mul", "f64", zero, graph.node("convert", "f64", flag)) is zero
    assert graph.constant(0.0, "f64") is not graph.constant(-0.0, "f64")


def test_what_is_not_lowered_is_refused_with_its_operation_and_place():
    with pytest.raises(Unsupported, match=r"svd.* at .*test_lowering\.py:\d+"):
        lower_function(lambda x: jnp.linalg.svd(x)[1], X)


def test_a_loop_over_an_axis_ends_for_each_entry_when_its_condition_fails():
    """Each run, row and column: a vector doubled and a key split until the sum is above a number of its own."""

    def doubled(x, words):
        def single(limit, words):
            key = jax.random.wrap_key_data(words)
            grown = jnp.ones(2), jnp.array(0), key
            again = lambda c: (2 * c[0] + c[1], c[1] + 1, jax.random.fold_in(c[2], 1))  # noqa: E731
            sums, count, key = jax.lax.while_loop(lambda c: jnp.sum(c[0]) < limit, again, grown)
            return sums, count, jax.random.key_data(key)

        return jax.vmap(jax.vmap(single))(x, words)

    draw = np.random.default_rng(0)
    limits, words = draw.uniform(0, 50, (5, 2, 3)), draw.integers(0, 9, (5, 2, 3, 2), dtype=np.uint32)
    limits[0, 0, 0] = np.nan
    with jax.enable_x64(True):
        expected = [np.asarray(x) for x in jax.jit(jax.vmap(doubled))(limits, words)]
    for x, y in zip(over_runs(doubled, limits, words), expected, strict=True):
        np.testing.assert_array_equal(x, y)  # doubling and adding small integers is exact
    assert len(np.unique(expected[1])) > 3
