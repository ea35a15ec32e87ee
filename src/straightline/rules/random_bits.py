"""Random numbers of JAX bit for bit: rules of operations on keys, and the hash as text of LLVM IR.

A key is two words, and every draw and every new key is the hash of a counter by a key. In the graph the hash is one
operation, "threefry" of the key's words and the counter's, whose result (u64) is the first word above the second.

Source: Salmon, Moraes, Dror, Shaw, Parallel random numbers: as easy as 1, 2, 3 (2011), section 5.2; JAX counts as with
its flag jax_threefry_partitionable.
"""

import math
from functools import cache
from typing import Any

import jax
import numpy as np
from jax.extend.core import JaxprEqn

from straightline.graph import Graph
from straightline.lowering import RULES, Lowering, arrange_nodes, make_keys, result_shape
from straightline.nodes import Node, RandomKey, Unsupported
from straightline.rules.elementwise import broadcast_entries
from straightline.size_limits import LOADED

Word = Any  # of 32 bits, in an integer or an array of wider ones
ROTATIONS = (13, 15, 26, 6), (17, 29, 16, 24)
PARITY = 0x1BD11BDA


def threefry(graph: Graph, key: RandomKey, high: Node, low: Node) -> Node:
    """Return the node of a hash of 64 bits, of a counter's two words (32 bits each) by a key; a constant if known.

    Its first word is in the upper bits, the second in the lower.
    """
    words = (key.first, key.second, high, low)
    if all(word.op == "constant" for word in words):
        return graph.constant(hash_words(*(int(word.value) for word in words)), "u64")
    return graph.node("threefry", "u64", *words)


def _new_key(graph: Graph, key: RandomKey, high: Node, low: Node) -> RandomKey:
    """Return the hash of a counter's two words by a key, as a new key: of its upper and lower 32 bits."""
    bits = threefry(graph, key, high, low)
    upper = graph.node("shift_right", "u64", bits, graph.constant(32, "u64"))
    return RandomKey(graph.node("convert", "u32", upper), graph.node("convert", "u32", bits))


