"""The one scan: it simulates the world, feeds every filter, and serves Monte Carlo runs and recordings alike."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal, get_args, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from heliograph.model.estimate import Estimate
from heliograph.model.over_time import at
from heliograph.model.plant import AbstractPlant, AnyPlant
from heliograph.numerics.angle import wrapped
from heliograph.numerics.check import array, check_count, check_seed, check_times, fail, instance, shown, table
from heliograph.numerics.compiler import large_program
from heliograph.numerics.float64 import to_numpy
from heliograph.numerics.forked import check_process
from heliograph.simulation.air import AbstractAir, air_of
from heliograph.simulation.by_run import trajectories
from heliograph.simulation.draws import INITIAL, PROCESS, WORLD, draw_key
from heliograph.simulation.lanes import BLOCK, Lanes
from heliograph.simulation.network import Network, lowered
from heliograph.simulation.record import AbstractReducer, Record, Result, Trajectories
from heliograph.simulation.smoothed import Beside, Smoother, found_record, one_run, smoothed_part
from heliograph.simulation.stepping import AllFilters, plan, plans
from heliograph.simulation.uplinks import Drawn, SentReports
from heliograph.smoothing.modes import AbstractSmoothing

Progress = Callable[[int, int], None]

Precision = Literal["float64", "float32"]


@overload
def monte_carlo(
    network: Network,
    horizon: int,
    runs: int,
    key: int | jax.Array,
    keep: None = None,
    inputs: ArrayLike | None = None,
    chunk: int = 2048,
    progress: Progress | None = None,
    first_run: int = 0,
    precision: Precision = "float64",
    smooth: AbstractSmoothing | None = None,
) -> Record: ...
@overload
def monte_carlo(
    network: Network,
    horizon: int,
    runs: int,
    key: int | jax.Array,
    keep: AbstractReducer[Result],
    inputs: ArrayLike | None = None,
    chunk: int = 2048,
    progress: Progress | None = None,
    first_run: int = 0,
    precision: Precision = "float64",
    smooth: AbstractSmoothing | None = None,
) -> Result: ...


def monte_carlo(
    network: Network,
    horizon: int,
    runs: int,
    key: int | jax.Array,
    keep: AbstractReducer[Result] | None = None,
    inputs: ArrayLike | None = None,
    chunk: int = 2048,
    progress: Progress | None = None,
    first_run: int = 0,
    precision: Precision = "float64",
    smooth: AbstractSmoothing | None = None,
) -> Record | Result:
    """Simulate the network `runs` times over `horizon` steps and run every filter on the same data.

    `key` is a seed or a JAX key; a run's draws depend on the key, the run, the step and the node's name alone, so
    neither the chunk size nor another node changes a bit of them. `keep` says what is kept: `Trajectories()` (all,
    the default) or `Statistics()` (bounded memory). `inputs` (horizon, inputs) are common to all runs.
    `progress(done, total)` is called after each chunk of runs. The runs are first_run, first_run + 1, ...: a part of a
    larger simulation, bit for bit; it starts at a multiple of 32, since so many are simulated side by side.

    All cores are used, and all devices where JAX sees others than a processor. `precision` "float32" simulates and
    filters in single precision, with other draws; what is kept is summed in double precision either way, and what is
    claimed is "nominal", since the digits that are lost are not counted.

    `smooth`, such as `hg.smoothing.FixedInterval()`, estimates earlier states from later data too; what is kept of
    these estimates stands in the result's `smoothed`. Warns of filters that their own innovations contradict.

    Returns a `Record` for trajectories, else what the reducer makes.

    Raises:
        ValueError: a horizon beyond what varies over time, inputs of the wrong shape, counts below one, a first run
            that is no multiple of 32, an unknown precision, a filter or fusion that cannot be smoothed.
    """
    check_process()
    instance("network", network, Network, "a Network")
    for name, count in (("horizon", horizon), ("runs", runs), ("chunk", chunk)):
        check_count(name, count)
    if check_count("first_run", first_run, 0) % BLOCK:
        raise fail("first_run", f"a multiple of {BLOCK}", first_run)
    network.check_horizon(horizon)
    reducer: AbstractReducer[Record] | AbstractReducer[Result] = Trajectories() if keep is None else keep
    instance("keep", reducer, AbstractReducer, "what is kept, such as Statistics()")
    u = _check_inputs(network, inputs, horizon)
    base = _key(key)
    if not isinstance(precision, str) or precision not in get_args(Precision):
        raise fail("precision", f"one of {', '.join(get_args(Precision))}", shown(precision))
    single = precision == "float32"
    part = None if smooth is None else smoothed_part(network, smooth, horizon)
    filters = AllFilters(network, part and part.kinds)
    world = World(network.plant, air_of(network), plan(filters, u) if plans(filters) else filters)
    later = part and part.smoother(filters)
    both: Beside[Any] = Beside(reducer)
    keeper = reducer if part is None else both
    job = _Job(world, later, u, base, np.asarray(first_run + runs), keeper, single)
    parts = []
    with jax.enable_x64(True):
        lanes = Lanes(
            lambda blocks, carry: _lane((job, blocks), carry),
            partial(_all_lanes, job),
            partial(_initial, job),
            first_run,
        )
        blocks = lanes.blocks_of(min(chunk, runs))
        for start in range(0, -(-runs // BLOCK), blocks):
            begun, done = start * BLOCK, min((start + blocks) * BLOCK, runs)
            parts.append(jax.tree.map(lambda leaf: leaf[: done - begun], lanes.advance(start, blocks)))  # noqa: B023
            if progress is not None:
                progress(done, runs)
    kept = lanes.total(), jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    told = network.in_single_precision() if single else network
    if part is not None:
        claims = lowered(part.claims) if single else part.claims
        result: Record | Result = both.finished(*kept, told, part._replace(claims=claims))
        return result
    return reducer.finish(*kept, told)


def run(
    network: Network,
    measurements: Mapping[str, ArrayLike],
    inputs: ArrayLike | None = None,
    time: ArrayLike | None = None,
    smooth: AbstractSmoothing | None = None,
    reports: Mapping[str, Mapping[str, SentReports | ArrayLike]] | None = None,
) -> Record:
    """Run every filter of the network over recorded measurements.

    measurements: for each node an array (steps, received), NaN where a component did not arrive; what relays heard may
    be left out, and with it their own filters. inputs: (steps,
    inputs), the input that led to each row. time: (steps,), kept in the record; 0, 1, ... unless given. smooth: as of
    `monte_carlo`.
    reports: of each fusion by `AllReports` and each of its nodes what became of the report that was sent at each step,
    (steps, received), NaN where it never arrived; `SentReports` where delays differ. They may be left out where
    nothing happens to them by chance.

    Raises:
        ValueError: a node without measurements or the reverse, shapes that do not fit, times that go backwards, a
            filter or fusion that cannot be smoothed.
    """
    check_process()
    instance("network", network, Network, "a Network")
    network = network.restricted_to(table("measurements", measurements, "arrays of nodes"))
    steps = len(np.asarray(next(iter(measurements.values()))))
    if steps == 0:
        raise fail("measurements", "at least one row", "none")
    z = {
        name: _check_measurement(name, measurements[name], steps, node.received) for name, node in network.nodes.items()
    }
    network.check_horizon(steps)
    u = _check_inputs(network, inputs, steps)
    clock = np.arange(steps, dtype=np.float64) if time is None else check_times("time", time, steps)
    grouped = tuple(np.stack([z[name] for name in names], axis=1) for names in network.groups)
    part = None if smooth is None else smoothed_part(network, smooth, steps)
    filters = AllFilters(network, part and part.kinds)
    with jax.enable_x64(True):
        given = {} if reports is None else table("reports", reports, "reports by fusion")
        arrivals = {
            name: item.uplinks.recorded(name, item.nodes, given.get(name), steps)
            for name, item in filters.reporting.items()
        }
        found = to_numpy(_run_filters(filters, part and part.smoother(filters), grouped, u, arrivals))
    return found_record(network, part, found, clock)


@large_program
def _run_filters(
    filters: AllFilters, later: Smoother | None, z: tuple[np.ndarray, ...], u: np.ndarray, arrivals: dict[str, Drawn]
) -> PyTree:
    def body(states: PyTree, row: tuple[Any, ...]) -> tuple[PyTree, PyTree]:
        k, u_k, z_k, drawn = row
        return filters.step(states, z_k, u_k, k, drawn)

    rows = jnp.arange(len(u)), u, z, arrivals
    found = {"measurements": z, **jax.lax.scan(body, filters.init(), rows)[1]}
    return found if later is None else one_run(later.both, found)


class World(eqx.Module):
    """A network as it is simulated: the plant, what is between it and the nodes, and all filters."""

    plant: AnyPlant
    air: AbstractAir
    filters: AllFilters

    def init(self, key: jax.Array) -> PyTree:
        """Before the first step of the run with this key."""
        x = at(self.plant, 0).sample_initial(draw_key(key, 0, WORLD, INITIAL))
        return x, self.air.init(key), self.filters.init()

    def step(self, carry: PyTree, key: jax.Array, row: tuple[jax.Array, jax.Array]) -> tuple[PyTree, PyTree]:
        """After step k with the input u, and what there is to see of it: truth (n,), measurements, estimates."""
        (x, air, states), (k, u) = carry, row
        plant = at(self.plant, k)
        x = wrapped(plant.transition(x, u) + plant.sample_noise(draw_key(key, k, WORLD, PROCESS), u), plant.angles)
        air, z = self.air.hear(air, x, u, key, k)
        drawn = {name: item.uplinks.draw(key, k) for name, item in self.filters.reporting.items()}
        states, found = self.filters.step(states, z, u, k, drawn)
        after = x, self.air.told(air, found["estimates"]), states
        return after, {"truth": x, "measurements": z, **_near(plant, x, found)}


def _near(plant: AbstractPlant, x: jax.Array, found: dict[str, PyTree]) -> dict[str, PyTree]:
    """What was estimated, angles within half a turn of the truth: then x - xhat is the error, whoever subtracts."""
    if not plant.circular:
        return found

    def near(one: Estimate) -> Estimate:
        return Estimate(plant.near(jnp.asarray(one.mean), x), one.covariance, one.claim)

    each = {key: found[key] for key in ("estimates", "fused")}
    return {**found, **jax.tree.map(near, each, is_leaf=lambda leaf: isinstance(leaf, Estimate))}


class _Job(eqx.Module):
    """What is simulated and smoothed, up to which run, what is kept of it, and whether in single precision."""

    world: World
    later: Smoother | None
    inputs: Any
    key: jax.Array
    stop: np.ndarray
    reducer: AbstractReducer[Any]
    single: bool = eqx.field(static=True)


@large_program
def _initial(job: _Job) -> PyTree:
    """What the reducer holds before the first block; compiled, so that shapes are worked out once a network."""
    return job.reducer.initial(eqx.filter_eval_shape(_block, job, np.arange(BLOCK)))


@partial(large_program, donate="all-except-first")
def _lane(todo: tuple[_Job, Any], carry: PyTree) -> tuple[PyTree, PyTree]:
    return _blocks(*todo, carry)


def _blocks(job: _Job, blocks: Any, carry: PyTree) -> tuple[PyTree, PyTree]:
    """Blocks one after another. Their width never changes, nor the order of sums: so chunks do not change a bit."""

    def body(carry: PyTree, runs: jax.Array) -> tuple[PyTree, PyTree]:
        return job.reducer.reduce(carry, _block(job, runs), runs, runs < job.stop)

    return jax.lax.scan(body, carry, jnp.asarray(blocks))


@large_program
def _all_lanes(job: _Job, blocks: Any, carries: PyTree) -> tuple[PyTree, PyTree]:
    """Every lane's blocks, with a leading axis for the lanes."""
    result: tuple[PyTree, PyTree] = jax.vmap(partial(_blocks, job))(blocks, carries)
    return result


