"""Transmission from the plant to the filters: each node's sensor and channel, or relays that transmit in slots."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.event.event_filter import EventFilter
from heliograph.filters.event.stochastic import StochasticEventFilter
from heliograph.filters.wrappers.fed_back import FedBackFilter
from heliograph.model.channel import Channel
from heliograph.model.estimate import Estimate
from heliograph.model.over_time import OverTime, at, first, over_time, structure
from heliograph.model.relays import SENSOR as SENDER
from heliograph.model.relays import RelayNetwork
from heliograph.model.sensor import AbstractSensor, AnySensor
from heliograph.model.trigger import AbstractTrigger, SenderState
from heliograph.model.words.encoder import WordReader, Words
from heliograph.numerics.angle import wrap_angles
from heliograph.numerics.module import Module, unwritten
from heliograph.numerics.types import PyTree
from heliograph.random_affine.memory import condition_on_memories
from heliograph.simulation.random_keys import DITHER, SENSOR, TRIGGER, checksum, draw_key
from heliograph.simulation.runs.side_by_side import map_all
from heliograph.simulation.transmission.shared_fading import deliver_signal, move_modes, start, start_modes

Measurements = tuple[jax.Array, ...]  # (node, received) of each group


class AbstractMedium(Module):
    """Transmission of the signals to the nodes, with the states of all channels of a run."""

    def init(self, key: jax.Array) -> PyTree:
        """Return the state before the first step; `key` is the run's."""
        raise unwritten(self, "init")

    def receive(
        self, state: PyTree, x: jax.Array, u: jax.Array, key: jax.Array, k: jax.Array
    ) -> tuple[PyTree, Measurements]:
        """Deliver the measurements of the nodes of each group at step k, x the state to which u led; NaN for none."""
        raise unwritten(self, "receive")

    def feed_back(self, state: PyTree, estimates: Sequence[Estimate]) -> PyTree:
        """Feed the filters' estimates back after their step, by kind, (filter, node, ...)."""
        return state

    def reasons(self, state: PyTree) -> dict[str, jax.Array]:
        """Return the reasons for which senders that decide transmitted at this step, by group; none here."""
        return {}


class NodeGroup(Module):
    """Sensors and channels of a group of nodes, stacked; checksums of the names identify their draws.

    `reference_filter`: filters that are fed back to the sensors; their estimates stand at `informed_at` (kind, filter).
    `trigger`: when they send; its prediction is that of a filter too, the `reference_filter`. `encoder`: of the words
    that they send; the `channel` then carries their bits, which the `reader` puts together. Shapes: checksums
    (node,), memories (node, memories of a channel) and modes (node, memories of a sensor), which are numbers that seed.
    """

    sensor: AnySensor
    inputs: tuple[str, ...] = eqx.field(static=True)
    channel: Channel
    checksums: jax.Array | np.ndarray
    memories: jax.Array | np.ndarray
    modes: jax.Array | np.ndarray
    reference_filter: FedBackFilter | EventFilter | StochasticEventFilter | None
    trigger: AbstractTrigger | None
    encoder: Words | None
    informed_at: tuple[int, int] | None = eqx.field(static=True)
    reader: WordReader | None = eqx.field(static=True)


class NoSensor(Module):
    """Nodes without a sensor."""

    count: int = eqx.field(static=True)
    informed_at: None = eqx.field(static=True, default=None)


class LinkState(NamedTuple):
    """State of a channel, of its sender, and the estimate (n,) last fed back to the sensor, each None without."""

    memory: PyTree
    feed_back: jax.Array | None
    sender: SenderState | None = None
    modes: tuple[jax.Array, ...] = ()  # of the sensor


