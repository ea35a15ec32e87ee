"""Monte Carlo: the world and every filter in it, simulated run by run in blocks."""

import os
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.engine.size_thresholds import BLOCK
from heliograph.model.over_time import first
from heliograph.numerics.check import check_count, check_progress, fail, instance
from heliograph.numerics.float64 import quickly_compiled, refuse_forked_process
from heliograph.numerics.module import Module
from heliograph.numerics.types import ArrayLike, Float, PyTree
from heliograph.random_affine.memories_of_channels import number_unnamed_memories
from heliograph.simulation.arguments import Precision, check_precision, make_run_key, read_plant_inputs
from heliograph.simulation.mesh.building import build_meshes
from heliograph.simulation.network import Network
from heliograph.simulation.network_filters import AllFilters
from heliograph.simulation.node import Node
from heliograph.simulation.precomputed_filters import can_precompute, precompute_filters
from heliograph.simulation.recordings.smoothed import (
    NetworkSmoother,
    ReducedRuns,
    finish_result,
    reduce_run,
    select_smoothed_part,
)
from heliograph.simulation.results.non_finite_warnings import warn_of_non_finite_numbers
from heliograph.simulation.results.record import Record
from heliograph.simulation.results.reducer import AbstractReducer, OfStep, Result, Trajectories
from heliograph.simulation.results.statistics import BATCHES
from heliograph.simulation.runs.lanes import (
    LANES,
    RunLanes,
    SharedResult,
    add_sums,
    advance_in_chunks,
    count_runs_by_batch,
    has_processor_alone,
    is_shared,
    split_into_chunks,
)
from heliograph.simulation.runs.memory import NeededMemory, check_memory, count_bytes, explain_out_of_memory
from heliograph.simulation.runs.native import simulate_natively
from heliograph.simulation.runs.xla_runs import apply_to_each_run, list_used_leaves, simulate_trajectories
from heliograph.simulation.simulation_step import World
from heliograph.simulation.transmission.build_reception import make_reception
from heliograph.smoothing.fixed_interval_lag_point import AbstractSmoothing

Progress = TypeAliasType("Progress", Callable[[int, int], None])
Seed = TypeAliasType("Seed", int | jax.Array)  # or a JAX key
Reducer = TypeAliasType("Reducer", AbstractReducer[Result], type_params=(Result,))


