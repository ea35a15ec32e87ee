"""What is between the plant and the filters: each node's own sensor and channel, or relays that talk in slots."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from heliograph.filters.fed_back import FedBackFilter
from heliograph.model.channel import Channel
from heliograph.model.estimate import Estimate
from heliograph.model.over_time import OverTime, at, first, over_time, stack, structure
from heliograph.model.relays import SENSOR as SENDER
from heliograph.model.relays import RelayNetwork
from heliograph.model.sensor import AbstractSensor, AnySensor
from heliograph.numerics.angle import wrapped
from heliograph.numerics.module import Module
from heliograph.random_affine.base import anonymous
from heliograph.simulation.draws import SENSOR, checksum, draw_key
from heliograph.simulation.network import OWN, Network
from heliograph.simulation.node import Node
from heliograph.simulation.shadows import deliver, memory_places, start

Heard = tuple[jax.Array, ...]  # (node, received) of each group


class AbstractAir(Module):
    """How signals reach the nodes: it holds the states of all channels of a run."""

    def init(self, key: jax.Array) -> PyTree:
        """Before the first step; `key` is the run's."""
        raise NotImplementedError

    def hear(self, state: PyTree, x: jax.Array, u: jax.Array, key: jax.Array, k: jax.Array) -> tuple[PyTree, Heard]:
        """What reaches the nodes of each group at step k, x the state to which u led; NaN where nothing does."""
        raise NotImplementedError

    def told(self, state: PyTree, estimates: Sequence[Estimate]) -> PyTree:
        """After the filters' step, with their estimates by kind, (filter, node, ...)."""
        return state


class Antenna(Module):
    """The sensors and channels of a group of nodes, stacked; checksums of the names tell their draws.

    `teller`: the filters that sensors hear back, whose estimates stand at `place` (kind, filter) among all.

    Shapes: checksums (node,), memories (node, memories of a channel): checksums of what the channels remember.
    """

    sensor: AnySensor
    channel: Channel
    checksums: jax.Array | np.ndarray
    memories: jax.Array | np.ndarray
    teller: FedBackFilter | None
    place: tuple[int, int] | None = eqx.field(static=True)


class Reach(NamedTuple):
    """A channel's state, and the estimate that its sensor heard back last, (n,); None where it hears none."""

    memory: PyTree
    told: jax.Array | None


class OwnChannels(AbstractAir):
    """Each node has its own sensor and its own channel."""

    antennas: tuple[Antenna, ...]

    def init(self, key: jax.Array) -> PyTree:
        """States of the channels and what was heard back, by group, with a leading node axis."""

        def one(antenna: Antenna) -> Reach:
            told = None if antenna.teller is None else jnp.asarray(antenna.teller.init().mean)
            return Reach(start(antenna.channel, key, antenna.checksums, antenna.memories), told)

        return tuple(eqx.filter_vmap(one, in_axes=(eqx.if_array(0),))(antenna) for antenna in self.antennas)

    def hear(self, state: PyTree, x: jax.Array, u: jax.Array, key: jax.Array, k: jax.Array) -> tuple[PyTree, Heard]:
        """The sensor measures x and takes off what is expected of it, the channel delivers."""

        def one(antenna: Antenna, reach: Reach) -> tuple[Reach, jax.Array]:
            sensor = at(antenna.sensor, k)
            y = sensed(sensor, x, draw_key(key, k, antenna.checksums, SENSOR))
            if antenna.teller is not None and reach.told is not None:
                y = y - antenna.teller.reference(reach.told, u, k)
            memory, z = deliver(antenna.channel, reach.memory, y, key, k, antenna.checksums, antenna.memories)
            return Reach(memory, reach.told), z

        both = eqx.filter_vmap(one, in_axes=(eqx.if_array(0), 0))
        results = [both(antenna, reach) for antenna, reach in zip(self.antennas, state, strict=True)]
        return tuple(after for after, _ in results), tuple(z for _, z in results)

    def told(self, state: PyTree, estimates: Sequence[Estimate]) -> PyTree:
        """Every sensor hears what its filter estimates now."""
        return tuple(
            reach if antenna.place is None else Reach(reach.memory, estimates[antenna.place[0]].mean[antenna.place[1]])
            for antenna, reach in zip(self.antennas, state, strict=True)
        )