def _make_keys(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return keys (...) made of words (..., 2)."""
    _check_key_type(equation.outvars[0])
    return [make_keys(inputs[0])]


def _read_key_words(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return the two words of each key of random numbers: an array (..., 2) of nodes from keys (...)."""
    _check_key_type(equation.invars[0])
    words = [word for key in inputs[0].ravel().tolist() for word in (key.first, key.second)]
    return [arrange_nodes(words, result_shape(equation))]


def _fold_in(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return for each key and number the key that is the hash, by the key, of the words (0, number)."""
    _check_key_type(equation.invars[0])
    shape, zero = result_shape(equation), lowering.graph.constant(0, "u32")
    pairs = zip(*broadcast_entries(inputs, shape), strict=True)
    return [arrange_nodes([_new_key(lowering.graph, key, zero, number) for key, number in pairs], shape)]


def _split(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return for each key the new keys that are the hashes, by it, of 0, 1, 2, ..., as many as the shape asks for."""
    _check_key_type(equation.invars[0])
    graph, counters = lowering.graph, _make_counters(lowering.graph, equation.params["shape"])
    keys = [_new_key(graph, key, *counter) for key in inputs[0].ravel().tolist() for counter in counters]
    return [arrange_nodes(keys, result_shape(equation))]


def _bits(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return for each key random bits: the hashes of 0, 1, 2, ... by it; of 32 bits the exclusive or of both halves."""
    _check_key_type(equation.invars[0])
    graph, width = lowering.graph, equation.params["bit_width"]
    counters = _make_counters(graph, equation.params["shape"])
    drawn = [threefry(graph, key, *counter) for key in inputs[0].ravel().tolist() for counter in counters]
    if width == 32:
        shift = graph.constant(32, "u64")
        mixed = [graph.node("xor", "u64", x, graph.node("shift_right", "u64", x, shift)) for x in drawn]
        drawn = [graph.node("convert", "u32", x) for x in mixed]
    elif width != 64:
        raise Unsupported(f"random numbers of {width} bits")
    return [arrange_nodes(drawn, result_shape(equation))]


def _seed(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return for each number (a seed) the key whose two words are the upper and lower 32 bits of it."""
    _check_key_type(equation.outvars[0])
    graph = lowering.graph

    def make_key(seed: Node) -> RandomKey:
        """Return the key of a seed: its upper 32 bits, 0 for a type of 32 bits, and its lower ones."""
        if seed.type[1:] == "32":
            return RandomKey(graph.constant(0, "u32"), graph.node("convert", "u32", seed))
        bits = graph.node("convert", "u64", seed)
        upper = graph.node("shift_right", "u64", bits, graph.constant(32, "u64"))
        return RandomKey(graph.node("convert", "u32", upper), graph.node("convert", "u32", bits))

    return [arrange_nodes(map(make_key, inputs[0].ravel().tolist()), result_shape(equation))]


def _hash_word_pairs(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return both words of the hashes (Threefry) of counters' word pairs by keys, in two arrays, as JAX does."""
    shape = result_shape(equation)
    items = zip(*broadcast_entries(inputs, shape), strict=True)
    keys = [_new_key(lowering.graph, RandomKey(first, second), high, low) for first, second, high, low in items]
    return [arrange_nodes([key.first for key in keys], shape), arrange_nodes([key.second for key in keys], shape)]


def _gamma(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> Any:
    """Lower random gamma variables by JAX's own program for them, a loop until a proposal is accepted."""
    gamma: Any = equation.primitive.impl
    avals: list[Any] = [v.aval for v in equation.invars]
    program = jax.make_jaxpr(lambda *args: gamma(*args, **equation.params))(*avals)
    return [lowering.nodes(x) for x in lowering.inline_program(program, inputs)]


def _return_keys(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return the keys as they are."""
    return inputs


def _make_counters(graph: Graph, shape: tuple[int, ...]) -> list[tuple[Node, Node]]:
    """Return 0, 1, 2, ... as two words (upper, lower) each, one for each place of a shape; refuse more than LOADED.

    Hashes of so many would be in no program, and take long to refuse one by one.
    """
    if math.prod(shape) > LOADED:
        raise Unsupported(f"{math.prod(shape):,} random numbers at once")
    return [(graph.constant(i >> 32, "u32"), graph.constant(i & 0xFFFFFFFF, "u32")) for i in range(math.prod(shape))]


def _check_key_type(variable: Any) -> None:
    """Raise Unsupported unless keys are of JAX's default hash, with the counters of jax_threefry_partitionable."""
    if str(variable.aval.dtype) != "key<fry>":
        raise Unsupported(f"keys of type {variable.aval.dtype}")
    if not jax.threefry_partitionable.value:
        raise Unsupported("draws counted as without jax_threefry_partitionable")


RULES |= {
    "random_wrap": _make_keys, "random_unwrap": _read_key_words, "random_fold_in": _fold_in, "random_split": _split,
    "random_bits": _bits, "random_seed": _seed, "random_clone": _return_keys, "threefry2x32": _hash_word_pairs,
    "random_gamma": _gamma,
}  # fmt: skip


def hash_words(first: Word, second: Word, high: Word, low: Word) -> Word:
    """Return the hash, of 64 bits, of a counter's words by a key's: Threefry of two words of 32 bits.

    20 rounds of addition, rotation (ROTATIONS: by how many bits) and exclusive or; key words are added every four
    rounds. PARITY, a constant of Threefry's definition, makes the third key word.
    """
    keys = (first, second, first ^ second ^ PARITY)
    mask = 0xFFFFFFFF  # keeps the lower 32 bits of a sum
    x, y = (high + first) & mask, (low + second) & mask
    for group in range(5):  # of four rounds each
        for bits in ROTATIONS[group % 2]:
            x = (x + y) & mask
            y = ((y << bits | y >> (32 - bits)) & mask) ^ x
        x, y = (x + keys[(group + 1) % 3]) & mask, (y + keys[(group + 2) % 3] + group + 1) & mask
    return x << 32 | y


@cache
def write_hash_function() -> str:
    """Return the LLVM text of `%i64 @hg_threefry(%i32 a, b, x, y)`: the hash Threefry-2x32 of a counter under a key.

    (a, b) are the key's two words, (x, y) the counter's, in each lane of a vector; the result has the hash's first word
    in its upper 32 bits and the second in its lower ones.
    """
    vector, wide = "%i32", "%i64"
    lines: list[str] = []

    def op(text: str) -> str:
        """Append an operation; return the new name of its result."""
        lines.append(f"  %t{len(lines)} = {text}")
        return f"%t{len(lines) - 1}"

    # Key schedule: k_2 = k_0 ^ k_1 ^ parity.
    both = op(f"xor {vector} %a, %b")
    keys = ("%a", "%b", op(f"xor {vector} {both}, splat (i32 {PARITY})"))
    x, y = op(f"add {vector} %x, %a"), op(f"add {vector} %y, %b")
    # Five groups of four rounds. A round: x += y, y = rotate(y, bits) ^ x (fshl of y and y rotates to the left). After
    # each group the next two words of the key are added, and the group's number.
    for group in range(5):
        for bits in ROTATIONS[group % 2]:
            x = op(f"add {vector} {x}, {y}")
            y = op(f"call {vector} @llvm.fshl({vector} {y}, {vector} {y}, {vector} splat (i32 {bits}))")
            y = op(f"xor {vector} {y}, {x}")
        x = op(f"add {vector} {x}, {keys[(group + 1) % 3]}")
        y = op(f"add {vector} {y}, {keys[(group + 2) % 3]}")
        y = op(f"add {vector} {y}, splat (i32 {group + 1})")
    # Both words as one of 64 bits.
    high, low = op(f"zext {vector} {x} to {wide}"), op(f"zext {vector} {y} to {wide}")
    word = op(f"or {wide} {op(f'shl {wide} {high}, splat (i64 32)')}, {low}")
    words = ", ".join(f"{vector} %{name}" for name in "abxy")
    body = "\n".join(lines)
    return f"define internal {wide} @hg_threefry({words}) noinline nounwind {{\n{body}\n  ret {wide} {word}\n}}\n"