def monte_carlo(
    network: "Network",
    horizon: int,
    runs: int,
    key: Seed,
    keep: "Reducer[Result] | None" = None,
    inputs: ArrayLike | None = None,
    chunk: int = 2048,
    progress: Progress | None = None,
    first_run: int = 0,
    precision: Precision = "float64",
    smooth: "AbstractSmoothing | None" = None,
) -> "Result":
    """Simulate the network `runs` times over `horizon` steps and run every filter on the same data.

    A run's draws depend on the key, the run, the step and the node's name alone, so neither the chunk size nor another
    node changes a bit of them. All cores are used, and all devices where JAX sees others than a processor.

    Args:
        network: the network.
        horizon: number of steps.
        runs: number of runs.
        key: a seed or a JAX key.
        keep: what is collected: `Trajectories()` (all, the default) or `Statistics()` (bounded memory).
        inputs: (horizon, inputs), common to all runs; by default a plant without inputs is assumed.
        chunk: number of runs between calls of `progress`; 2048 by default.
        progress: `progress(done, total)` is called after each chunk of runs; None by default.
        first_run: number of the first run, a multiple of 32; 0 by default. The runs are first_run, first_run + 1, ...:
            a part of a larger simulation, bit for bit.
        precision: "float64" by default. "float32" simulates and filters in single precision, with other draws; sums are
            in double precision either way, and claims are "nominal", since the digits that are lost are not counted.
        smooth: smoothing such as `hg.smoothing.FixedInterval()`, whose results stand in the result's `smoothed`; None
            by default. Warns of filters that are not consistent by their NIS.

    Returns:
        A `Record` for trajectories, else what the reducer collects.

    Raises:
        ValueError: a horizon beyond what varies over time, inputs of the wrong shape, counts below one, a first run
            that is no multiple of 32, an unknown precision, a filter or fusion that cannot be smoothed, more memory
            than is available.
    """
    refuse_forked_process()
    instance("network", network, Network, "a Network")
    _check_counts(horizon, runs, chunk, first_run)
    check_progress(progress, "(done, total)")
    network.check_horizon(horizon)
    reducer = cast(AbstractReducer[Result], Trajectories()) if keep is None else keep
    instance("keep", reducer, AbstractReducer, "what is kept, such as Statistics()")
    u = read_plant_inputs(network, inputs, horizon)
    base = make_run_key(key)
    check_precision(precision)
    if precision == "float32":
        _warn_of_numbers_lost_in_float32(network)
        network = network.with_nominal_claims()
    smoothing = None if smooth is None else select_smoothed_part(network, smooth, horizon)
    # Native code, where it supports network and reducer.
    if has_processor_alone() and not _has_long_step(network):
        with explain_out_of_memory(runs, horizon):
            by_native_code = simulate_natively(
                network, u, base, reducer, first_run, runs, chunk, progress, smoothing, precision
            )
        if by_native_code is not None:
            return _return_with_warnings(by_native_code, network)
    # Otherwise XLA: the world, with gains computed beforehand where they depend on no data, and what is collected.
    filters = AllFilters(network, None if smoothing is None else smoothing.stacks)
    planned = precompute_filters(filters, u) if can_precompute(filters) else filters
    job = _SimulationJob(
        world=World(number_unnamed_memories(network.plant), make_reception(network), planned),
        later=None if smoothing is None else smoothing.smoother(filters),
        inputs=u,
        key=base,
        stop=np.asarray(first_run + runs),
        reducer=reducer,
        precision=precision,
    )
    if has_processor_alone():
        check_memory(_estimate_memory(job, runs, chunk), runs, horizon)
    with explain_out_of_memory(runs, horizon):
        recorded = _run_chunks(job, first_run, runs, chunk, progress)
    return _return_with_warnings(finish_result(reducer, recorded, network, smoothing), network)


def _has_long_step(network: "Network") -> bool:
    """Return whether a fusion between neighbours has too many operations a step to be written out as native code."""
    return any(mesh.has_long_step for mesh in build_meshes(network).values())


def _return_with_warnings(result: Result, network: Network) -> Result:
    """Return the result as it is; warn if it is a record with numbers that are not finite or states beyond limits."""
    if isinstance(result, Record):
        _warn_beyond_limits(result, network)
        complete = [name for name, node in network.nodes.items() if isinstance(node, Node) and node.counts_all]
        warn_of_non_finite_numbers(result, complete, stacklevel=4)
    return result


def _warn_beyond_limits(record: Record, network: Network) -> None:
    """Warn if a simulated state leaves the limits that the plant declares and filters use.

    A simulation does not enforce limits: the plant's transition and noise must keep them.
    """
    for name, (low, high) in first(network.plant).limits if record.truth is not None else ():
        x = np.asarray(record.truth)[..., network.states.index(name)]
        is_beyond = ((x < low) | (x > high)).reshape(-1, x.shape[-1])
        if is_beyond.any():
            affected_runs = f"in {is_beyond.any(axis=1).sum()} of {len(is_beyond)} runs"
            finding = f"the true {name!r} leaves its limits {low:g} to {high:g} {affected_runs}"
            remedy = "filters believe them, the plant's transition and noise have to keep them"
            warnings.warn(f"{finding}, first at step {np.argmax(is_beyond.any(axis=0))}: {remedy}", stacklevel=4)


