"""Transmission of a network, built: its nodes by structure, or the slots and hops of its relays."""

from collections.abc import Mapping

import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.over_time import stack
from heliograph.model.relays import RelayNetwork
from heliograph.model.sensor import AnySensor, without_output_names
from heliograph.model.words.word_channel import reader_of, rewrite_in_bits
from heliograph.numerics.types import PyTree
from heliograph.random_affine.memory import drop_names, memories
from heliograph.simulation.network import LOCAL, Network
from heliograph.simulation.node import Node
from heliograph.simulation.random_keys import checksum
from heliograph.simulation.transmission.reception import (
    AbstractMedium,
    CommonChannel,
    NodeGroup,
    NoSensor,
    SeparateChannels,
    SlottedRelays,
    find_hops_with_memory,
)
from heliograph.simulation.transmission.shared_fading import number_memories


def make_reception(network: Network) -> AbstractMedium:
    """Build the transmission from the plant to the nodes of a network."""
    if network.relays is not None:
        return _make_slots(network, network.relays)
    if network.common is not None:
        rows = network.rows
        received = tuple(np.array([rows[name] for name in names]) for names in network.groups)
        return CommonChannel(network.common.sensor, network.common.channel, received)
    # A sensor and a channel for each node, stacked by group.
    nodes = {name: node for name, node in network.nodes.items() if isinstance(node, Node)}
    memories_of = number_memories({name: (node.sensor, node.channel) for name, node in nodes.items()}, network.plant)
    groups = [[name for name in names if name in nodes] for names in network.groups]
    return SeparateChannels(tuple(
        _stack_group(network, {name: nodes[name] for name in sensing}, memories_of) if sensing else NoSensor(len(names))
        for sensing, names in zip(groups, network.groups, strict=True)
    ))  # fmt: skip


def _make_slots(network: Network, relays: RelayNetwork) -> SlottedRelays:
    """Build the transmission through relays that send in slots."""
    listeners = {name: i for i, name in enumerate(relays.filters)}
    return SlottedRelays(
        relays=relays,
        estimates_at=tuple(network.places[name, LOCAL] for name in relays.relays),
        groups=tuple(tuple(listeners[name] for name in names) for names in network.groups),
        memories=number_memories({name: hop for name, (_, _, _, hop) in find_hops_with_memory(relays).items()}),
    )


def _stack_group(network: Network, nodes: Mapping[str, Node], memories_of: Mapping[str, np.ndarray]) -> NodeGroup:
    """Return the nodes of a group, stacked; `memories_of` each node: places of its sensor's and channel's memories."""
    first_name, first_node = next(iter(nodes.items()))
    # Sensor, channel, and where their draws and memories stand.
    pairs = [(without_output_names(node.sensor), _carrying_channel(node)) for node in nodes.values()]
    # Memories are told apart by their places: without their names the nodes stack.
    pairs = [drop_names(pair) if len(memories_of[key]) else pair for pair, key in zip(pairs, nodes, strict=True)]
    sensor, channel = stack(pairs)
    rows_of = [_split_places((node.sensor, node.channel), memories_of[key]) for key, node in nodes.items()]
    of_sensor, memory_rows = (np.stack(parts) for parts in zip(*rows_of, strict=True))
    # What a sender that decides knows: its filter, its rule.
    filter_name: str | None = first_node.informed_by or first_node.predictor
    reference: PyTree = None
    if filter_name is not None:
        reference = stack([without_output_names(node.filters[filter_name]) for node in nodes.values()])
    triggers: PyTree = [node.trigger for node in nodes.values()]
    encoders: PyTree = [node.encoder for node in nodes.values()]
    return NodeGroup(
        sensor=sensor,
        inputs=network.inputs,
        channel=channel,
        checksums=np.array([checksum(key) for key in nodes], dtype=np.uint32),
        memories=memory_rows,
        modes=of_sensor,
        reference_filter=reference,
        trigger=None if triggers[0] is None else stack(triggers),
        encoder=None if encoders[0] is None else stack(encoders),
        informed_at=None if filter_name is None else network.places[first_name, filter_name][:2],
        reader=None if encoders[0] is None else reader_of(first_node.channel),
    )


def _carrying_channel(node: Node) -> Channel:
    """Return the channel of the numbers by which a node's signal is carried: its words' bits where it sends words."""
    return node.channel if node.encoder is None else rewrite_in_bits(node.encoder, node.channel)


def _split_places(observed: tuple[AnySensor, Channel], places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split the places of the memories of sensor and channel together: return those of the sensor, of the channel."""
    by_identity = dict(zip(memories(observed), places, strict=True))
    of_sensor, of_channel = ([by_identity[identity] for identity in memories(part)] for part in observed)
    return np.array(of_sensor, np.uint32), np.array(of_channel, np.uint32)
