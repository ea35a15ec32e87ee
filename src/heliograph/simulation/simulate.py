"""The one scan: it simulates the world, feeds every filter, and serves Monte Carlo runs and recordings alike."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.over_time import at
from heliograph.numerics.check import array, check_count, check_times, fail
from heliograph.numerics.float64 import compiled, to_numpy
from heliograph.random_affine.base import apply
from heliograph.simulation.lanes import BLOCK, Lanes
from heliograph.simulation.network import Network
from heliograph.simulation.record import AbstractReducer, Record, Trajectories, trajectories_record
from heliograph.simulation.stepping import AllFilters, Group, groups

Progress = Callable[[int, int], None]

# What a key is for: folded in last, so that each use has its own stream.
INITIAL, PROCESS, SENSOR, CHANNEL = range(4)
WORLD = 0  # the plant's place among the node checksums

Precision = Literal["float64", "float32"]


def monte_carlo(
    network: Network,
    horizon: int,
    runs: int,
    key: int | jax.Array,
    keep: AbstractReducer | None = None,
    inputs: Any = None,
    chunk: int = 2048,
    progress: Progress | None = None,
    first_run: int = 0,
    precision: Precision = "float64",
) -> Any:
    """Simulate the network `runs` times over `horizon` steps and run every filter on the same data.

    `key` is a seed or a JAX key; a run's draws depend on the key, the run, the step and the node's name alone, so
    neither the chunk size nor another node changes a bit of them. `keep` says what is kept: `Trajectories()` (all,
    the default) or `Statistics()` (bounded memory). `inputs` (horizon, inputs) are common to all runs.
    `progress(done, total)` is called after each chunk of runs. The runs are first_run, first_run + 1, ...: a part of a
    larger simulation, bit for bit; it starts at a multiple of 32, since so many are simulated side by side.

    All cores are used, and all devices where JAX sees others than a processor. `precision` "float32" simulates and
    filters in single precision, with other draws; what is kept is summed in double precision either way.

    Returns a `Record` for trajectories, else what the reducer makes.

    Raises:
        ValueError: a horizon beyond what varies over time, inputs of the wrong shape, counts below one, a first run
            that is no multiple of 32, an unknown precision.
    """
    for name, count in (("horizon", horizon), ("runs", runs), ("chunk", chunk)):
        check_count(name, count)
    if first_run < 0 or first_run % BLOCK:
        raise fail("first_run", f"a multiple of {BLOCK}", first_run)
    network.check_horizon(horizon)
    reducer = Trajectories() if keep is None else keep
    u = _check_inputs(network, inputs, horizon)
    base = jax.random.key(key) if isinstance(key, int | np.integer) else key
    if precision not in get_args(Precision):
        raise fail("precision", f"one of {', '.join(get_args(Precision))}", repr(precision))
    job = _Job(network, u, base, np.asarray(first_run + runs), reducer, precision == "float32")
    parts = []
    with jax.enable_x64(True):
        lanes = Lanes(partial(_lane, job), partial(_all_lanes, job), to_numpy(_initial(job)), first_run)
        blocks = lanes.blocks_of(min(chunk, runs))
        for start in range(0, -(-runs // BLOCK), blocks):
            begun, done = start * BLOCK, min((start + blocks) * BLOCK, runs)
            parts.append(jax.tree.map(lambda leaf: leaf[: done - begun], lanes.advance(start, blocks)))  # noqa: B023
            if progress is not None:
                progress(done, runs)
    return reducer.finish(lanes.total(), jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts), network)


def run(network: Network, measurements: Mapping[str, Any], inputs: Any = None, time: Any = None) -> Record:
    """Run every filter of the network over recorded measurements.

    measurements: for each node an array (steps, received), NaN where a component did not arrive. inputs: (steps,
    inputs), the input that led to each row. time: (steps,), kept in the record; 0, 1, ... unless given.

    Raises:
        ValueError: a node without measurements or the reverse, shapes that do not fit, times that go backwards.
    """
    unknown = sorted(set(measurements) ^ set(network.nodes))
    if unknown:
        raise fail("measurements", f"arrays for the nodes {sorted(network.nodes)}", f"a mismatch in {unknown}")
    steps = len(next(iter(measurements.values())))
    if steps == 0:
        raise fail("measurements", "at least one row", "none")
    z = {
        name: _check_measurement(name, measurements[name], steps, node.received) for name, node in network.nodes.items()
    }
    network.check_horizon(steps)
    u = _check_inputs(network, inputs, steps)
    clock = np.arange(steps, dtype=np.float64) if time is None else check_times("time", time, steps)
    found = _run_filters(network, z, u)
    return trajectories_record(network, {"truth": None, "measurements": z, **found}, clock)


@compiled
def _run_filters(network: Network, z: dict[str, Any], u: Any) -> Any:
    step = AllFilters(network, groups(network))

    def body(states: Any, item: tuple[Any, ...]) -> tuple[Any, Any]:
        k, u_k, z_k = item
        return step(states, z_k, u_k, k)

    return jax.lax.scan(body, step.init(), (jnp.arange(u.shape[0]), u, z))[1]


class _Job(eqx.Module):
    """What is simulated, up to which run, what is kept of it, and whether in single precision."""

    network: Network
    inputs: Any
    key: jax.Array
    stop: np.ndarray
    reducer: AbstractReducer
    single: bool = eqx.field(static=True)


@eqx.filter_jit
def _initial(job: _Job) -> Any:
    """What the reducer holds before the first block; compiled, so that shapes are worked out once a network."""
    return job.reducer.initial(eqx.filter_eval_shape(_block, job, np.arange(BLOCK)))


@eqx.filter_jit
def _lane(job: _Job, blocks: Any, carry: Any) -> tuple[Any, Any]:
    """Blocks one after another. Their width never changes, nor the order of sums: so chunks do not change a bit."""

    def body(carry: Any, runs: jax.Array) -> tuple[Any, Any]:
        return job.reducer.reduce(carry, _block(job, runs), runs, runs < job.stop)

    return jax.lax.scan(body, carry, jnp.asarray(blocks))


@eqx.filter_jit
def _all_lanes(job: _Job, blocks: Any, carries: Any) -> tuple[Any, Any]:
    """Every lane's blocks, with a leading axis for the lanes."""
    result: tuple[Any, Any] = jax.vmap(partial(_lane, job))(blocks, carries)
    return result