class SeparateChannels(AbstractMedium):
    """Nodes with a sensor and a channel each."""

    groups: tuple[NodeGroup | NoSensor, ...]

    def init(self, key: jax.Array) -> PyTree:
        """Return states of the channels and of the feedback, by group, with a leading node axis."""

        def start_node(group: NodeGroup) -> LinkState:
            """Return the initial state of one node's link."""
            feed_back = None if group.reference_filter is None else _first_mean(group.reference_filter)
            outputs = len(first(group.sensor).outputs)
            sender = None if group.trigger is None else group.trigger.start(outputs)
            modes = start_modes(group.sensor, key, group.modes)
            return LinkState(start(group.channel, key, group.checksums, group.memories), feed_back, sender, modes)

        return tuple(
            () if isinstance(group, NoSensor) else map_all(start_node, len(group.checksums))(group)
            for group in self.groups
        )

    def receive(
        self, state: PyTree, x: jax.Array, u: jax.Array, key: jax.Array, k: jax.Array
    ) -> tuple[PyTree, Measurements]:
        """Measure x, subtract the reference of sensors with feedback, and deliver through the channels."""

        def receive_one(group: NodeGroup, link: LinkState) -> tuple[LinkState, jax.Array]:
            """Measure x at one node, let its trigger decide, and deliver through its channel."""
            sensor = condition_on_memories(at(group.sensor, k), link.modes).under(group.inputs, u)
            modes = move_modes(group.sensor, link.modes, key, k, group.modes)
            y = measure(sensor, x, draw_key(key, k, group.checksums, SENSOR))
            reference: jax.Array | None = None
            if group.reference_filter is not None and link.feed_back is not None:
                reference = group.reference_filter.predict_reference(link.feed_back, u, k)
            if isinstance(group.reference_filter, FedBackFilter) and reference is not None:
                y = y - reference
            y, z, memory = _send_through_channel(group, link.memory, y, key, k)
            if group.trigger is None or link.sender is None:
                return LinkState(memory, link.feed_back, modes=modes), z
            # The sender decides, by its own reference or the filter's prediction.
            sender = link.sender
            if group.trigger.reference == "prediction" and reference is not None:
                sender = sender._replace(reference=reference)
            drawn = draw_key(key, k, group.checksums, TRIGGER)
            sender, z = group.trigger.transmit(sender, y, z, drawn, k)
            return LinkState(memory, link.feed_back, sender, modes), z

        def receive_group(group: NodeGroup | NoSensor, link: PyTree) -> tuple[PyTree, jax.Array]:
            """Return the links of one group after the step, and what its nodes receive."""
            if isinstance(group, NoSensor):
                return link, jnp.zeros((group.count, 0))
            return cast(tuple[PyTree, jax.Array], map_all(receive_one, len(group.checksums))(group, link))

        results = [receive_group(group, link) for group, link in zip(self.groups, state, strict=True)]
        return tuple(after for after, _ in results), tuple(z for _, z in results)

    def feed_back(self, state: PyTree, estimates: Sequence[Estimate]) -> PyTree:
        """Feed the present estimate of each filter back to its sensor."""

        def feed_group(group: NodeGroup | NoSensor, link: PyTree) -> PyTree:
            if group.informed_at is None:
                return link
            kind, f = group.informed_at
            return link._replace(feed_back=estimates[kind].mean[f])

        return tuple(feed_group(group, link) for group, link in zip(self.groups, state, strict=True))

    def reasons(self, state: PyTree) -> dict[str, jax.Array]:
        """Return the reasons for which senders that decide transmitted at this step, by group, (node, m)."""
        links = ((g, link) for g, link in enumerate(state) if isinstance(link, LinkState))
        return {str(g): link.sender.last for g, link in links if link.sender is not None}


