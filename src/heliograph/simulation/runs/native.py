"""Monte Carlo by native code: a whole run as straight-line code in a loop over time.

The program is made once for networks that differ in numbers alone: their arrays are its arguments, common to all runs.
Their zeros and ones are known when the program is made, to save operations.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr

from heliograph.codegen.accumulated import Accumulated, Begun
from heliograph.codegen.lowering import Lowering, array_of, keys_of, traced
from heliograph.codegen.memory import LONG, InMemory
from heliograph.codegen.nodes import Buffer, Type, Unsupported
from heliograph.codegen.program import Program, Summed
from heliograph.numerics.types import PyTree
from heliograph.simulation.results.reducer import AbstractReducer, OfStep
from heliograph.simulation.results.statistics import BATCHES
from heliograph.simulation.smoothed import Smoother, reduced_run
from heliograph.simulation.world import World

PROGRAMS = 64  # whose code is held at once
PLAIN = (0.0, 1.0, -1.0)  # numbers that are known in a program


class Native(NamedTuple):
    """A program for a network, with the network's numbers; `tree` is the structure of what is collected of a run."""

    begun: Begun
    tree: Any


def native(
    world: World, inputs: np.ndarray, key: jax.Array, reducer: AbstractReducer[Any], later: Smoother | None = None
) -> Native:
    """Compile the native code of a network's runs, of which a reducer collects the results of its `of_step`.

    With `later`, the results are a pair: of filtered and of smoothed estimates; and sums of the NIS.

    Raises:
        Unsupported: a program that native code does not support.
    """
    if str(key.dtype) != "key<fry>":
        raise Unsupported(f"keys of type {key.dtype}")
    # Arrays are arguments; everything else is part of the program.
    leaves, tree = jax.tree.flatten((world, later, inputs, reducer))
    held = tuple(not eqx.is_array(leaf) for leaf in leaves)
    fixed = tuple(leaf if h else None for leaf, h in zip(leaves, held, strict=True))
    arrays = [np.asarray(leaf) for leaf, h in zip(leaves, held, strict=True) if not h]
    # One program for networks of one structure.
    try:
        made = _made(tree, held, fixed, tuple(map(_Known.of, arrays)), bool(jax.threefry_partitionable.value))
    except TypeError as error:
        if "unhashable" not in str(error):
            raise
        raise Unsupported("a network with an object that cannot be compared with another") from None
    if isinstance(made, Unsupported):
        raise Unsupported(made.operation, made.where)
    program, form = made
    words = np.asarray(jax.random.key_data(key))
    return Native(program.begin([words, *(a for a in arrays if _is_given(a))]), form)


class _Known:
    """Knowledge of an array when a program is made: its shape and type, zeros and ones, and all entries of integers."""

    def __init__(self, shape: tuple[int, ...], kind: str, known: bytes, values: bytes):
        self.shape, self.kind, self.known, self.values = shape, kind, known, values
        self.key = shape, kind, known, values

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Known) and self.key == other.key

    @classmethod
    def of(cls, array: np.ndarray) -> "_Known":
        """Describe an array."""
        known = np.isin(array, PLAIN) if array.dtype.kind == "f" else np.full(array.shape, not _is_given(array))
        if array.size > LONG and _is_given(array):
            known[...] = False
        values = np.where(known, array, 0).astype(array.dtype)
        return cls(array.shape, array.dtype.str, known.tobytes(), values.tobytes())

    def numbers(self) -> tuple[np.ndarray, np.ndarray]:
        """Mask of the entries that are known, and these, zeros in place of the others."""
        known = np.frombuffer(self.known, dtype=bool).reshape(self.shape)
        return known, np.frombuffer(self.values, dtype=self.kind).reshape(self.shape)


def _is_given(array: np.ndarray) -> bool:
    """Test whether an array is an argument of a program: reals, and checksums of names. Other integers are known."""
    return array.dtype.kind == "f" or array.dtype == np.uint32


@lru_cache(PROGRAMS)
def _made(
    tree: Any, held: tuple[bool, ...], fixed: tuple[Any, ...], known: tuple[_Known, ...], counting: bool
) -> tuple[Accumulated, Any] | Unsupported:
    """Cached `_program`, or why there is none. It depends on JAX's way to count draws, `counting`."""
    try:
        return _program(tree, held, fixed, known)
    except Unsupported as error:
        return error