def _block(job: _Job, runs: jax.Array) -> Any:
    """Trajectories (run, time, ...) of one block of runs."""
    if not job.single:
        return _trajectories(job.network, job.inputs, job.key, runs)
    with jax.enable_x64(False):
        network, inputs = jax.tree.map(_single, (job.network, job.inputs))
        found = _trajectories(network, inputs, job.key, runs)
    return jax.tree.map(lambda leaf: leaf.astype(float) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, found)


def _single(leaf: Any) -> Any:
    return leaf.astype(np.float32) if eqx.is_inexact_array(leaf) else leaf


def _trajectories(network: Network, u: Any, key: jax.Array, runs: jax.Array) -> Any:
    """The runs are the last axis of everything on the way."""
    world = _World(network)
    keys = jax.vmap(lambda run: jax.random.fold_in(key, run))(runs)
    advance = jax.vmap(world.step, in_axes=(-1, 0, None, None), out_axes=-1)

    def body(carry: Any, item: tuple[Any, ...]) -> tuple[Any, Any]:
        result: tuple[Any, Any] = advance(carry, keys, *item)
        return result

    start = jax.vmap(world.init, out_axes=-1)(keys)
    found = jax.lax.scan(body, start, (jnp.arange(u.shape[0]), u))[1]
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), found)


class _World:
    """One run of a network, step by step: the plant's state and those of all filters."""

    def __init__(self, network: Network):
        self.network, self.parts = network, groups(network)
        self.filters = AllFilters(network, self.parts)

    def init(self, key: jax.Array) -> tuple[jax.Array, Any]:
        """Before the first step."""
        return at(self.network.plant, 0).sample_initial(draw_key(key, 0, WORLD, INITIAL)), self.filters.init()

    def step(self, carry: tuple[Any, Any], key: jax.Array, k: jax.Array, u: jax.Array) -> tuple[Any, Any]:
        """After step k, and what there is to see of it: truth (n,), measurements and estimates by node, uplinks."""
        x, states = carry
        plant = at(self.network.plant, k)
        x = plant.transition(x, u) + plant.sample_noise(draw_key(key, k, WORLD, PROCESS), u)
        z: dict[str, jax.Array] = {}
        for part in self.parts:
            z |= dict(zip(part.names, _observe(part, x, key, k), strict=True))
        states, found = self.filters(states, z, u, k)
        return (x, states), {"truth": x, "measurements": z, **found}


def _observe(part: Group, x: jax.Array, key: jax.Array, k: jax.Array) -> jax.Array:
    """What reaches the filters of a group of nodes at step k: (node, received)."""

    def one(node: Any, checksum: jax.Array) -> jax.Array:
        sensor, channel = at(node.sensor, k), at(node.channel, k)
        y = sensor.measure(x) + sensor.noise.sample(draw_key(key, k, checksum, SENSOR))
        return apply(channel.sample(draw_key(key, k, checksum, CHANNEL)), y)

    observe = eqx.filter_vmap(one, in_axes=(eqx.if_array(0), 0))
    received: jax.Array = observe(part.stacked, jnp.asarray(part.checksums))
    return received


def draw_key(run_key: jax.Array, k: Any, place: Any, purpose: int) -> jax.Array:
    """Key of one draw: folded in by step, node and purpose, so no draw depends on how many others there are."""
    for part in (k, place, purpose):
        run_key = jax.random.fold_in(run_key, part)
    return run_key


def _check_inputs(network: Network, inputs: Any, horizon: int) -> np.ndarray:
    count = len(network.inputs)
    if inputs is None and count:
        raise fail("inputs", f"an array ({horizon}, {count}) of {list(network.inputs)}", "none")
    return np.zeros((horizon, 0)) if inputs is None else array("inputs", inputs, (horizon, count))


def _check_measurement(name: str, value: Any, steps: int, received: int) -> np.ndarray:
    result = np.asarray(value, dtype=np.float64)
    if result.ndim == 1 and received == 1:
        result = result[:, None]
    if result.shape != (steps, received):
        raise fail(f"measurements of node {name!r}", f"shape ({steps}, {received})", f"shape {result.shape}")
    if np.any(np.isinf(result)):
        raise fail(f"measurements of node {name!r}", "numbers, or NaN for what is missing", "infinite values")
    return result
