"""Transmission from the plant to the filters: over each node's sensor and channel, or over one common to all.

A medium is what transmits to all nodes. A filter that is informed has its estimate fed back to its sensor, which sends
y less a reference made from it; a trigger decides what a node sends, and an encoder makes words of it.
"""

from collections.abc import Sequence
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.event.event_filter import EventFilter
from heliograph.filters.event.stochastic_event_filter import StochasticEventFilter
from heliograph.filters.wrappers.fed_back import FedBackFilter
from heliograph.model.channel import Channel
from heliograph.model.estimate import Estimate
from heliograph.model.over_time import at, first
from heliograph.model.relays import SENSOR as SENDER
from heliograph.model.sensor import AbstractSensor, AnySensor
from heliograph.model.trigger import AbstractTrigger, SenderState
from heliograph.model.words.encoder import WordReader, Words
from heliograph.numerics.angles.angle import wrap_angles
from heliograph.numerics.module import Module, unwritten
from heliograph.numerics.types import Array, Float, PyTree
from heliograph.random_affine.memories_of_channels import condition_on_memories
from heliograph.simulation.random_keys import DITHER, SENSOR, TRIGGER, checksum, draw_key
from heliograph.simulation.runs.stacked_filters import map_all
from heliograph.simulation.transmission.channel_draws import deliver_signal, move_modes, start_channel, start_modes

Measurements = tuple[jax.Array, ...]  # (node, received) of each group


class AbstractMedium(Module):
    """Transmission of the signals to the nodes, with the states of all channels of a run."""

    def init(self, key: jax.Array) -> PyTree:
        """Return the state before the first step; `key` is the run's."""
        raise unwritten(self, "init")

    def receive(
        self, state: PyTree, x: jax.Array, u: jax.Array, key: jax.Array, k: jax.Array
    ) -> tuple[PyTree, Measurements]:
        """Return the medium's next state, and what the nodes receive at step k, (node, received) by group.

        Numbers that do not arrive are NaN.

        Args:
            state: state of the medium before the step.
            x: state of the plant (n,) after the inputs u.
            u: inputs of the plant over the step.
            key: key of the run.
            k: number of the step.
        """
        raise unwritten(self, "receive")

    def feed_back(self, state: PyTree, estimates: Sequence[Estimate]) -> PyTree:
        """Return the medium's state with the filters' `estimates` after their step, by stack, (filter, node, ...)."""
        return state

    def reasons(self, state: PyTree) -> dict[str, jax.Array]:
        """Return, by number of the group, why senders that decide transmitted at this step (node, m); none here."""
        return {}


