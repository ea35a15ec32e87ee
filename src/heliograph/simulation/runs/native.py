"""Monte Carlo by native code: a whole run as straight-line code in a loop over time, of a few nodes at a time.

The program is made once for networks that differ in numbers alone: their arrays are its arguments, common to all runs.
Their zeros and ones are known when the program is made, to save operations.
"""

import os
from collections.abc import Iterator
from functools import lru_cache, partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import make_native_or_none
from heliograph.engine.size_thresholds import BLOCK
from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.types import PyTree
from heliograph.simulation.arguments import Precision
from heliograph.simulation.network import Network
from heliograph.simulation.recordings.smoothed import NetworkSmoother, SmoothingPlan, finish_result, reduce_run
from heliograph.simulation.results.reducer import AbstractReducer, OfStep, Result
from heliograph.simulation.results.statistics import BATCHES
from heliograph.simulation.runs.lanes import LANES, Progress
from heliograph.simulation.runs.memory import NeededMemory, check_memory
from heliograph.simulation.runs.native_lanes import NativeProgram, NativeRuns
from heliograph.simulation.runs.node_parts import NODES, build_world, count_parts, is_apart, split_nodes
from heliograph.simulation.simulation_step import World
from straightline import Unsupported, accumulate

PROGRAMS = 64  # whose code is held at once
PLAIN = (0.0, 1.0, -1.0)  # numbers that are known when a program is made, to save operations
FEW = 64  # numbers of an array at most of which that holds


def compile_runs(
    world: World,
    inputs: np.ndarray,
    key: jax.Array,
    reducer: AbstractReducer[Any],
    runs: int,
    later: NetworkSmoother | None = None,
    precision: Precision = "float64",
) -> NativeProgram:
    """Return the native code of a network's runs, each of them reduced step by step as the reducer says.

    Args:
        world: one step of plant, channels and filters of the network to be simulated.
        inputs: inputs of the plant (horizon, inputs).
        key: random key of all runs.
        reducer: says what is collected of each run: sums over runs, or series.
        runs: about how many runs will follow.
        later: smooths each run; then its results are those of `reduce_run`: of filtered estimates, of smoothed ones,
            and sums of the NIS. None: nothing is smoothed.
        precision: in which runs are computed.

    Raises:
        Unsupported: a program that native code does not support.
    """
    key_words = _read_key(key)
    # One program for networks of one structure: arrays are its arguments.
    (of_world, arrays), (of_rest, others) = _split_world(world), _split_arrays((later, inputs, reducer))
    try:
        compiled = _find_program(of_world, of_rest, bool(jax.threefry_partitionable.value), precision)
    except TypeError as error:  # structures are keys of a cache
        if "unhashable" not in str(error):
            raise
        raise Unsupported("a network with an object that cannot be compared with another") from None
    if isinstance(compiled, Unsupported):
        # The refusal is cached; it is raised afresh, so that the cached one holds no traceback.
        raise Unsupported(compiled.operation, compiled.where)
    program, result_tree = compiled
    return NativeProgram(program.bind_arguments([key_words, *arrays, *others], runs), result_tree)


