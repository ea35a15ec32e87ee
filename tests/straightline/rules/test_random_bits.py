"""Draws and keys are JAX's bit for bit."""

import ctypes
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightline.constant_folding import DTYPES, EVALUATED
from straightline.lowering import list_nodes
from straightline.nodes import Node, Unsupported
from straightline.program import lower_function
from straightline.rules.random_bits import hash_words, write_hash_function
from tests.straightline.compiled import WIDTH, engine_of

WORD = st.integers(0, 2**32 - 1)


def computed(function: Callable[..., Any], *arguments: Any) -> list[np.ndarray]:
    """The results of a lowered function, its operations computed one by one by NumPy; keys as their words."""
    program = lower_function(function, *arguments)
    words = [np.asarray(jax.random.key_data(a) if _is_key(a) else a) for a in arguments]
    given = dict(zip(program.inputs, words, strict=True))
    known: dict[Node, Any] = {}

    def value(node: Node) -> Any:
        if node not in known:
            known[node] = _computed(node, [value(a) for a in node.args], given)
        return known[node]

    return [np.array([value(node) for node in list_nodes(output)]) for output in program.outputs]


def _computed(node: Node, numbers: list[Any], given: dict[Any, np.ndarray]) -> Any:
    kind = DTYPES[node.type]
    if node.op == "constant":
        return kind(node.value)
    if node.op == "load":
        return kind(given[node.value[0]].ravel()[node.value[1]])
    if node.op == "threefry":
        return np.uint64(hash_words(*map(int, numbers)))
    if node.op == "convert":
        return numbers[0].astype(kind)
    if node.op == "bitcast":
        return numbers[0].view(kind)
    if node.op == "select":
        return numbers[1] if numbers[0] else numbers[2]
    with np.errstate(over="ignore"):
        return kind(EVALUATED[node.op](*numbers))


def _is_key(value: Any) -> bool:
    return isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key)


def same(function: Callable[..., Any], *arguments: Any) -> None:
    """The function's results as JAX has them, bit for bit."""
    with jax.enable_x64(True):
        expected = jax.tree.leaves(jax.jit(function)(*arguments))
    for item, true in zip(computed(function, *arguments), expected, strict=True):
        true = np.asarray(jax.random.key_data(true) if _is_key(true) else true)
        np.testing.assert_array_equal(item, true.ravel())


def key_of(first: int, second: int) -> jax.Array:
    return jax.random.wrap_key_data(jnp.array([first, second], dtype=jnp.uint32))


def _keys(key: jax.Array, number: jax.Array) -> tuple[jax.Array, ...]:
    last = jax.random.clone(jax.random.split(key)[1])
    return jax.random.fold_in(key, number), jax.random.split(key, (2, 3)), jax.random.key_data(last)


@given(WORD, WORD, WORD)
def test_keys_of_keys(first: int, second: int, number: int) -> None:
    same(_keys, key_of(first, second), np.uint32(number))


def _draws(key: jax.Array, shape: tuple[int, ...]) -> tuple[jax.Array, ...]:
    uniform = jax.random.uniform(key, shape, dtype=float, minval=-2.0, maxval=3.0)
    few, most = (jax.random.bits(key, shape, dtype) for dtype in (jnp.uint32, jnp.uint64))
    return few, most, jax.random.uniform(key, shape, dtype=float), uniform, jax.random.bernoulli(key, 0.3, shape)


SHAPES = [partial(_draws, shape=shape) for shape in [(), (1,), (7,), (2, 3)]]


@pytest.mark.parametrize("draws", SHAPES)
@pytest.mark.parametrize("seed", [0, 1, 2**32 - 1])
def test_bits_and_uniform_numbers(seed: int, draws: Callable[..., Any]) -> None:
    same(draws, jax.random.key(seed))


def _key_of(seed: jax.Array) -> jax.Array:
    return jax.random.key(seed)


@given(st.integers(-(2**63), 2**63 - 1))
def test_keys_of_seeds(seed: int) -> None:
    same(_key_of, np.int64(seed))
    same(_key_of, np.int32(seed % 2**31))


def test_integers() -> None:
    same(lambda key: jax.random.randint(key, (5,), 0, 1000), jax.random.key(4))


def test_several_keys_at_once() -> None:
    keys = jax.random.split(jax.random.key(3), 4)
    same(lambda keys: jax.vmap(lambda k: jax.random.uniform(jax.random.fold_in(k, 5), (2,), dtype=float))(keys), keys)


def test_the_hash_of_jax() -> None:
    words = np.arange(4, dtype=np.uint32)
    same(lambda k, x: jnp.stack(jax.extend.random.threefry2x32_p.bind(k, k, x, x)), words, words[::-1].copy())


def test_known_keys_are_computed_before() -> None:
    program = lower_function(lambda: jax.random.uniform(jax.random.fold_in(jax.random.key(5), 3), (2,), dtype=float))
    assert all(node.op == "constant" for node in list_nodes(program.outputs[0]))


def test_keys_of_another_hash_are_refused() -> None:
    with pytest.raises(Unsupported, match=r"key<rbg>"):
        lower_function(lambda key: jax.random.fold_in(key, 1), jax.random.key(0, impl="rbg"))
    with jax.threefry_partitionable(False), pytest.raises(Unsupported, match="jax_threefry_partitionable"):
        lower_function(lambda key: jax.random.fold_in(key, 1), jax.random.key(0))


def test_the_compiled_hash() -> None:
    words, wide = "%i32", "%i64"
    loads = "".join(
        f"  %p{i} = getelementptr {words}, ptr %in, i64 {i}\n  %w{i} = load {words}, ptr %p{i}, align 4\n"
        for i in range(4)
    )
    text = write_hash_function() + (
        f"define void @all(ptr %in, ptr %out) {{\n{loads}"
        f"  %r = call {wide} @hg_threefry({', '.join(f'{words} %w{i}' for i in range(4))})\n"
        f"  store {wide} %r, ptr %out, align 8\n  ret void\n}}\n"
    )
    engine = engine_of(text)
    given = np.random.default_rng(0).integers(0, 2**32, (4, WIDTH), dtype=np.uint32)
    result = np.empty(WIDTH, dtype=np.uint64)
    call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(engine.get_function_address("all"))
    call(given.ctypes.data, result.ctypes.data)
    np.testing.assert_array_equal(result, [hash_words(*map(int, column)) for column in given.T])
