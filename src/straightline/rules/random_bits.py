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
    """Return the node of the 64-bit hash of a counter by a key; it is a constant if all words are known.

    The counter consists of two words of 32 bits, `high` and `low`. The hash's first word is in its upper 32 bits, and
    the second in its lower.
    """
    words = (key.first, key.second, high, low)
    if all(word.op == "constant" for word in words):
        return graph.constant(hash_words(*(int(word.value) for word in words)), "u64")
    return graph.node("threefry", "u64", *words)


def _new_key(graph: Graph, key: RandomKey, high: Node, low: Node) -> RandomKey:
    """Return a new random key: the two 32-bit words of the hash of a counter by a key.

    The counter's words `high` and `low`, and the key's, are nodes: the hash is an operation of the program (`graph`).
    """
    bits = threefry(graph, key, high, low)
    upper = graph.node("shift_right", "u64", bits, graph.constant(32, "u64"))
    return RandomKey(graph.node("convert", "u32", upper), graph.node("convert", "u32", bits))


def _make_keys(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return an array (...) of random keys made of the nodes of their two words, an array (..., 2)."""
    _check_key_type(equation.outvars[0])
    return [make_keys(inputs[0])]


def _read_key_words(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return the two words of each random key: an array (..., 2) of nodes from an array (...) of keys."""
    _check_key_type(equation.invars[0])
    words = [word for key in inputs[0].ravel().tolist() for word in (key.first, key.second)]
    return [arrange_nodes(words, result_shape(equation))]


def _fold_in(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return for each pair of a random key and a number a new key: the hash of the words (0, number) by the key.

    The inputs are arrays of keys and of nodes, the scalar operations of the program; numbers may depend on data.
    """
    _check_key_type(equation.invars[0])
    shape, zero = result_shape(equation), lowering.graph.constant(0, "u32")
    pairs = zip(*broadcast_entries(inputs, shape), strict=True)
    return [arrange_nodes([_new_key(lowering.graph, key, zero, number) for key, number in pairs], shape)]


def _split(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return for each random key as many new ones as the operation's shape has entries (JAX's `split`).

    New key i is the hash of the counter i by the key, an operation of the program.
    """
    _check_key_type(equation.invars[0])
    graph, counters = lowering.graph, _make_counters(lowering.graph, equation.params["shape"])
    keys = [_new_key(graph, key, *counter) for key in inputs[0].ravel().tolist() for counter in counters]
    return [arrange_nodes(keys, result_shape(equation))]


def _bits(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return random bits for each key: the hashes of 0, 1, 2, ... by the key.

    A hash has 64 bits. If 32 bits are asked for, its two halves are combined by exclusive or.
    """
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
    """Return for each seed, an integer node, the random key whose two words are its upper and its lower 32 bits."""
    _check_key_type(equation.outvars[0])
    graph = lowering.graph

    def make_key(seed: Node) -> RandomKey:
        """Return the key of a seed: its upper 32 bits and its lower 32 bits; a seed of 32 bits has 0 as upper bits."""
        if seed.type[1:] == "32":
            return RandomKey(graph.constant(0, "u32"), graph.node("convert", "u32", seed))
        bits = graph.node("convert", "u64", seed)
        upper = graph.node("shift_right", "u64", bits, graph.constant(32, "u64"))
        return RandomKey(graph.node("convert", "u32", upper), graph.node("convert", "u32", bits))

    return [arrange_nodes(map(make_key, inputs[0].ravel().tolist()), result_shape(equation))]


def _hash_word_pairs(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return the two words of each Threefry hash, in two arrays, as JAX's operation `threefry2x32` does.

    The inputs are four arrays: the keys' two words, and the counters' two words.
    """
    shape = result_shape(equation)
    items = zip(*broadcast_entries(inputs, shape), strict=True)
    keys = [_new_key(lowering.graph, RandomKey(first, second), high, low) for first, second, high, low in items]
    return [arrange_nodes([key.first for key in keys], shape), arrange_nodes([key.second for key in keys], shape)]


def _gamma(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> Any:
    """Return random gamma variables by JAX's own program, a loop until a proposal is accepted, written in its place."""
    gamma: Any = equation.primitive.impl
    avals: list[Any] = [v.aval for v in equation.invars]
    program = jax.make_jaxpr(lambda *args: gamma(*args, **equation.params))(*avals)
    return [lowering.nodes(x) for x in lowering.inline_program(program, inputs)]


def _return_keys(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return the random keys as they are: a copy of a key (JAX's `random_clone`) is the same key."""
    return inputs


def _make_counters(graph: Graph, shape: tuple[int, ...]) -> list[tuple[Node, Node]]:
    """Return the counters 0, 1, 2, ..., one for each entry of a shape, each as two words (upper, lower).

    More than LOADED counters raise Unsupported at once. So many hashes make a program too long, and it would take long
    to write them until they are refused.
    """
    if math.prod(shape) > LOADED:
        raise Unsupported(f"{math.prod(shape):,} random numbers at once")
    return [(graph.constant(i >> 32, "u32"), graph.constant(i & 0xFFFFFFFF, "u32")) for i in range(math.prod(shape))]


def _check_key_type(variable: Any) -> None:
    """Raise Unsupported unless keys are of JAX's default kind (Threefry) and jax_threefry_partitionable is set.

    That option decides which counters are hashed.
    """
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
    """Return the 64-bit Threefry hash of a counter (words `high`, `low`) by a key (words `first`, `second`).

    All words have 32 bits. There are 20 rounds of addition, rotation and exclusive or. ROTATIONS says by how many bits
    each round rotates. Words of the key are added after every four rounds; the third word is made with PARITY, a
    constant of Threefry's definition.
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

    It is how JAX makes random bits. (a, b) are the key's two words of 32 bits, (x, y) the counter's, in each SIMD lane
    of a vector; the result has the hash's first word in its upper 32 bits and the second in its lower ones. `%i32` and
    `%i64` are names of vector types in the text.
    """
    vector, wide = "%i32", "%i64"
    lines: list[str] = []

    def op(text: str) -> str:
        """Append an instruction, given without its result; return the new name of its result."""
        lines.append(f"  %t{len(lines)} = {text}")
        return f"%t{len(lines) - 1}"

    # Key schedule: k_0 = a, k_1 = b, k_2 = k_0 ^ k_1 ^ parity. First the key's words are added to the counter's.
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