def check_memory_of_parts(code: NativeProgram, parts: int, runs: int, horizon: int, precision: Precision) -> None:
    """Raise ValueError for runs that need more memory than there is.

    Args:
        code: program of the first part of a network; the other parts are no larger.
        parts: how many parts the network was split into, whose results are held together.
        runs: number of runs.
        horizon: number of steps.
        precision: the precision in which runs are computed.
    """
    # Memory of what is collected, of sums in each lane, and of lanes that run at once.
    lanes = min(LANES, -(-runs // BLOCK))
    threads = min(lanes, os.cpu_count() or 1)
    collected, sums, variables = code.begun.program.measure_memory(runs, lanes, threads)
    collected *= 2 if precision == "float32" else 1  # results are handed back in double precision
    # While the sums of one part are added up, the next part is computed, so that two are held at once.
    sums *= min(parts, 2)
    check_memory(NeededMemory(parts * collected, sums, variables), runs, horizon)


@cache_by_object
def _read_key(key: jax.Array) -> np.ndarray:
    """Return the two words of a random key of Threefry, JAX's default hash, read once for all parts of a network.

    Raises:
        Unsupported: a key of another hash, which native code does not compute.
    """
    if str(key.dtype) != "key<fry>":
        raise Unsupported(f"keys of type {key.dtype}")
    return np.asarray(jax.random.key_data(key))


class _KnownEntries:
    """Knowledge of an array when a program is made: its shape and type, zeros and ones, and all entries of integers.

    Two are equal if all of this is, so that programs are cached by it.
    """

    def __init__(self, shape: tuple[int, ...], kind: str, known: bytes, values: bytes):
        """Hold the shape, the type `kind`, the mask of entries that are known, and all values with 0 for the others."""
        self.shape, self.kind, self.known, self.values = shape, kind, known, values
        self.key = shape, kind, known, values

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _KnownEntries) and self.key == other.key

    @classmethod
    def of(cls, array: np.ndarray) -> "_KnownEntries":
        """Return what is known of an array when a program is made: its shape and type, and the values of some entries.

        Arrays of reals and of checksums are arguments of the program. Zeros and ones of at most FEW reals are known all
        the same, which saves operations. All other integers are part of the program.
        """
        is_known = np.full(array.shape, not _is_argument(array))
        if array.dtype.kind == "f" and array.size <= FEW:
            is_known = _find_zeros_and_ones(array)
        values = np.where(is_known, array, 0).astype(array.dtype)
        return cls(array.shape, array.dtype.str, is_known.tobytes(), values.tobytes())

    @property
    def mask(self) -> np.ndarray:
        """Return which entries are known."""
        return np.frombuffer(self.known, dtype=bool).reshape(self.shape)

    @property
    def example(self) -> np.ndarray:
        """Return an array of the shape and type, with what is known of it, and zeros in place of the other entries."""
        return np.frombuffer(self.values, dtype=self.kind).reshape(self.shape)


def _find_zeros_and_ones(array: np.ndarray) -> np.ndarray:
    """Return the mask of the entries that are 0, 1 or -1 (PLAIN)."""
    return np.asarray(np.logical_or.reduce([array == number for number in PLAIN]))


def _is_argument(array: np.ndarray) -> bool:
    """Return whether an array is an argument of a program: reals, and checksums of names (uint32).

    Other integers are part of the program.
    """
    return array.dtype.kind == "f" or array.dtype == np.uint32


class _Structure(NamedTuple):
    """All of a tree but the numbers of its arrays.

    Args:
        tree: structure of the tree, as JAX has it.
        fixed: leaves that are no arrays, such as a user's functions; None in place of arrays.
        is_fixed: which leaves are no arrays.
        known: what is known of each array when a program is made.
    """

    tree: Any
    fixed: tuple[Any, ...]
    is_fixed: tuple[bool, ...]
    known: tuple[_KnownEntries, ...]

    def restore(self, arrays: Iterator[Any]) -> PyTree:
        """Return the tree with the next of these arrays as its leaves, beside its fixed leaves, which are no arrays."""
        leaves = [leaf if f else next(arrays) for leaf, f in zip(self.fixed, self.is_fixed, strict=True)]
        return jax.tree.unflatten(self.tree, leaves)


def _split_arrays(tree: PyTree) -> tuple[_Structure, tuple[np.ndarray, ...]]:
    """Return a tree's structure, with all leaves that are not arrays, and its arrays.

    `_Structure.restore` makes the tree of both again. Structures with equal known entries of arrays share a program.
    """
    leaves, structure = jax.tree.flatten(tree)
    is_fixed = tuple(not eqx.is_array(leaf) for leaf in leaves)
    fixed = tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves)
    arrays = tuple(np.asarray(leaf) for leaf in leaves if eqx.is_array(leaf))
    return _Structure(structure, fixed, is_fixed, tuple(map(_KnownEntries.of, arrays))), arrays


@cache_by_object
def _split_world(world: World) -> tuple[_Structure, tuple[np.ndarray, ...]]:
    """Return all of a world (plant, channels and filters) but its arrays, and these; once for all its simulations."""
    return _split_arrays(world)