def _check_counts(horizon: int, runs: int, chunk: int, first_run: int) -> None:
    """Raise ValueError unless counts are positive integers and `first_run` is a multiple of BLOCK.

    Runs are simulated in blocks of BLOCK, so that results do not depend on where a series of runs began.
    """
    for name, count in (("horizon", horizon), ("runs", runs), ("chunk", chunk)):
        check_count(name, count)
    if check_count("first_run", first_run, least=0) % BLOCK:
        raise fail("first_run", f"a multiple of {BLOCK}", first_run)


def _warn_of_numbers_lost_in_float32(network: Network) -> None:
    """Warn if some array of plant and sensors has only numbers too small for single precision, and not only zeros.

    In single precision these numbers count as 0.
    """
    sensors = [node.sensor for node in network.nodes.values() if isinstance(node, Node)]
    arrays = [np.asarray(leaf) for leaf in jax.tree.leaves((network.plant, sensors)) if eqx.is_inexact_array(leaf)]
    largest = [np.max(np.abs(array), initial=0.0) for array in arrays]
    if any(0 < size < np.finfo(np.float32).tiny for size in largest):
        finding = "single precision: numbers of plant or sensors below 1.2e-38 count as 0"
        warnings.warn(f"{finding}; choose larger units, or float64", stacklevel=3)


class _SimulationJob(Module):
    """What a simulation by XLA needs.

    Args:
        world: the network, as a step.
        later: smooths each run; None where nothing is smoothed.
        inputs: of the plant (horizon, inputs).
        key: of all runs.
        stop: number after that of the last run.
        reducer: says what is collected of a run.
        precision: in which runs are computed.
    """

    world: World
    later: NetworkSmoother | None
    inputs: np.ndarray
    key: jax.Array
    stop: np.ndarray
    reducer: AbstractReducer[PyTree]
    precision: Precision = eqx.field(static=True)


def _run_chunks(job: _SimulationJob, first_run: int, runs: int, chunk: int, progress: Progress | None) -> ReducedRuns:
    """Simulate all runs, chunk by chunk, in lanes side by side: return the sums over them, and what is collected."""
    with jax.enable_x64(True):
        # Blocks of runs are dealt to lanes: each computed by a thread of its own (`alone`), or all `together`.
        lanes = RunLanes(
            alone=lambda blocks, carry: _simulate_lane((job, blocks), carry),
            together=partial(_simulate_all_lanes, job),
            start=partial(_make_zero_sums, job),
            first_run=first_run,
            one_by_one=bool(job.world.filters.meshes),  # their large matrices would block threads side by side
        )
        chunks = split_into_chunks(lanes.count, lanes.wide, runs, chunk)
        collected_by_chunk = advance_in_chunks(lanes.advance, chunks, runs, progress)
    # Blocks may go beyond the last run.
    collected = jax.tree.map(lambda *leaves: np.concatenate(leaves)[:runs], *collected_by_chunk)
    # Sums, and for each whether it is a value that all runs share.
    total = lanes.total()
    sums = jax.tree.map(lambda leaf: leaf.value if is_shared(leaf) else leaf, total, is_leaf=is_shared)
    common = jax.tree.map(is_shared, total, is_leaf=is_shared)
    return ReducedRuns(OfStep(*sums), OfStep(*common), count_runs_by_batch(first_run, first_run + runs), collected)


@quickly_compiled
def _make_zero_sums(job: _SimulationJob) -> PyTree:
    """Return the sums of zero before the first block; compiled, so that shapes are worked out once a network."""
    shapes, _ = eqx.filter_eval_shape(_simulate_block, job, np.arange(BLOCK))
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), shapes)


@partial(quickly_compiled, donate="all-except-first")
def _simulate_lane(todo: tuple[_SimulationJob, PyTree], carry: PyTree) -> tuple[PyTree, PyTree]:
    """Simulate (job, blocks) as `_simulate_blocks` does, compiled; the result takes the memory of the carry."""
    return _simulate_blocks(*todo, carry)