def sensed(sensor: AbstractSensor, x: jax.Array, key: jax.Array) -> jax.Array:
    """y = h(x) + v, angles between -pi and pi."""
    return wrapped(sensor.measure(x) + sensor.noise.sample(key), sensor.angles)


class CommonChannel(AbstractAir):
    """One sensor and one channel, drawn once a step; each node hears its rows of what arrives."""

    sensor: AnySensor
    channel: Channel
    rows: tuple[np.ndarray, ...]  # (node, received) of each group

    def init(self, key: jax.Array) -> PyTree:
        """What a late channel holds of the past; the channel forgets all else."""
        return start(self.channel, key, checksum(SENDER), ())

    def hear(self, state: PyTree, x: jax.Array, u: jax.Array, key: jax.Array, k: jax.Array) -> tuple[PyTree, Heard]:
        """The sensor measures x, the channel delivers."""
        sensor, place = at(self.sensor, k), checksum(SENDER)
        y = sensed(sensor, x, draw_key(key, k, place, SENSOR))
        state, z = deliver(self.channel, state, y, key, k, place, ())
        return state, tuple(z[rows] for rows in self.rows)


class Relayed(NamedTuple):
    """What the relays will send, (relay, n), and the states of the hops that remember."""

    estimates: jax.Array
    hops: dict[str, PyTree]


class Slots(AbstractAir):
    """Relays in turn: each sends C s with its estimate s of the step before; slots of one structure share a branch.

    A hop that remembers moves on at every step, used or not; the same pair in another slot is another hop.
    """

    relays: RelayNetwork
    own: tuple[tuple[int, int, int], ...] = eqx.field(static=True)  # kind, filter and node of each relay's estimate
    groups: tuple[tuple[int, ...], ...] = eqx.field(static=True)  # listeners of each group
    memories: dict[str, np.ndarray]  # places of what each remembering hop's links hold

    def init(self, key: jax.Array) -> Relayed:
        """Every relay knows the initial mean."""
        mean = jnp.asarray(at(self.relays.plant, 0).initial_mean)
        hops = {
            name: start(hop, key, checksum(f"{sender} to {listener}"), self.memories[name])
            for name, (_, listener, sender, hop) in _remembering(self.relays).items()
        }
        return Relayed(jnp.tile(mean, (len(self.own), 1)), hops)

    def hear(self, state: Relayed, x: jax.Array, u: jax.Array, key: jax.Array, k: jax.Array) -> tuple[Relayed, Heard]:
        """The sum of the hops of this step's slot, at each listener."""
        sensor = at(self.relays.sensor, k)
        y = sensor.measure(x) + sensor.noise.sample(draw_key(key, k, checksum(SENDER), SENSOR))
        signals = [jnp.asarray(sensor.matrix) @ s for s in state.estimates]
        sent = dict(zip((SENDER, *self.relays.relays), [y, *signals], strict=True))
        heard = self._forgetful(k, sent, key)
        hops, slot = {}, k % len(self.relays.slots)
        for name, (number, listener, sender, hop) in _remembering(self.relays).items():
            place = checksum(f"{sender} to {listener}")
            hops[name], z = deliver(hop, state.hops[name], sent[sender], key, k, place, self.memories[name])
            heard[listener] = heard[listener] + jnp.where(slot == number, z, 0.0)
        order = [heard[name] for name in self.relays.filters]
        return Relayed(state.estimates, hops), tuple(jnp.stack([order[i] for i in group]) for group in self.groups)

    def told(self, state: Relayed, estimates: Sequence[Estimate]) -> Relayed:
        """The relays' estimates, to be sent at the next step."""
        means = [estimates[kind].mean[f, i] for kind, f, i in self.own]
        return Relayed(jnp.stack(means) if means else state.estimates, state.hops)

    def _forgetful(self, k: jax.Array, sent: dict[str, jax.Array], key: jax.Array) -> dict[str, jax.Array]:
        """What each listener hears through hops that forget; NaN where nobody transmits to it."""
        kinds: dict[object, list[int]] = {}
        for number, slot in enumerate(self.relays.slots):
            kinds.setdefault(structure(slot), []).append(number)
        kind, position = np.zeros((2, len(self.relays.slots)), dtype=int)  # of each slot: its branch, and where in it
        for i, numbers in enumerate(kinds.values()):
            kind[numbers], position[numbers] = i, np.arange(len(numbers))
        branches = [self._branch([self.relays.slots[i] for i in numbers]) for numbers in kinds.values()]
        now = k % len(kind)
        heard: dict[str, jax.Array] = jax.lax.switch(
            jnp.asarray(kind)[now], branches, jnp.asarray(position)[now], k, sent, key
        )
        return heard

    def _branch(self, slots: Sequence[Mapping[str, Mapping[str, Channel]]]) -> Callable[..., dict[str, jax.Array]]:
        # a hop that is an OverTime is read at the step; stacking slots would read it at the slot
        single: PyTree = slots[0] if len(slots) == 1 else over_time(slots)

        def branch(
            position: jax.Array, k: jax.Array, sent: dict[str, jax.Array], key: jax.Array
        ) -> dict[str, jax.Array]:
            slot: PyTree = at(single, position) if isinstance(single, OverTime) else single
            listeners = zip(self.relays.filters, self.relays.received, strict=True)
            return {name: _hear(slot.get(name, {}), name, size, k, sent, key) for name, size in listeners}

        return branch


