"""Graphs as functions of JAX, operation by operation on scalars: `vmap` makes them arrays of runs, for any device.

XLA then has nothing but elementwise operations, which it fuses; derivatives are those of the scalar operations.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from straightline.constant_folding import DTYPES
from straightline.nodes import Block, Buffer, Guard, Loop, LoopExit, Node, Store, Unsupported
from straightline.program import Program, list_needed_items
from straightline.rules.random_bits import hash_words
from straightline.strided_arrays import StridedArray

lax = jax.lax
OPERATIONS: dict[str, Callable[..., jax.Array]] = {
    "threefry": hash_words,
    "select": lax.select, "not": lax.bitwise_not, "and": lax.bitwise_and, "or": lax.bitwise_or, "xor": lax.bitwise_xor,
    "shift_right": lax.shift_right_logical, "shift_right_signed": lax.shift_right_arithmetic,
    "round_away": partial(lax.round, rounding_method=lax.RoundingMethod.AWAY_FROM_ZERO),
    "round_even": partial(lax.round, rounding_method=lax.RoundingMethod.TO_NEAREST_EVEN),
}  # fmt: skip
Memory = dict[Buffer, jax.Array]  # numbers of one run


def make_jax_function(program: Program) -> Callable[..., PyTree]:
    """Return the function of one run's arrays that a program computes, for JAX to trace, map and differentiate."""
    return lambda *arrays: jax.tree.unflatten(program.tree, _JaxEvaluation(program).evaluate(arrays))