def _simulate_blocks(job: _SimulationJob, blocks: PyTree, carry: PyTree) -> tuple[PyTree, PyTree]:
    """Return the carry (the sums so far) with the sums of some blocks of runs added, and what is collected of these.

    `blocks`: numbers of the runs (block, BLOCK). Blocks are summed one after another, so that no bit depends on how
    runs are dealt to calls.
    """

    def add_block(carry: PyTree, runs: jax.Array) -> tuple[PyTree, PyTree]:
        """Return the carry with the sums of one more block of runs, and what is collected of it."""
        sums, collected = _simulate_block(job, runs)
        return add_sums(carry, sums), collected

    return jax.lax.scan(add_block, carry, jnp.asarray(blocks))


@quickly_compiled
def _simulate_all_lanes(job: _SimulationJob, blocks: PyTree, carries: PyTree) -> tuple[PyTree, PyTree]:
    """Simulate the blocks of all lanes as `_simulate_blocks` does, with a leading axis of lanes everywhere."""
    sums: tuple[PyTree, PyTree] = jax.vmap(partial(_simulate_blocks, job))(blocks, carries)
    return sums


def _simulate_block(job: _SimulationJob, runs: jax.Array) -> tuple[tuple[PyTree, PyTree], PyTree]:
    """Return ((sums, counts of runs with a flag), collected) of a block: by batch, and collected (run, time, ...)."""
    recorded = _reduce(job.reducer, job.later, _simulate_outputs(job, runs))
    # The last block may have runs beyond the last one; run r belongs to batch r mod BATCHES.
    valid, start = jnp.asarray(runs) < job.stop, runs[0] % BATCHES

    def sum_by_batch(leaf: jax.Array) -> PyTree:
        """Return the sums of `leaf` (run, ...) over the runs of each batch (..., batch).

        From outside: `valid`, which runs count, and `start`, the batch of the first run. A leaf that all runs share,
        (1, ...), is not summed.
        """
        if len(leaf) < len(runs):
            return SharedResult(leaf[0].astype(float))
        return group_by_batch(jnp.where(valid, jnp.moveaxis(leaf, 0, -1).astype(float), 0.0), start)

    sums, ever = jax.tree.map(sum_by_batch, (recorded.sums, recorded.ever))
    collected = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(runs), *leaf.shape[1:])), recorded.collected)
    return (sums, ever), collected


def _simulate_outputs(job: _SimulationJob, runs: jax.Array) -> PyTree:
    """Return all outputs of one block of runs (run, time, ...), in double precision whatever the precision of the runs.

    `runs`: their numbers.
    """
    if job.precision == "float64":
        return _simulate_trajectories(job.world, job.inputs, job.key, runs)
    with jax.enable_x64(False):  # so that JAX computes in single precision
        world, inputs = jax.tree.map(_convert_to_single, (job.world, job.inputs))
        outputs = _simulate_trajectories(world, inputs, job.key, runs)

    def to_double(leaf: jax.Array) -> jax.Array:
        """Return real numbers in double precision, all else as it is."""
        return leaf.astype(float) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    return jax.tree.map(to_double, outputs)