class NodeGroup(Module):
    """Sensors and channels of a group of nodes, stacked; a leading axis of nodes.

    Args:
        sensor: of the nodes.
        inputs: names of the plant's inputs, which a sensor may depend on.
        channel: of the nodes; it carries the words' bits where nodes send words.
        checksums: of the nodes' names (node,), which seed their draws.
        memories: numbers that seed the draws of a channel's memories (node, memory).
        modes: numbers that seed the draws of a sensor's memories (node, memory).
        reference_filter: filters whose estimates are fed back to the sensors, or predict for the triggers; or None.
        trigger: when nodes send; None where they always do.
        encoder: of the words that nodes send; None where they send y.
        informed_at: (stack, number within the stack) of the `reference_filter`; None without.
        reader: puts the bits that arrive together to words; None without words.
        range: lowest and highest number that counts (node, received); what is beyond is refused. None without limits.
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
    range: tuple[Float[Array, "node received"], Float[Array, "node received"]] | None


class NodesWithoutSensor(Module):
    """Nodes without a sensor."""

    count: int = eqx.field(static=True)
    informed_at: None = eqx.field(static=True, default=None)


class LinkState(NamedTuple):
    """State of the transmission to one node.

    Args:
        memory: state of the channel.
        feed_back: estimate (n,) last fed back to the sensor; None without feedback.
        sender: state of the trigger; None without one.
        modes: states of the sensor's memories.
    """

    memory: PyTree
    feed_back: jax.Array | None
    sender: SenderState | None = None
    modes: tuple[jax.Array, ...] = ()


class SeparateChannels(AbstractMedium):
    """Medium of nodes with a sensor and a channel each."""

    groups: tuple[NodeGroup | NodesWithoutSensor, ...]

    def init(self, key: jax.Array) -> PyTree:
        """Return the links' states before the first step by group, (node, ...); () of nodes without a sensor."""

        def start_node(group: NodeGroup) -> LinkState:
            """Return the initial state of one node's link; `group` is the row of its group that is the node's.

            The channel and the sensor begin in states that are drawn. A sender that decides when to transmit begins
            with nothing sent. The estimate fed back to the sensor, or compared by the sender, is the filter's first.
            """
            feed_back = None if group.reference_filter is None else _get_initial_mean(group.reference_filter)
            outputs = len(first(group.sensor).outputs)
            sender = None if group.trigger is None else group.trigger.start(outputs)
            modes = start_modes(group.sensor, key, group.modes)
            # `checksums` are of the nodes' names, one each: they seed a node's own draws.
            memory = start_channel(group.channel, key, group.checksums, group.memories)
            return LinkState(memory=memory, feed_back=feed_back, sender=sender, modes=modes)

        states: list[PyTree] = []
        for group in self.groups:
            if isinstance(group, NodesWithoutSensor):
                states.append(())
            else:
                nodes = len(group.checksums)
                states.append(map_all(start_node, nodes)(group))
        return tuple(states)

    def receive(
        self, state: PyTree, x: jax.Array, u: jax.Array, key: jax.Array, k: jax.Array
    ) -> tuple[PyTree, Measurements]:
        """Return the links' next states, and what each node receives of its measurement of x through its own channel.

        Args:
            state: states of the links (memory of the channel, of the trigger and of the sensor) before the step, by
                group; a group is a stack of nodes of one structure.
            x: the plant's state after the step (n,).
            u: inputs of the plant over the step (inputs,).
            key: random key of the run.
            k: number of the step.

        Returns:
            The links' next states, and the measurements (node, received), both by group.
        """

        def receive_group(group: NodeGroup | NodesWithoutSensor, link: PyTree) -> tuple[PyTree, jax.Array]:
            """Return the links of one group of nodes after the step, and what its nodes receive of x."""
            if isinstance(group, NodesWithoutSensor):
                return link, jnp.zeros((group.count, 0))
            nodes = len(group.checksums)
            transmit = map_all(lambda node, state: _transmit(node, state, x, u, key, k), nodes)
            return cast(tuple[PyTree, jax.Array], transmit(group, link))

        results = [receive_group(group, link) for group, link in zip(self.groups, state, strict=True)]
        return tuple(after for after, _ in results), tuple(z for _, z in results)

    def feed_back(self, state: PyTree, estimates: Sequence[Estimate]) -> PyTree:
        """Return the links' state with the present estimate of each filter that is fed back to its sensor.

        `estimates`: the nodes' estimates by stack of filters, (filter, node, ...).
        """

        def feed_group(group: NodeGroup | NodesWithoutSensor, link: PyTree) -> PyTree:
            """Return the links of one group of nodes with the estimates that are fed back to their senders.

            `group.informed_at`: (stack, filter) of these estimates in the stacked filters, or None if nothing is fed
            back.
            """
            if group.informed_at is None:
                return link
            stack, filter = group.informed_at
            return link._replace(feed_back=estimates[stack].mean[filter])

        return tuple(feed_group(group, link) for group, link in zip(self.groups, state, strict=True))

    def reasons(self, state: PyTree) -> dict[str, jax.Array]:
        """Return, by number of the group, why senders with a trigger transmitted at this step, (node, m).

        A trigger decides whether a sender transmits, and stores the reason of its last decision (`sender.last`) for
        each of the m components.
        """
        reasons = {}
        for group, link in enumerate(state):
            if isinstance(link, LinkState) and link.sender is not None:  # its nodes have sensors and triggers
                reasons[str(group)] = link.sender.last
        return reasons


