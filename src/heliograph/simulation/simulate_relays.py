"""Simulate a relay network: relays that run as filters in the world, slot by slot, and receivers that hear them."""

from collections.abc import Mapping, Sequence
from typing import Any
from zlib import crc32

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.scheduled import ScheduledFilter
from heliograph.linear.schedule import Schedule
from heliograph.model.estimate import Claim
from heliograph.model.over_time import OverTime, alike, at, over_time
from heliograph.model.relays import RECEIVER, SENSOR, RelayNetwork
from heliograph.numerics.check import check_count, fail
from heliograph.numerics.float64 import to_numpy
from heliograph.random_affine.base import apply
from heliograph.simulation.lanes import BLOCK
from heliograph.simulation.record import AbstractReducer, Trajectories
from heliograph.simulation.simulate import CHANNEL, INITIAL, PROCESS, WORLD, Progress, draw_key
from heliograph.simulation.simulate import SENSOR as SENSOR_NOISE


class Listener(eqx.Module):
    """A place that hears something, and the filters there."""

    filters: dict[str, AbstractFilter]


class RelayWorld(eqx.Module):
    """A relay network with the filters that run in it; `nodes`, `states` and `claims` are what the reducers read."""

    network: RelayNetwork
    nodes: dict[str, Listener]

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the plant's states."""
        return self.network.states

    def claims(self) -> dict[str, dict[str, Claim]]:
        """What every estimate claims, by node and filter."""
        return {name: {f: item.claim for f, item in node.filters.items()} for name, node in self.nodes.items()}


def simulate_relays(
    network: RelayNetwork,
    relays: Mapping[str, Schedule],
    receivers: Mapping[str, AbstractFilter],
    horizon: int,
    runs: int,
    key: int | jax.Array,
    keep: AbstractReducer | None = None,
    chunk: int = 4096,
    progress: Progress | None = None,
) -> Any:
    """Simulate `runs` runs over `horizon` steps; all receivers' filters hear the same.

    At each step the relays send C s_r, with s_r their estimates at the step before, through links that are drawn anew;
    every filter then hears the sum of its links. A relay runs its schedule (its gain is zero where it hears nothing); a
    receiver's filter reads NaN where nobody transmits to it. A run's draws depend on the key, the run, the step and the
    names of sender and listener alone.

    Returns a `Record` (the default) or what the reducer makes, with the nodes "receiver" and the relays; a relay's one
    filter is "own".

    Raises:
        ValueError: relays without a schedule, schedules that are too short or of the wrong shape, counts below one.
    """
    for name, count in (("horizon", horizon), ("runs", runs), ("chunk", chunk)):
        check_count(name, count)
    world = _world(network, relays, receivers, horizon)
    reducer = Trajectories() if keep is None else keep
    base = jax.random.key(key) if isinstance(key, int | np.integer) else key
    chunk = BLOCK * -(-min(chunk, runs) // BLOCK)
    with jax.enable_x64(True):
        steps = np.arange(horizon)
        shapes = eqx.filter_eval_shape(_block, world, steps, base, np.arange(BLOCK))
        carry, parts = reducer.initial(shapes), []
        for start in range(0, runs, chunk):
            blocks = np.arange(start, start + chunk).reshape(-1, BLOCK)
            done = min(start + chunk, runs)
            carry, kept = _chunk(world, steps, base, blocks, np.asarray(runs), reducer, carry)
            parts.append(jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[: done - start], to_numpy(kept)))  # noqa: B023
            if progress is not None:
                progress(done, runs)
    collected = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    described: Any = world
    return reducer.finish(to_numpy(carry), collected, described)


def initial_states(network: RelayNetwork, runs: int, key: int | jax.Array) -> np.ndarray:
    """x_0 of each run as `simulate_relays` draws it, (runs, n).

    Raises:
        ValueError: counts below one.
    """
    check_count("runs", runs)
    base = jax.random.key(key) if isinstance(key, int | np.integer) else key
    with jax.enable_x64(True):
        draw = jax.jit(jax.vmap(lambda run: _initial(network, jax.random.fold_in(base, run))))
        return np.asarray(draw(jnp.arange(runs)))


def _initial(network: RelayNetwork, key: jax.Array) -> jax.Array:
    drawn: jax.Array = at(network.plant, 0).sample_initial(draw_key(key, 0, WORLD, INITIAL))
    return drawn


def _world(
    network: RelayNetwork, relays: Mapping[str, Schedule], receivers: Mapping[str, AbstractFilter], horizon: int
) -> RelayWorld:
    network.check_horizon(horizon)
    if set(relays) != set(network.relays):
        raise fail("relay schedules", f"those of {list(network.relays)}", list(relays))
    for name, heard in zip(network.relays, network.received, strict=False):
        schedule = relays[name]
        if schedule.horizon < horizon or schedule.gains.direct.shape[1:] != (len(network.states), heard):
            got = f"{schedule.horizon} of shape {schedule.gains.direct.shape[1:]}"
            raise fail(f"schedule of {name!r}", f"{horizon} gains of shape {(len(network.states), heard)}", got)
    own: dict[str, AbstractFilter] = {name: ScheduledFilter(relays[name]) for name in network.relays}
    nodes = {name: Listener({"own": item}) for name, item in own.items()}
    return RelayWorld(network, nodes | {RECEIVER: Listener(dict(receivers))})