def _send_through_channel(
    group: NodeGroup, memory: PyTree, y: jax.Array, key: jax.Array, k: jax.Array
) -> tuple[jax.Array, jax.Array, PyTree]:
    """Send y, or its words, through the channel: return what was sent, what is received, and the channel's memory."""
    if group.encoder is None or group.reader is None:
        memory, z = deliver_signal(group.channel, memory, y, key, k, group.checksums, group.memories)
        return y, z, memory
    words, numbers = group.encoder.send(y, draw_key(key, k, group.checksums, DITHER))
    memory, received = deliver_signal(group.channel, memory, numbers, key, k, group.checksums, group.memories)
    return words, group.reader.read_words(group.encoder, len(y), received), memory


def _first_mean(filter: AbstractFilter) -> jax.Array:
    """Return a filter's mean before the first step."""
    return jnp.asarray(filter.estimate(filter.init()).mean)


def measure(sensor: AbstractSensor, x: jax.Array, key: jax.Array) -> jax.Array:
    """Return what the sensor reports of y = h(x) + v, angles between -pi and pi."""
    return wrap_angles(sensor.noise.report(sensor.measure(x) + sensor.noise.sample(key)), sensor.angles)


class CommonChannel(AbstractMedium):
    """Common sensor and channel, drawn once a step; each node receives its rows of the output."""

    sensor: AnySensor
    channel: Channel
    rows: tuple[np.ndarray, ...]  # (node, received) of each group

    def init(self, key: jax.Array) -> PyTree:
        """Return the past signals of a late channel; the channel has no other memory."""
        return start(self.channel, key, checksum(SENDER), ())

    def receive(
        self, state: PyTree, x: jax.Array, u: jax.Array, key: jax.Array, k: jax.Array
    ) -> tuple[PyTree, Measurements]:
        """Measure x and deliver through the channel."""
        sensor, source = at(self.sensor, k), checksum(SENDER)
        y = measure(sensor, x, draw_key(key, k, source, SENSOR))
        state, z = deliver_signal(self.channel, state, y, key, k, source, ())
        return state, tuple(z[rows] for rows in self.rows)


class RelayStates(NamedTuple):
    """Estimates that the relays will send, (relay, n), and the states of the hops with memory."""

    estimates: jax.Array
    hops: dict[str, PyTree]


