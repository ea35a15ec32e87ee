"""Monte Carlo by native code: a whole run as one straight line of operations in a loop over time.

The program is made once for networks that differ in numbers alone: their arrays are its arguments, which all runs
share. Zeros and ones in them are known, for what they spare.
"""

from collections.abc import Sequence
from functools import lru_cache, reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr

from heliograph.codegen.accumulated import Accumulated, Begun
from heliograph.codegen.compiled import threads
from heliograph.codegen.graph import Buffer, Unsupported
from heliograph.codegen.lowering import Lowering, array_of, keys_of, traced
from heliograph.codegen.memory import LONG, InMemory
from heliograph.codegen.program import Program
from heliograph.codegen.summed import Summed, folded
from heliograph.numerics.types import PyTree
from heliograph.simulation.lanes import BLOCK, LANES
from heliograph.simulation.reducer import AbstractReducer, OfStep
from heliograph.simulation.statistics import BATCHES
from heliograph.simulation.world import World

PROGRAMS = 64  # whose code is held at once
PLAIN = (0.0, 1.0, -1.0)  # numbers that are known in a program


class Native(NamedTuple):
    """A program for a network, with the network's numbers; `tree` is the structure of what is kept of a run."""

    begun: Begun
    tree: Any


def native(world: World, inputs: np.ndarray, key: jax.Array, reducer: AbstractReducer[Any]) -> Native:
    """The native code of a network's runs, of which a reducer keeps what its `of_step` says.

    Raises:
        Unsupported: a program that native code does not take.
    """
    if type(reducer).of_step is AbstractReducer.of_step:
        raise Unsupported(f"{type(reducer).__name__}, which has no of_step")
    if str(key.dtype) != "key<fry>":
        raise Unsupported(f"keys of type {key.dtype}")
    leaves, tree = jax.tree.flatten((world, inputs, reducer))
    held = tuple(not eqx.is_array(leaf) for leaf in leaves)
    fixed = tuple(leaf if h else None for leaf, h in zip(leaves, held, strict=True))
    arrays = [np.asarray(leaf) for leaf, h in zip(leaves, held, strict=True) if not h]
    try:
        program, form = _program(tree, held, fixed, tuple(map(_Known.of, arrays)))
    except TypeError as error:
        if "unhashable" not in str(error):
            raise
        raise Unsupported("a network that holds what cannot be told from another") from None
    words = np.asarray(jax.random.key_data(key))
    return Native(program.begin([words, *(a for a in arrays if _is_given(a))]), form)


class _Known:
    """What is known of an array when a program is made: its shape and type, zeros and ones, and all of integers."""

    def __init__(self, shape: tuple[int, ...], kind: str, known: bytes, values: bytes):
        self.shape, self.kind, self.known, self.values = shape, kind, known, values
        self.key = shape, kind, known, values

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Known) and self.key == other.key

    @classmethod
    def of(cls, array: np.ndarray) -> "_Known":
        """Of an array."""
        known = np.isin(array, PLAIN) if _is_given(array) else np.ones(array.shape, dtype=bool)
        if array.size > LONG and _is_given(array):
            known[...] = False
        values = np.where(known, array, 0).astype(array.dtype)
        return cls(array.shape, array.dtype.str, known.tobytes(), values.tobytes())

    def numbers(self) -> tuple[np.ndarray, np.ndarray]:
        """Which entries are known, and these, zeros in place of the others."""
        known = np.frombuffer(self.known, dtype=bool).reshape(self.shape)
        return known, np.frombuffer(self.values, dtype=self.kind).reshape(self.shape)


def _is_given(array: np.ndarray) -> bool:
    """Whether an array's numbers are arguments of a program: those of integers decide what it is."""
    return array.dtype.kind == "f"


@lru_cache(PROGRAMS)
def _program(
    tree: Any, held: tuple[bool, ...], fixed: tuple[Any, ...], known: tuple[_Known, ...]
) -> tuple[Accumulated, Any]:
    """The code of networks of one structure, and the structure of what is kept of a run.

    `held` and `fixed`: the leaves that are no numbers, a user's functions say.
    """
    form: list[Any] = []

    def run(key: jax.Array, *leaves: Any) -> list[jax.Array]:
        *arrays, number = leaves
        each = iter(arrays)
        whole = [value if h else next(each) for value, h in zip(fixed, held, strict=True)]
        world, inputs, reducer = jax.tree.unflatten(tree, whole)
        found = _run(world, jnp.asarray(inputs), reducer, jax.random.fold_in(key, number))
        summed = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=float), (found.sums, found.ever))
        results, structure = jax.tree.flatten(OfStep(*summed, found.collected))
        form[:] = [structure, len(jax.tree.leaves(summed))]
        return results

    with jax.enable_x64(True):
        shapes = [jax.ShapeDtypeStruct(k.shape, np.dtype(k.kind)) for k in known]
        key = jax.eval_shape(lambda: jax.random.key(0))
        made, _ = traced(run, key, *shapes, jax.ShapeDtypeStruct((), jnp.uint32))
        program = _lowered(made, known)
    structure, count = form
    numbers = len(program.inputs) - 1
    summed = tuple(n < count for n in range(len(program.outputs)))
    return Accumulated(program, Summed(summed, BATCHES, numbers)), structure