class _JaxEvaluation:
    """Evaluation of a program's graph by JAX, operation by operation, while JAX traces the function.

    A node is a scalar operation; a buffer is an array in memory that the program reads or fills.
    """

    def __init__(self, program: Program):
        """Find the nodes that a program's results need (`needed`); raise Unsupported if a result is a random key.

        `values` will hold the value of each node, and `memory` the flat array of each buffer.
        """
        self.program = program
        nodes = [n for x in program.outputs if not isinstance(x, StridedArray) for n in x.ravel().tolist()]
        if not all(isinstance(n, Node) for n in nodes):
            raise Unsupported("keys of random numbers as results")
        self.needed = list_needed_items([*nodes, *(x.buffer for x in program.outputs if isinstance(x, StridedArray))])
        self.values: dict[Node, jax.Array] = {}
        self.memory: Memory = {}

    def evaluate(self, arrays: tuple[Any, ...]) -> list[jax.Array]:
        """Return the results for these arguments, leaf by leaf: each operation of the graph is computed by JAX.

        `self.memory` maps each buffer to a flat array. Inputs and tables begin with their numbers, and buffers that
        the program fills begin with zeros.
        """
        for buffer, array in zip(self.program.inputs, arrays, strict=True):
            self.memory[buffer] = jnp.asarray(array, DTYPES[buffer.type]).reshape(-1)
        for buffer in {x.owner[0] for x in self.needed if isinstance(x, Buffer)} - set(self.memory):
            start = np.zeros(buffer.size) if buffer.table is None else buffer.table.ravel()
            self.memory[buffer] = jnp.asarray(start, DTYPES[buffer.type])
        self.evaluate_block(self.program.graph.top.items)
        return [self._gather_result(x) for x in self.program.outputs]

    def _gather_result(self, value: Any) -> jax.Array:
        """Return a result as an array: either its nodes' values stacked, or its numbers read from memory.

        In memory, entry (i, j, ...) lies at start + offset + strides . (i, j, ...) + sum_k s_k x_k. `value.moves` holds
        pairs (s_k, n_k) of a stride and a node, and x_k is the value of the node n_k.
        """
        if not isinstance(value, StridedArray):
            numbers = [self.value(n) for n in value.ravel().tolist()]
            return jnp.stack(numbers).reshape(value.shape) if numbers else jnp.zeros(value.shape)
        owner, start = value.buffer.owner
        indices = np.indices(value.shape).reshape(value.ndim, -1)
        known_offsets = np.array(value.strides, int) @ indices + start + value.offset
        offsets = sum((stride * self.value(node) for stride, node in value.moves), jnp.asarray(known_offsets))
        return self.memory[owner][offsets].reshape(value.shape)

    def value(self, node: Node) -> jax.Array:
        """Return the value of a node: a constant's number, or what was computed for it."""
        return jnp.asarray(node.value, DTYPES[node.type]) if node.op == "constant" else self.values[node]

    def evaluate_block(self, items: list[Any]) -> None:
        """Evaluate, in order, what the results need of a block, into `values` (by node) and `memory` (by buffer).

        What a loop or guard sets (counter, parameter, result, guarded) has its value already.
        """
        for statement in items:
            if statement not in self.needed:  # a check of a loop among them
                continue
            if isinstance(statement, Store):
                entry = self._locate_entry(statement.buffer, statement.offset, statement.strides, statement.indices)
                owner = statement.buffer.owner[0]
                self.memory[owner] = self.memory[owner].at[entry].set(self.value(statement.node))
            elif isinstance(statement, Loop):
                self._evaluate_loop(statement)
            elif isinstance(statement, Guard):
                self._evaluate_guard(statement)
            elif statement.op not in ("counter", "parameter", "result", "guarded"):
                self.values[statement] = self._evaluate_node(statement)

    def _evaluate_node(self, node: Node) -> jax.Array:
        """Return a node's value, computed by JAX.

        OPERATIONS maps some names of operations to functions; any other is the function of `jax.lax` of that name.
        """
        if node.op == "load":
            buffer, offset, strides = node.value
            return self.memory[buffer.owner[0]][self._locate_entry(buffer, offset, strides, node.args)]
        arguments = [self.value(a) for a in node.args]
        if node.op == "convert":
            return arguments[0].astype(DTYPES[node.type])
        if node.op == "bitcast":
            return lax.bitcast_convert_type(arguments[0], DTYPES[node.type])
        if node.op == "threefry":
            arguments = [a.astype(np.uint64) for a in arguments]
        operation = OPERATIONS[node.op] if node.op in OPERATIONS else getattr(lax, node.op)
        computed: jax.Array = operation(*arguments)
        return computed

    def _locate_entry(self, buffer: Buffer, offset: int, strides: tuple[int, ...], indices: tuple[Node, ...]) -> Any:
        """Return the index of buffer[offset + sum strides * indices] in the outermost buffer that contains it.

        The indices are nodes, so that the index is a number that JAX computes.
        """
        pairs = zip(strides, indices, strict=True)
        return sum((s * self.value(i) for s, i in pairs), buffer.owner[1] + offset)

    def _find_filled(self, block: Block) -> list[Buffer]:
        """Return the buffers that a block, or a block inside it, stores into, in the order of the stores."""
        stores = [x for x in self.needed if isinstance(x, Store) and block in x.block.list_enclosing_blocks()]
        return list(dict.fromkeys(x.buffer.owner[0] for x in sorted(stores, key=lambda x: x.node.serial)))

    def _evaluate_loop(self, loop: Loop) -> None:
        """Evaluate a loop by JAX's loop, and note its results.

        A graph of scalar operations is evaluated by JAX, so that XLA can compile it. `loop` has nodes for each carried
        number: its `initial` value, its `parameters` in the body, its `following` value at an iteration's end, and its
        `results` after the loop. The carry of JAX's loop is a pair: numbers, one for each parameter whose index is in
        `carried` (the others are not needed), and arrays, one for each buffer that the body fills (`filled`). Values
        computed in an iteration hold in that iteration alone: after the loop `self.values` is the outer dictionary
        again.
        """
        pairs = zip(loop.parameters, loop.results, strict=True)
        carried = [k for k, pair in enumerate(pairs) if {*pair} & self.needed.keys()]  # indices in loop.parameters
        filled, outer_values, outer_memory = self._find_filled(loop.body), self.values, self.memory

        def begin_iteration(carry: PyTree, counter: Any) -> None:
            """Set `self.values` and `self.memory` to what is known outside the loop and this iteration's carry."""
            numbers, arrays = carry
            self.values, self.memory = dict(outer_values), outer_memory | dict(zip(filled, arrays, strict=True))
            self.values |= zip((loop.parameters[k] for k in carried), numbers, strict=True)
            if loop.counter is not None:
                self.values[loop.counter] = jnp.asarray(counter, np.int64)

        def run_iteration(counter: Any, carry: PyTree) -> PyTree:
            """Return the carry after an iteration of the loop.

            It is a pair: the numbers that the next iteration gets for the parameters in `carried`, and the arrays that
            the buffers in `filled` hold.
            """
            begin_iteration(carry, counter)
            self.evaluate_block(loop.body.items)
            return [self.value(loop.following[k]) for k in carried], [self.memory[b] for b in filled]

        def goes_on(carry: PyTree) -> jax.Array:
            """Return whether the loop goes on: compute the body up to its check, and return the loop's condition."""
            begin_iteration(carry, 0)  # a loop that ends by a condition has no counter
            check = next(i for i, x in enumerate(loop.body.items) if isinstance(x, LoopExit))
            self.evaluate_block(loop.body.items[:check])
            assert loop.condition is not None
            return self.value(loop.condition)

        # From the first carry to the last, whose values are the loop's results.
        start = [self.value(loop.initial[k]) for k in carried], [outer_memory[b] for b in filled]
        if loop.length is None:
            numbers, arrays = lax.while_loop(goes_on, lambda carry: run_iteration(0, carry), start)
        else:
            numbers, arrays = lax.fori_loop(0, loop.length, run_iteration, start)
        self.values, self.memory = outer_values, outer_memory | dict(zip(filled, arrays, strict=True))
        self.values |= zip((loop.results[k] for k in carried), numbers, strict=True)

    def _evaluate_guard(self, guard: Guard) -> None:
        """Evaluate a guarded block where its condition holds, and note its results, which are zeros elsewhere."""
        used = [k for k, r in enumerate(guard.results) if r in self.needed]
        filled, outer_values, outer_memory = self._find_filled(guard.body), self.values, self.memory

        def evaluate_body() -> PyTree:
            """Return the guarded block's values that are used outside it, and the arrays of the buffers that it fills.

            `used` holds indices into `guard.values`, and `filled` the buffers. `self.values` and `self.memory` begin as
            they are outside the block.
            """
            self.values, self.memory = dict(outer_values), dict(outer_memory)
            self.evaluate_block(guard.body.items)
            return [self.value(guard.values[k]) for k in used], [self.memory[b] for b in filled]

        zeros = [jnp.zeros((), DTYPES[guard.results[k].type]) for k in used]
        unchanged = [outer_memory[b] for b in filled]
        numbers, arrays = lax.cond(self.value(guard.condition), evaluate_body, lambda: (zeros, unchanged))
        self.values, self.memory = outer_values, outer_memory | dict(zip(filled, arrays, strict=True))
        self.values |= zip((guard.results[k] for k in used), numbers, strict=True)