class SlottedRelays(AbstractMedium):
    """Relays in turn: each sends C s with its estimate s of the step before; slots of one structure share a branch.

    A hop with memory moves on at every step, used or not; the same pair in another slot is another hop.

    `estimates_at`: kind, filter and node of each relay's estimate.
    """

    relays: RelayNetwork
    estimates_at: tuple[tuple[int, int, int], ...] = eqx.field(static=True)
    groups: tuple[tuple[int, ...], ...] = eqx.field(static=True)  # listeners of each group
    memories: dict[str, np.ndarray]  # places of the memories of each hop that has some

    def init(self, key: jax.Array) -> RelayStates:
        """Return the initial mean as every relay's estimate, and the hops' initial states."""
        mean = jnp.asarray(at(self.relays.plant, 0).initial_mean)
        hops = {
            name: start(hop, key, checksum(f"{sender} to {listener}"), self.memories[name])
            for name, (_, listener, sender, hop) in find_hops_with_memory(self.relays).items()
        }
        return RelayStates(jnp.tile(mean, (len(self.estimates_at), 1)), hops)

    def receive(
        self, state: RelayStates, x: jax.Array, u: jax.Array, key: jax.Array, k: jax.Array
    ) -> tuple[RelayStates, Measurements]:
        """Sum the hops of this step's slot, at each listener."""
        # Signals: of the sensor, and C s of each relay.
        sensor = at(self.relays.sensor, k)
        y = sensor.noise.report(sensor.measure(x) + sensor.noise.sample(draw_key(key, k, checksum(SENDER), SENSOR)))
        signals = [jnp.asarray(sensor.matrix) @ s for s in state.estimates]
        sent = dict(zip((SENDER, *self.relays.relays), [y, *signals], strict=True))
        # Hops without memory by a branch for the slot, then those with memory.
        received = self._sum_without_memory(k, sent, key)
        hops, slot = {}, k % len(self.relays.slots)
        for name, (number, listener, sender, hop) in find_hops_with_memory(self.relays).items():
            source = checksum(f"{sender} to {listener}")
            hops[name], z = deliver_signal(hop, state.hops[name], sent[sender], key, k, source, self.memories[name])
            received[listener] = received[listener] + jnp.where(slot == number, z, 0.0)
        order = [received[name] for name in self.relays.filters]
        return RelayStates(state.estimates, hops), tuple(jnp.stack([order[i] for i in group]) for group in self.groups)

    def feed_back(self, state: RelayStates, estimates: Sequence[Estimate]) -> RelayStates:
        """Store the relays' estimates, to be sent at the next step."""
        means = [estimates[kind].mean[f, i] for kind, f, i in self.estimates_at]
        return RelayStates(jnp.stack(means) if means else state.estimates, state.hops)

    def _sum_without_memory(self, k: jax.Array, sent: dict[str, jax.Array], key: jax.Array) -> dict[str, jax.Array]:
        """Return the sum at each listener through hops without memory; NaN where nobody transmits to it."""
        # Slots of one structure share a branch.
        slots_alike: dict[object, list[int]] = {}
        for number, slot in enumerate(self.relays.slots):
            slots_alike.setdefault(structure(slot), []).append(number)
        # Of each slot its branch, and its place within it.
        branch, position = np.zeros((2, len(self.relays.slots)), dtype=int)
        for i, numbers in enumerate(slots_alike.values()):
            branch[numbers], position[numbers] = i, np.arange(len(numbers))
        branches = [self._make_branch([self.relays.slots[i] for i in numbers]) for numbers in slots_alike.values()]
        # The branch of this step's slot.
        slot_now = k % len(branch)
        received: dict[str, jax.Array] = jax.lax.switch(
            jnp.asarray(branch)[slot_now], branches, jnp.asarray(position)[slot_now], k, sent, key
        )
        return received

    def _make_branch(self, slots: Sequence[Mapping[str, Mapping[str, Channel]]]) -> Callable[..., dict[str, jax.Array]]:
        """Return the function that computes what each listener receives in these slots."""
        # A single slot is not stacked: its hops may vary over time, and are read at the step.
        stacked: PyTree = slots[0] if len(slots) == 1 else over_time(slots)

        def branch(
            position: jax.Array, k: jax.Array, sent: dict[str, jax.Array], key: jax.Array
        ) -> dict[str, jax.Array]:
            """Return what each listener receives in the slot at this position."""
            slot: PyTree = at(stacked, position) if isinstance(stacked, OverTime) else stacked
            listeners = zip(self.relays.filters, self.relays.received, strict=True)
            return {name: _receive_sum(slot.get(name, {}), name, size, k, sent, key) for name, size in listeners}

        return branch


def find_hops_with_memory(relays: RelayNetwork) -> dict[str, tuple[int, str, str, Channel]]:
    """Return the slot, listener, sender and hop of the hops with memory, by name."""
    return {
        f"{number} {listener} {sender}": (number, listener, sender, hop)
        for number, slot in enumerate(relays.slots)
        for listener, hops in slot.items()
        for sender, hop in hops.items()
        if first(hop).remembers
    }


def _receive_sum(
    hops: Mapping[str, Channel], listener: str, size: int, k: jax.Array, sent: dict[str, jax.Array], key: jax.Array
) -> jax.Array:
    """Return the sum of what arrives at a listener from all its senders; NaN where nobody sends to it."""
    parts = [
        deliver_signal(hop, (), sent[sender], key, k, checksum(f"{sender} to {listener}"), ())[1]
        for sender, hop in hops.items()
        if not first(hop).remembers
    ]
    nobody = jnp.zeros(size) if hops else jnp.full(size, jnp.nan)
    return jnp.sum(jnp.stack(parts), axis=0) if parts else nobody