def _transmit(
    node: NodeGroup, link: LinkState, x: jax.Array, u: jax.Array, key: jax.Array, k: jax.Array
) -> tuple[LinkState, jax.Array]:
    """Measure x at one node and deliver through its channel: return the link after step k, and what is received.

    Args:
        node: sensor, channel and sending rule of the node: one row of its `NodeGroup`.
        link: states of channel, feedback, sender and sensor modes before the step.
        x: state of the plant at step k.
        u: inputs of the plant over the step.
        key: key of the run; each draw gets its own from it, the step and what it is for.
        k: number of the step.
    """
    # y = h(x) + v with the sensor in its present modes (states of Markov chains); then the modes move on.
    sensor = condition_on_memories(at(node.sensor, k), link.modes).under(node.inputs, u)
    modes = move_modes(node.sensor, link.modes, key, k, node.modes)
    y = measure(sensor, x, draw_key(key, k, node.checksums, SENSOR))
    # A filter's last estimate may be fed back to the sensor, which predicts its output r (`reference`) from it. A
    # sensor with feedback sends y - r.
    reference: jax.Array | None = None
    if node.reference_filter is not None and link.feed_back is not None:
        reference = node.reference_filter.predict_reference(link.feed_back, u, k)
    if isinstance(node.reference_filter, FedBackFilter) and reference is not None:
        y = y - reference
    y, z, memory = _send_through_channel(node, link.memory, y, key, k)
    if node.trigger is None or link.sender is None:  # it always sends
        return LinkState(memory=memory, feed_back=link.feed_back, modes=modes), _leave_out_refused(node, z, len(y))
    # The sender sends or not by how far y is from a reference: its own, or the filter's prediction r.
    sender = link.sender
    if node.trigger.reference == "prediction" and reference is not None:
        sender = sender._replace(reference=reference)
    drawn = draw_key(key, k, node.checksums, TRIGGER)
    sender, z = node.trigger.receive_if_sent(sender, y, z, drawn, k)
    z = _leave_out_refused(node, z, len(y))
    return LinkState(memory=memory, feed_back=link.feed_back, sender=sender, modes=modes), z


def _leave_out_refused(node: NodeGroup, z: jax.Array, outputs: int) -> jax.Array:
    """Return what a node received without the numbers beyond its limits, NaN in their place, as of recorded data.

    Args:
        node: the node, with the `range` of what counts, and the trigger by which its sender sends: a value that is
            refused was sent all the same.
        z: what it received (received,).
        outputs: length of the sensor's signal.
    """
    if node.range is None:
        return z
    low, high = node.range
    is_refused = (z < low) | (z > high)
    if node.trigger is None:
        return jnp.where(is_refused, jnp.nan, z)
    return jnp.asarray(node.trigger.leave_out_refused(z, is_refused, outputs))


def _send_through_channel(
    group: NodeGroup, memory: PyTree, y: jax.Array, key: jax.Array, k: jax.Array
) -> tuple[jax.Array, jax.Array, PyTree]:
    """Return what was sent of y, what is received of it, and the channel's memory after step k.

    With an encoder, y is sent as codewords of few bits. The channel carries the bits as numbers, from which
    `group.reader` reads the codewords.
    """
    if group.encoder is None or group.reader is None:
        memory, z = deliver_signal(group.channel, memory, y, key, k, group.checksums, group.memories)
        return y, z, memory
    codewords, bits = group.encoder.send(y, draw_key(key, k, group.checksums, DITHER))
    memory, received = deliver_signal(group.channel, memory, bits, key, k, group.checksums, group.memories)
    return codewords, group.reader.read_words(group.encoder, len(y), received), memory


def _get_initial_mean(filter: AbstractFilter) -> jax.Array:
    """Return a filter's mean before the first step."""
    return jnp.asarray(filter.estimate(filter.init()).mean)


def measure(sensor: AbstractSensor, x: jax.Array, key: jax.Array) -> jax.Array:
    """Return what the sensor reports of y = h(x) + v, v drawn by `key`; angles between -pi and pi."""
    return wrap_angles(sensor.noise.report(sensor.measure(x) + sensor.noise.sample(key)), sensor.angles)


class CommonChannel(AbstractMedium):
    """Medium of nodes with one sensor and channel, drawn once a step; each node receives its rows of the output."""

    sensor: AnySensor
    channel: Channel
    rows: tuple[np.ndarray, ...]  # (node, received) of each group

    def init(self, key: jax.Array) -> PyTree:
        """Return the past signals of a late channel; the channel has no other memory."""
        return start_channel(self.channel, key, checksum(SENDER), ())

    def receive(
        self, state: PyTree, x: jax.Array, u: jax.Array, key: jax.Array, k: jax.Array
    ) -> tuple[PyTree, Measurements]:
        """Return the channel's next state, and what each node receives through the one channel of all nodes, by group.

        Each node gets its own rows of its output (`self.rows`). `x`, `u`: the plant's state after the step, and its
        inputs over it. `key`: of the run.
        """
        sensor, source = at(self.sensor, k), checksum(SENDER)
        y = measure(sensor, x, draw_key(key, k, source, SENSOR))
        state, z = deliver_signal(self.channel, state, y, key, k, source, shared=())
        return state, tuple(z[rows] for rows in self.rows)