def _run(world: World, inputs: jax.Array, reducer: AbstractReducer[Any], key: jax.Array) -> OfStep:
    """What is kept of a run: stacked over time, but for what was ever so at some step."""

    def step(state: PyTree, row: tuple[jax.Array, jax.Array]) -> tuple[PyTree, OfStep]:
        state, found = world.step(state, key, row)
        return state, reducer.of_step(found)

    _, kept = jax.lax.scan(step, world.init(key), (jnp.arange(len(inputs)), inputs))
    return kept._replace(ever=jax.tree.map(lambda leaf: jnp.any(leaf, axis=0), kept.ever))


def _lowered(made: ClosedJaxpr, known: Sequence[_Known]) -> Program:
    """The graph of a traced run: inputs are the key, the arrays that are given, and the run's number."""
    lowering = Lowering()
    graph = lowering.graph
    words = Buffer("input", "u32", (2,), graph.top)
    number = Buffer("input", "u32", (), graph.top)
    inputs, values = [words], [keys_of(InMemory.whole(words).nodes(graph))]
    for one in known:
        fixed, numbers = one.numbers()
        if numbers.dtype.kind != "f":
            values.append(lowering.known(numbers))
            continue
        buffer = Buffer("input", "f64", one.shape, graph.top)
        inputs.append(buffer)
        if numbers.size > LONG:
            values.append(InMemory.whole(buffer))
        else:
            entries = zip(fixed.ravel().tolist(), numbers.ravel().tolist(), range(numbers.size), strict=True)
            values.append(
                array_of([graph.constant(x, "f64") if f else graph.load(buffer, i) for f, x, i in entries], one.shape)
            )
    values.append(InMemory.whole(number))
    outputs = lowering.inline(made, values)
    return Program(graph, [*inputs, number], outputs, None)


class NativeLanes:
    """Blocks of runs dealt to lanes, each with sums of its own: as `Lanes`, computed by native code.

    Block j goes to lane j mod LANES whatever the number of cores, and each lane adds its blocks in order, so that
    neither chunks nor cores change a bit of a result.
    """

    def __init__(self, code: Native, first_run: int, stop: int):
        self.code, self.first_run, self.stop = code, first_run, stop
        self.sums: list[list[np.ndarray] | None] = [None] * LANES

    def blocks_of(self, runs: int) -> int:
        """Blocks of a chunk that holds this many runs at least: fewer than there are lanes, or a multiple of them."""
        blocks = -(-runs // BLOCK)
        return blocks if blocks < LANES else LANES * -(-blocks // LANES)

    def advance(self, start: int, blocks: int) -> list[np.ndarray | None]:
        """Simulate `blocks` blocks from number `start` on; what is collected of their runs, in order, leaf by leaf."""
        numbers = np.arange(start, start + blocks)
        dealt = {lane: self._runs(numbers[numbers % LANES == lane]) for lane in range(LANES)}
        used = [lane for lane, runs in dealt.items() if len(runs)]

        def go(lane: int) -> list[np.ndarray | None]:
            sums = self.sums[lane] = self.sums[lane] or self.code.begun.zeros()
            return self.code.begun.add(dealt[lane], sums)

        found = list(threads().map(go, used))
        order = np.argsort(np.concatenate([dealt[lane] for lane in used]), kind="stable")
        return [None if each[0] is None else np.concatenate(each)[order] for each in zip(*found, strict=True)]

    def _runs(self, blocks: np.ndarray) -> np.ndarray:
        runs = (self.first_run + BLOCK * blocks[:, None] + np.arange(BLOCK)).ravel()
        return runs[runs < self.stop]

    def total(self, reducer: AbstractReducer[Any]) -> PyTree:
        """The reducer's carry after all runs."""
        used = [sums for sums in self.sums if sums is not None]
        totals = iter([folded(reduce(np.add, parts), BATCHES) for parts in zip(*used, strict=True)])
        code = self.code.begun
        summed = code.program.summed.outputs
        leaves, common = [], []
        for one, is_summed, shared in zip(code.shared, summed, code.program.common, strict=True):
            value = next(totals) if is_summed else None
            leaves.append(one if shared else value)
            common.append(shared)
        count = np.bincount(np.arange(self.first_run, self.stop) % BATCHES, minlength=BATCHES).astype(float)
        sums, same = (jax.tree.unflatten(self.code.tree, x) for x in (leaves, common))
        return reducer.summed(sums, same, count)

    def joined(self, parts: Sequence[list[np.ndarray | None]]) -> PyTree:
        """What was collected of all runs, (run, ...); a view of one where they share it."""
        leaves: list[Any] = []
        for one, *each in zip(self.code.begun.shared, *parts, strict=True):
            if one is not None:
                leaves.append(np.broadcast_to(one, (self.stop - self.first_run, *one.shape)))
            else:
                leaves.append(None if each[0] is None else np.concatenate(each) if len(each) > 1 else each[0])
        return jax.tree.unflatten(self.code.tree, leaves).collected