def _program(
    tree: Any, held: tuple[bool, ...], fixed: tuple[Any, ...], known: tuple[_Known, ...]
) -> tuple[Accumulated, Any]:
    """Compile the code of networks of one structure; also return the structure of what is collected of a run.

    `held` and `fixed`: the leaves that are no arrays, such as a user's functions.
    """
    form: list[Any] = []

    # One run, from the key, the arrays and the run's number.
    def run(key: jax.Array, *leaves: Any) -> list[jax.Array]:
        *arrays, number = leaves
        items = iter(arrays)
        whole = [value if h else next(items) for value, h in zip(fixed, held, strict=True)]
        world, later, inputs, reducer = jax.tree.unflatten(tree, whole)
        run_key, u = jax.random.fold_in(key, number), jnp.asarray(inputs)
        reduced = _run(world, u, reducer, run_key) if later is None else _smoothed(world, later, u, reducer, run_key)
        summed = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=float), (reduced.sums, reduced.ever))
        results, structure = jax.tree.flatten(OfStep(summed[0], summed[1], reduced.collected))
        form[:] = [structure, len(jax.tree.leaves(summed))]
        return results

    # Traced in double precision, with the shapes alone.
    struct: Any = jax.ShapeDtypeStruct
    with jax.enable_x64(True):
        shapes: list[Any] = [struct(k.shape, np.dtype(k.kind)) for k in known]
        key = jax.eval_shape(lambda: jax.random.key(0))
        made, _ = traced(run, key, *shapes, struct((), jnp.uint32))
        program = _lowered(made, known)
    # Sums over runs by batch; the rest is collected.
    structure, count = form
    numbers = len(program.inputs) - 1
    summed = tuple(n < count for n in range(len(program.outputs)))
    return Accumulated(program, Summed(summed, BATCHES, numbers)), structure


def _run(world: World, inputs: jax.Array, reducer: AbstractReducer[Any], key: jax.Array) -> OfStep:
    """Collect the results of a run: stacked over time, but for flags that hold if true at any step."""

    def step(state: PyTree, row: tuple[jax.Array, jax.Array]) -> tuple[PyTree, OfStep]:
        state, outputs = world.step(state, key, row)
        return state, reducer.of_step(outputs)

    _, recorded = jax.lax.scan(step, world.init(key), (jnp.arange(len(inputs)), inputs))
    return recorded._replace(ever=jax.tree.map(lambda leaf: jnp.any(leaf, axis=0), recorded.ever))


def _smoothed(
    world: World, later: Smoother, inputs: jax.Array, reducer: AbstractReducer[Any], key: jax.Array
) -> OfStep:
    """Collect the results of a run's filtered and smoothed estimates, from the whole run with its smoother steps."""

    def step(state: PyTree, row: tuple[jax.Array, jax.Array]) -> tuple[PyTree, PyTree]:
        return world.step(state, key, row)

    _, outputs = jax.lax.scan(step, world.init(key), (jnp.arange(len(inputs)), inputs))
    return reduced_run(reducer, later, outputs)


def _lowered(made: ClosedJaxpr, known: Sequence[_Known]) -> Program:
    """Graph of a traced run: inputs are the key, the arrays that are arguments, and the run's number."""
    lowering = Lowering()
    graph = lowering.graph
    # Key and number of the run.
    words = Buffer("input", "u32", (2,), graph.top)
    number = Buffer("input", "u32", (), graph.top)
    inputs = [words]
    values: list[Any] = [keys_of(InMemory.whole(words).nodes(graph))]
    # Known arrays are constants; of arguments only zeros and ones are.
    for leaf in known:
        fixed, numbers = leaf.numbers()
        if not _is_given(numbers):
            values.append(lowering.known(numbers))
            continue
        type: Type = "f64" if numbers.dtype.kind == "f" else "u32"
        buffer = Buffer("input", type, leaf.shape, graph.top)
        inputs.append(buffer)
        if numbers.size > LONG:
            values.append(InMemory.whole(buffer))
        else:
            entries = zip(fixed.ravel().tolist(), numbers.ravel().tolist(), range(numbers.size), strict=True)
            values.append(
                array_of([graph.constant(x, type) if f else graph.load(buffer, i) for f, x, i in entries], leaf.shape)
            )
    # The program of one run.
    values.append(InMemory.whole(number))
    outputs = lowering.inline(made, values)
    return Program(graph, [*inputs, number], outputs, None)