@lru_cache(PROGRAMS)
def _find_program(
    of_world: _Structure, of_rest: _Structure, is_partitionable: bool, precision: Precision
) -> tuple[Any, Any] | Unsupported:
    """Return the program of runs and the structure of what they return, or the reason why there is no program; cached.

    Structures are all but the arrays: of the world (plant, channels and filters), and of (smoother, inputs, reducer).
    `is_partitionable`, JAX's way to number random draws, is read when a program is traced; as an argument it keeps
    programs of both ways apart.
    """
    try:
        return _compile_program(of_world, of_rest, precision)
    except Unsupported as error:
        return Unsupported(error.operation, error.where)  # without its traceback, which holds the program


def _compile_program(of_world: _Structure, of_rest: _Structure, precision: Precision) -> tuple[Any, Any]:
    """Return the code of worlds of one structure, and the structure of what its runs return, as an `OfStep`.

    A world is plant, channels and filters; a run simulates it once, and a reducer makes results from the run's steps.
    Structures are trees without the numbers of their arrays: one program serves worlds that differ in numbers alone.

    Args:
        of_world: structure of the world.
        of_rest: structure of the tuple (smoother that follows the run or None, inputs, reducer).
        precision: "float32" or "float64", in which runs are computed.
    """
    result_trees: list[Any] = []  # one, which is found when `run` is traced

    def run(key: jax.Array, *leaves: Any) -> tuple[PyTree, PyTree]:
        """Return ((sums, flags) to be summed over runs, what is collected) of one run; `leaves`: arrays, its number."""
        *arrays, number = leaves
        # The world's arrays come first, then those of (smoother, inputs, reducer).
        remaining = iter(arrays)
        world, (smoother, inputs, reducer) = of_world.restore(remaining), of_rest.restore(remaining)
        run_key, u = jax.random.fold_in(key, number), jnp.asarray(inputs)
        if smoother is None:
            reduced = _simulate_run(world, u, reducer, run_key)
        else:
            reduced = _simulate_smoothed_run(world, smoother, u, reducer, run_key)
        # Flags are summed over runs like numbers: a flag holds for a batch of runs if its sum is above zero.
        sums, ever = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=float), (reduced.sums, reduced.ever))
        result_trees[:] = [jax.tree.structure(OfStep(sums, ever, reduced.collected))]
        return (sums, ever), reduced.collected

    # The program is traced with a random key (argument 0) and examples of all arrays (arguments 1, 2, ...). The masks
    # mark entries of these whose values are known now, so that the compiler may use them.
    key, known = jax.eval_shape(lambda: jax.random.key(0)), of_world.known + of_rest.known
    masks = {i: entries.mask for i, entries in enumerate(known, start=1) if entries.mask.any()}
    single = precision == "float32"
    program = accumulate(run, key, *(entries.example for entries in known), batches=BATCHES, known=masks, single=single)
    return program, result_trees[0]


@eqx.filter_jit
def _step_world(world: World, state: PyTree, key: jax.Array, row: tuple[jax.Array, jax.Array]) -> tuple[PyTree, PyTree]:
    """Step plant, channels and filters as `World.step` does, traced once for worlds that differ in numbers alone.

    The trace serves runs of every length, and every reducer.
    """
    return world.step(state, key, row)


def _simulate_run(world: World, inputs: jax.Array, reducer: AbstractReducer[Any], key: jax.Array) -> OfStep:
    """Return what the reducer makes of one run with these inputs (horizon, inputs), stacked over time.

    The world is plant, channels and filters. A flag of the reducer (`ever`) holds if it is True at any step.
    """

    def step(state: PyTree, row: tuple[jax.Array, jax.Array]) -> tuple[PyTree, OfStep]:
        """Step the world (plant, channels and filters), and return what the reducer makes of the step."""
        state, outputs = _step_world(world, state, key, row)
        return state, reducer.of_step(outputs)

    _, recorded = jax.lax.scan(step, world.init(key), (jnp.arange(len(inputs)), inputs))
    return recorded._replace(ever=jax.tree.map(lambda leaf: jnp.any(leaf, axis=0), recorded.ever))


def _simulate_smoothed_run(
    world: World, smoother: NetworkSmoother, inputs: jax.Array, reducer: AbstractReducer[Any], key: jax.Array
) -> OfStep:
    """Return what the reducer makes of one run: of its filtered estimates and of its smoothed ones, a pair of each.

    The world is plant, channels and filters. `smoother` smooths their estimates when the run is over.
    """

    def step(state: PyTree, row: tuple[jax.Array, jax.Array]) -> tuple[PyTree, PyTree]:
        """Step the world, and return all outputs of the step: they are reduced when the whole run is smoothed."""
        return _step_world(world, state, key, row)

    _, outputs = jax.lax.scan(step, world.init(key), (jnp.arange(len(inputs)), inputs))
    return reduce_run(reducer, smoother, outputs)