def _block(job: _Job, runs: jax.Array) -> PyTree:
    """Trajectories (run, time, ...) of one block of runs; (1, time, ...) of what all runs share."""
    if not job.single:
        return _trajectories(job.world, job.later, job.inputs, job.key, runs)
    with jax.enable_x64(False):
        world, later, inputs = jax.tree.map(_single, (job.world, job.later, job.inputs))
        found = _trajectories(world, later, inputs, job.key, runs)
    return jax.tree.map(lambda leaf: leaf.astype(float) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, found)


def _single(leaf: Any) -> Any:
    return leaf.astype(np.float32) if eqx.is_inexact_array(leaf) else leaf


def _simulated(world: World, later: Smoother | None, u: Any, key: jax.Array, runs: jax.Array) -> PyTree:
    keys = jax.vmap(lambda run: jax.random.fold_in(key, run))(runs)
    found = trajectories(world.init, world.step, keys, (jnp.arange(len(u)), jnp.asarray(u)))
    return found if later is None else later.both(found)


# Traced once, for its shapes and for the program alike: tracing is half of what a first call takes.
_trajectories: Callable[..., PyTree] = eqx.filter_jit(_simulated, inline=True)  # type: ignore[call-overload]


def _key(key: object) -> jax.Array:
    """A key from a seed, or as it is given."""
    if isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.shape == ():
        return key
    if isinstance(key, jax.Array | np.ndarray):
        raise fail("key", "a seed, or one key of jax.random.key", f"an array of {key.dtype} of shape {key.shape}")
    return jax.random.key(check_seed("key", key))


def _check_inputs(network: Network, inputs: ArrayLike | None, horizon: int) -> np.ndarray:
    count = len(network.inputs)
    if inputs is None and count:
        raise fail("inputs", f"an array ({horizon}, {count}) of {list(network.inputs)}", "none")
    return np.zeros((horizon, 0)) if inputs is None else array("inputs", inputs, (horizon, count))


def _check_measurement(name: str, value: ArrayLike, steps: int, received: int) -> np.ndarray:
    flat = received == 1 and np.asarray(value, dtype=None if isinstance(value, np.ndarray) else object).ndim == 1
    shape = (steps,) if flat else (steps, received)
    result: np.ndarray = array(f"measurements of node {name!r}", value, shape, missing=True)
    return result[:, None] if flat else result