def _remembering(relays: RelayNetwork) -> dict[str, tuple[int, str, str, Channel]]:
    """Slot, listener, sender and hop of those that remember, by name."""
    return {
        f"{number} {listener} {sender}": (number, listener, sender, hop)
        for number, slot in enumerate(relays.slots)
        for listener, hops in slot.items()
        for sender, hop in hops.items()
        if first(hop).remembers
    }


def _hear(
    hops: Mapping[str, Channel], listener: str, size: int, k: jax.Array, sent: dict[str, jax.Array], key: jax.Array
) -> jax.Array:
    parts = [
        deliver(hop, (), sent[sender], key, k, checksum(f"{sender} to {listener}"), ())[1]
        for sender, hop in hops.items()
        if not first(hop).remembers
    ]
    nobody = jnp.zeros(size) if hops else jnp.full(size, jnp.nan)
    return jnp.sum(jnp.stack(parts), axis=0) if parts else nobody


def air_of(network: Network) -> AbstractAir:
    """What is between the plant and the nodes of a network."""
    if network.relays is not None:
        places = network.places()
        listeners = {name: i for i, name in enumerate(network.relays.filters)}
        return Slots(
            network.relays,
            tuple(places[name, OWN] for name in network.relays.relays),
            tuple(tuple(listeners[name] for name in names) for names in network.groups),
            memory_places({name: hop for name, (_, _, _, hop) in _remembering(network.relays).items()}),
        )
    if network.common is not None:
        rows = network.rows()
        heard = tuple(np.stack([rows[name] for name in names]) for names in network.groups)
        return CommonChannel(network.common.sensor, network.common.channel, heard)
    antennas, places = [], network.places()
    own = {name: node for name, node in network.nodes.items() if isinstance(node, Node)}
    memories = memory_places({name: node.channel for name, node in own.items()})
    for names in network.groups:
        parts = stack([(own[name].sensor, _unnamed(own[name].channel, memories[name])) for name in names])
        checksums = np.array([checksum(name) for name in names], dtype=np.uint32)
        held = np.stack([memories[name] for name in names])
        told_by = own[names[0]].told_by
        teller: PyTree = None if told_by is None else stack([own[name].filters[told_by] for name in names])
        place = None if told_by is None else places[names[0], told_by][:2]
        antennas.append(Antenna(*parts, checksums, held, teller, place))
    return OwnChannels(tuple(antennas))


def _unnamed(channel: Channel, places: np.ndarray) -> Channel:
    return anonymous(channel) if len(places) else channel
