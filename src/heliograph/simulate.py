"""The one scan: it simulates the world, feeds every filter, and serves Monte Carlo runs and recordings alike."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.check import array, check_count, fail
from heliograph.float64 import compiled, to_numpy
from heliograph.groups import AllFilters, Group, groups
from heliograph.network import Network
from heliograph.over_time import at
from heliograph.random_affine.base import apply
from heliograph.record import AbstractReducer, Record, Trajectories, trajectories_record

Progress = Callable[[int, int], None]

# What a key is for: folded in last, so that each use has its own stream.
INITIAL, PROCESS, SENSOR, CHANNEL = range(4)
WORLD = 0  # the plant's place among the node checksums

BLOCK = 64  # runs simulated side by side: wide enough for vector units, small enough for the cache


def monte_carlo(
    network: Network,
    horizon: int,
    runs: int,
    key: int | jax.Array,
    keep: AbstractReducer | None = None,
    inputs: Any = None,
    chunk: int = 512,
    progress: Progress | None = None,
    first_run: int = 0,
) -> Any:
    """Simulate the network `runs` times over `horizon` steps and run every filter on the same data.

    `key` is a seed or a JAX key; a run's draws depend on the key, the run, the step and the node's name alone, so
    neither the chunk size nor another node changes a bit of them. `keep` says what is kept: `Trajectories()` (all,
    the default) or `Statistics()` (bounded memory). `inputs` (horizon, inputs) are common to all runs.
    `progress(done, total)` is called after each chunk of runs. The runs are first_run, first_run + 1, ...: a part of a
    larger simulation, bit for bit; it starts at a multiple of 64, since so many are simulated side by side.

    Returns a `Record` for trajectories, else what the reducer makes.

    Raises:
        ValueError: a horizon beyond what varies over time, inputs of the wrong shape, counts below one, a first run
            that is no multiple of 64.
    """
    for name, count in (("horizon", horizon), ("runs", runs), ("chunk", chunk)):
        check_count(name, count)
    if first_run < 0 or first_run % BLOCK:
        raise fail("first_run", f"a multiple of {BLOCK}", first_run)
    network.check_horizon(horizon)
    reducer = Trajectories() if keep is None else keep
    u = _check_inputs(network, inputs, horizon)
    base = jax.random.key(key) if isinstance(key, int | np.integer) else key
    chunk = BLOCK * -(-min(chunk, runs) // BLOCK)
    with jax.enable_x64(True):
        carry, parts = _initial(network, u, base, reducer), []
        for start in range(0, runs, chunk):
            blocks = first_run + np.arange(start, start + chunk).reshape(-1, BLOCK)
            done = min(start + chunk, runs)
            carry, kept = _chunk(network, u, base, blocks, np.asarray(first_run + runs), reducer, carry)
            parts.append(jax.tree.map(lambda leaf: _flat(leaf)[: done - start], to_numpy(kept)))  # noqa: B023
            if progress is not None:
                progress(done, runs)
    return reducer.finish(to_numpy(carry), jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts), network)


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
    clock = np.arange(steps, dtype=np.float64) if time is None else array("time", time, (steps,))
    if np.any(np.diff(clock) < 0):
        row = int(np.flatnonzero(np.diff(clock) < 0)[0]) + 1
        raise fail(
            "time", "times that do not go backwards", f"{clock[row]:g} after {clock[row - 1]:g} in row {row + 1}"
        )
    found = _run_filters(network, z, u)
    return trajectories_record(network, {"truth": None, "measurements": z, **found}, clock)


@compiled
def _run_filters(network: Network, z: dict[str, Any], u: Any) -> Any:
    step = AllFilters(network, groups(network))

    def body(states: Any, item: tuple[Any, ...]) -> tuple[Any, Any]:
        k, u_k, z_k = item
        return step(states, z_k, u_k, k)

    return jax.lax.scan(body, step.init(), (jnp.arange(u.shape[0]), u, z))[1]


def _flat(leaf: np.ndarray) -> np.ndarray:
    return leaf.reshape(-1, *leaf.shape[2:])


@eqx.filter_jit
def _block(network: Network, u: Any, key: jax.Array, runs: jax.Array) -> Any:
    """Trajectories of one block of runs."""
    parts = groups(network)
    return jax.vmap(lambda index: _one_run(network, parts, u, jax.random.fold_in(key, index)))(runs)


@eqx.filter_jit
def _initial(network: Network, u: Any, key: jax.Array, reducer: AbstractReducer) -> Any:
    """What the reducer holds before the first block; compiled, so that shapes are worked out once a network."""
    shapes = eqx.filter_eval_shape(_block, network, u, key, np.arange(BLOCK))
    return reducer.initial(shapes)


@eqx.filter_jit
def _chunk(
    network: Network, u: Any, key: jax.Array, blocks: Any, stop: Any, reducer: AbstractReducer, carry: Any
) -> tuple[Any, Any]:
    """Blocks one after another. Their width never changes, nor the order of sums: so chunks do not change a bit."""

    def body(carry: Any, runs: jax.Array) -> tuple[Any, Any]:
        return reducer.reduce(carry, _block(network, u, key, runs), runs, runs < stop)

    return jax.lax.scan(body, carry, jnp.asarray(blocks))


def _one_run(network: Network, parts: list[Group], u: jax.Array, key: jax.Array) -> Any:
    """One world and all filters on it: truth (time, n), measurements and estimates by node, links."""
    step = AllFilters(network, parts)
    x0 = at(network.plant, 0).sample_initial(draw_key(key, 0, WORLD, INITIAL))

    def body(carry: tuple[Any, Any], item: tuple[Any, ...]) -> tuple[Any, Any]:
        (x, states), (k, u_k) = carry, item
        plant = at(network.plant, k)
        x = plant.transition(x, u_k) + plant.sample_noise(draw_key(key, k, WORLD, PROCESS), u_k)
        z: dict[str, jax.Array] = {}
        for part in parts:
            z |= dict(zip(part.names, _observe(part, x, key, k), strict=True))
        states, found = step(states, z, u_k, k)
        return (x, states), {"truth": x, "measurements": z, **found}

    return jax.lax.scan(body, (x0, step.init()), (jnp.arange(u.shape[0]), u))[1]


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