def simulate_natively(
    network: Network,
    inputs: np.ndarray,
    key: jax.Array,
    reducer: AbstractReducer[Result],
    first_run: int,
    runs: int,
    chunk: int,
    progress: Progress | None,
    smoothing: SmoothingPlan | None = None,
    precision: Precision = "float64",
) -> Result | None:
    """Simulate a network by native code, and return what the reducer makes of its runs.

    The result is None where native code does not support the network or the reducer.

    Args:
        network: the network.
        inputs: of the plant (horizon, inputs).
        key: of all runs.
        reducer: says which statistics or series are collected from the runs.
        first_run: number of the first run, which seeds its draws.
        runs: number of runs.
        chunk: number of runs between two reports of progress.
        progress: is called with how many runs are done, and of how many.
        smoothing: the part of the network that is smoothed; None if nothing is.
        precision: in which runs are computed.
    """
    # More than NODES nodes that share nothing but the plant go in parts, if the reducer can join the parts' results.
    can_be_split = smoothing is None and len(network.names) > NODES and is_apart(network)
    if can_be_split and type(reducer).joined is not AbstractReducer.joined:
        return _simulate_in_parts(network, inputs, key, reducer, (first_run, runs, chunk), progress, precision)
    make = partial(compile_network_runs, network, inputs, key, reducer, runs, smoothing, precision=precision)
    code = make_native_or_none(make)
    if code is None:
        return None
    check_memory_of_parts(code, parts=1, runs=runs, horizon=len(inputs), precision=precision)
    recorded = NativeRuns(code, first_run, runs, chunk).complete(progress)
    return finish_result(reducer, recorded, network, smoothing)


def _simulate_in_parts(
    network: Network,
    inputs: np.ndarray,
    key: jax.Array,
    reducer: AbstractReducer[Result],
    span: tuple[int, int, int],
    progress: Progress | None,
    precision: Precision,
) -> Result | None:
    """Simulate a network of many independent nodes, a few at a time, by one program with other numbers for each few.

    The result is as of all at once: draws depend on names, and the nodes share only the plant, which is simulated
    again. `span`: number of the first run, number of runs, and of runs between two reports of progress. `reducer`: says
    what is collected from runs, and joins the parts. None if native code does not support the network or the reducer.
    """
    first_run, runs, chunk = span
    parts, memory = count_parts(network), list[list[np.ndarray]]()
    results: list[Result] = []

    def finish_part(started: NativeRuns, part: Network) -> None:
        """Append the results of the next part of the network to `results`, and report progress in the whole."""

        def show_progress(done: int, total: int) -> None:
            if progress is not None:
                progress((len(results) * total + done) // parts, total)

        results.append(finish_result(reducer, started.complete(show_progress), part, smoothing=None))

    # Threads compute a part while the part before it is finished and the next one is made ready.
    running: tuple[NativeRuns, Network] | None = None
    for some, world in split_nodes(network):
        make = partial(compile_runs, world, inputs, key, reducer, runs, precision=precision)
        code = make_native_or_none(make)
        if code is None:
            return None
        if running is None:
            check_memory_of_parts(code, parts, runs, len(inputs), precision)
        started = NativeRuns(code, first_run, runs, chunk, memory)
        if running is not None:
            finish_part(*running)
        running = started, some
    if running is not None:
        finish_part(*running)
    return reducer.joined(results, network)


def compile_network_runs(
    network: Network,
    inputs: np.ndarray,
    key: jax.Array,
    reducer: AbstractReducer[Any],
    runs: int,
    smoothing: SmoothingPlan | None = None,
    precision: Precision = "float64",
) -> NativeProgram:
    """Return the native code of a network's runs, compiled from its world: plant, channels and filters.

    `smoothing`: which estimates are smoothed; None for none.
    """
    world = build_world(network, None if smoothing is None else smoothing.stacks)
    smoother = None if smoothing is None else smoothing.smoother(world.filters)
    return compile_runs(world, inputs, key, reducer, runs, smoother, precision=precision)