class Air:
    """What every filter hears at step k; slots of one structure share one compiled branch."""

    def __init__(self, network: RelayNetwork):
        self.network = network
        kinds: list[list[Any]] = []
        place = []
        for slot in network.slots:
            kind = next((i for i, kind in enumerate(kinds) if alike(slot, kind[0])), len(kinds))
            if kind == len(kinds):
                kinds.append([])
            place.append((kind, len(kinds[kind])))
            kinds[kind].append(slot)
        self.kind, self.position = np.array(place).T
        self.branches = [self._branch(kind) for kind in kinds]

    def __call__(self, k: jax.Array, sent: dict[str, jax.Array], key: jax.Array) -> tuple[jax.Array, ...]:
        """What each filter hears, in the order of `network.filters`; NaN where nobody transmits to it."""
        slot = k % len(self.kind)
        heard: tuple[jax.Array, ...] = jax.lax.switch(
            jnp.asarray(self.kind)[slot], self.branches, jnp.asarray(self.position)[slot], k, sent, key
        )
        return heard

    def _branch(self, slots: Sequence[Any]) -> Any:
        # a link that is an OverTime is read at the step; stacking slots would read it at the slot
        single = slots[0] if len(slots) == 1 else over_time(slots)

        def branch(position: jax.Array, k: jax.Array, sent: dict[str, jax.Array], key: jax.Array) -> Any:
            slot = at(single, position) if isinstance(single, OverTime) else single
            return tuple(
                self._hear(slot.get(name, {}), name, size, k, sent, key)
                for name, size in zip(self.network.filters, self.network.received, strict=True)
            )

        return branch

    def _hear(
        self, links: Any, listener: str, size: int, k: jax.Array, sent: dict[str, jax.Array], key: jax.Array
    ) -> jax.Array:
        parts = [
            apply(
                at(link, k).sample(draw_key(key, k, crc32(f"{sender} to {listener}".encode()), CHANNEL)), sent[sender]
            )
            for sender, link in links.items()
        ]
        return jnp.sum(jnp.stack(parts), axis=0) if parts else jnp.full(size, jnp.nan)


def _one_run(world: RelayWorld, air: Air, steps: Any, key: jax.Array) -> Any:
    """One world: truth (time, n), what was heard, and the estimates of every filter."""
    network = world.network
    mean = jnp.asarray(at(network.plant, 0).initial_mean)
    states = {name: {f: item.init() for f, item in node.filters.items()} for name, node in world.nodes.items()}
    states = jax.tree.map(jnp.asarray, states)

    def body(carry: Any, k: jax.Array) -> tuple[Any, Any]:
        x, states, relayed = carry
        plant, sensor = at(network.plant, k), at(network.sensor, k)
        nothing = jnp.zeros(0)
        x = plant.transition(x, nothing) + plant.sample_noise(draw_key(key, k, WORLD, PROCESS), nothing)
        noise = sensor.noise.sample(draw_key(key, k, crc32(SENSOR.encode()), SENSOR_NOISE))
        signals = {name: jnp.asarray(sensor.matrix) @ s for name, s in relayed.items()}
        heard = dict(zip(network.filters, air(k, {SENSOR: sensor.measure(x) + noise, **signals}, key), strict=True))
        steps, estimates = {}, {}
        for name, node in world.nodes.items():
            z = heard[name] if name == RECEIVER else jnp.nan_to_num(heard[name])  # a relay's gain is then zero
            results = {f: item.step(states[name][f], z, nothing, k) for f, item in node.filters.items()}
            steps[name] = {f: result[0] for f, result in results.items()}
            estimates[name] = {f: result[1] for f, result in results.items()}
        relayed = {name: estimates[name]["own"].mean for name in network.relays}
        return (x, steps, relayed), {"truth": x, "measurements": heard, "estimates": estimates}

    start = _initial(network, key), states, dict.fromkeys(network.relays, mean)
    _, result = jax.lax.scan(body, start, jnp.asarray(steps))
    return result


def _block(world: RelayWorld, steps: Any, key: jax.Array, runs: jax.Array) -> Any:
    """Trajectories of one block of runs."""
    air = Air(world.network)
    return jax.vmap(lambda run: _one_run(world, air, steps, jax.random.fold_in(key, run)))(runs)


@eqx.filter_jit
def _chunk(
    world: RelayWorld, steps: Any, key: jax.Array, blocks: Any, stop: Any, reducer: AbstractReducer, carry: Any
) -> tuple[Any, Any]:
    """Blocks one after another, as in `heliograph.simulation.simulate`."""

    def body(carry: Any, runs: jax.Array) -> tuple[Any, Any]:
        return reducer.reduce(carry, _block(world, steps, key, runs), runs, runs < stop)

    return jax.lax.scan(body, carry, jnp.asarray(blocks))