def _estimate_memory(job: _SimulationJob, runs: int, chunk: int) -> NeededMemory:
    """Return the bytes that a simulation by XLA on a processor needs, from the shapes of its arrays.

    Runs are simulated in blocks of BLOCK runs. Each of LANES lanes sums over its blocks, one after another. `chunk`:
    runs that are begun together.
    """
    with jax.enable_x64(True):
        block = np.arange(BLOCK)
        sums, collected = eqx.filter_eval_shape(_simulate_block, job, block)
        outputs = eqx.filter_eval_shape(_simulate_outputs, job, block)
        used_outputs = list_used_leaves(partial(_reduce, job.reducer, job.later), outputs)
    blocks, blocks_of_chunk = -(-runs // BLOCK), -(-min(runs, chunk) // BLOCK)
    lanes_at_once = 1 if job.world.filters.meshes else min(LANES, blocks_of_chunk, os.cpu_count() or 1)
    # A lane that is computed has its sums, new sums with a block added, and rows from which `group_by_batch` sums.
    rows = count_bytes(sums) * (BATCHES + BLOCK - 1) / BATCHES
    all_collected = blocks * count_bytes(collected)
    return NeededMemory(
        collected=2 * all_collected,  # by chunk and joined, at a time when no trajectories are left
        sums=min(LANES, blocks) * count_bytes(sums) + lanes_at_once * (count_bytes(sums) + rows),
        trajectories=max(0.0, lanes_at_once * count_bytes(used_outputs) - all_collected),
    )


def group_by_batch(values: jax.Array, start: jax.Array | int) -> jax.Array:
    """Return sums over batches (..., batch) of values (..., run) of consecutive runs; batches without runs are 0.

    The first run goes to batch `start`, each further run to the next batch, and after the last batch (BATCHES) it goes
    on from the first.
    """
    *leading_axes, runs = values.shape
    zeros = (0,) * len(leading_axes)  # the first index along all leading axes
    # Write the runs into one long row of batches, and add what is beyond its end to its beginning.
    row = jnp.zeros((*leading_axes, BATCHES + runs - 1), values.dtype)
    row = jax.lax.dynamic_update_slice(row, values, (*zeros, start))
    batches, beyond = row[..., :BATCHES], row[..., BATCHES:]
    return jax.lax.dynamic_update_slice(batches, batches[..., : runs - 1] + beyond, (*zeros, 0))


def _convert_to_single(leaf: PyTree) -> PyTree:
    """Return an array in the type that JAX has for it without enable_x64; anything else as it is."""
    halved = {"float64": "float32", "int64": "int32", "uint64": "uint32"}
    return leaf.astype(halved.get(str(leaf.dtype), leaf.dtype)) if eqx.is_array(leaf) else leaf


def _simulate_world(world: World, u: PyTree, key: jax.Array, runs: jax.Array) -> PyTree:
    """Return the trajectories of these runs, by number, (run, time, ...), of plant, channels and filters."""
    keys = jax.vmap(lambda run: jax.random.fold_in(key, run))(runs)
    return simulate_trajectories(world.init, world.step, keys, (jnp.arange(len(u)), jnp.asarray(u)))


def _reduce_runs(reducer: AbstractReducer[Any], later: NetworkSmoother | None, outputs: PyTree) -> OfStep:
    """Return what is summed and collected of each run's trajectories, which the smoother `later`, if any, smooths."""
    reduced: OfStep = apply_to_each_run(partial(reduce_run, reducer, later), outputs)
    return reduced


# Traced once, for their shapes and for the program alike: tracing is half of what a first call takes.
_simulate_trajectories: Callable[..., PyTree] = eqx.filter_jit(_simulate_world, inline=True)  # type: ignore[call-overload]
_reduce: Callable[..., OfStep] = eqx.filter_jit(_reduce_runs, inline=True)  # type: ignore[call-overload]


def simulate(
    network: Network,
    horizon: int,
    key: int | jax.Array,
    inputs: Float[ArrayLike, "horizon inputs"] | None = None,
    smooth: AbstractSmoothing | None = None,
) -> Record:
    """Simulate one run of the network and every filter on it: the first run of `monte_carlo` with the same key.

    Args:
        network: the network.
        horizon: number of steps.
        key: a seed or a JAX key.
        inputs: (horizon, inputs); by default a plant without inputs is assumed.
        smooth: smoothing as in `monte_carlo`; None by default.

    Returns:
        The record, without an axis of runs: `truth` (time, n), `measurements` by node, `estimates` by node and filter.

    Raises:
        ValueError: what `monte_carlo` refuses.
    """
    record = monte_carlo(network, horizon, runs=1, key=key, inputs=inputs, smooth=smooth)
    return record.of_run(0)
