"""Transmission of a network, built: its nodes by structure, or the slots and hops of its relays."""

from collections.abc import Mapping, Sequence

import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.over_time import stack
from heliograph.model.relays import RelayNetwork
from heliograph.model.sensor import AnySensor, without_output_names
from heliograph.model.words.word_channel import make_word_reader, rewrite_in_bits
from heliograph.numerics.types import PyTree
from heliograph.random_affine.memories_of_channels import drop_names, memories
from heliograph.simulation.network import LOCAL, Network
from heliograph.simulation.node import Node
from heliograph.simulation.random_keys import checksum
from heliograph.simulation.transmission.channel_draws import number_memory_seeds
from heliograph.simulation.transmission.medium import (
    AbstractMedium,
    CommonChannel,
    NodeGroup,
    NodesWithoutSensor,
    SeparateChannels,
)
from heliograph.simulation.transmission.slotted_relays import SlottedRelays, find_hops_with_memory


def make_reception(network: Network) -> AbstractMedium:
    """Return the medium of a network: what transmits from the plant to its nodes, over sensors, channels and relays."""
    if network.relays is not None:
        return _make_slots(network, network.relays)
    if network.common is not None:
        rows = network.rows
        received = tuple(np.array([rows[name] for name in names]) for names in network.groups)
        return CommonChannel(network.common.sensor, network.common.channel, received)
    # A sensor and a channel for each node. The numbers that seed the draws of a node's memories, the states of sensor
    # and channel that are random over time, follow from names: nodes that share a memory draw it alike.
    nodes = {name: node for name, node in network.nodes.items() if isinstance(node, Node)}
    memories_of = number_memory_seeds(
        {name: (node.sensor, node.channel) for name, node in nodes.items()}, network.plant
    )
    # A group has the same structure in all its nodes, so that they stack: all of them have a sensor, or none has.
    media: list[NodeGroup | NodesWithoutSensor] = []
    for names in network.groups:
        nodes_with_sensor = {name: nodes[name] for name in names if name in nodes}
        if nodes_with_sensor:
            media.append(_stack_group(network, nodes_with_sensor, memories_of))
        else:
            media.append(NodesWithoutSensor(len(names)))
    return SeparateChannels(tuple(media))


def _make_slots(network: Network, relays: RelayNetwork) -> SlottedRelays:
    """Return the medium of a network's relays, which send to each other in slots, one after another within a step.

    A slot says who sends to whom over which hop (link); slots take turns, step by step. The medium is what transmits.
    """
    number_of_listener = {name: i for i, name in enumerate(relays.filters)}
    listeners_by_group = [tuple(number_of_listener[name] for name in names) for names in network.groups]
    hops = {name: hop.channel for name, hop in find_hops_with_memory(relays).items()}
    return SlottedRelays(
        relays=relays,
        estimates_at=tuple(network.estimate_indices[name, LOCAL] for name in relays.relays),
        groups=tuple(listeners_by_group),
        memories=number_memory_seeds(hops),
    )


def _stack_group(network: Network, nodes: Mapping[str, Node], memories_of: Mapping[str, np.ndarray]) -> NodeGroup:
    """Return the nodes of a group with their arrays stacked along a leading axis, so that JAX maps over the nodes.

    A memory is a random mode of a sensor or channel that lasts over steps, such as a Markov chain of losses.

    Args:
        network: the network.
        nodes: the nodes of the group by name, whose sensors and channels have one structure.
        memories_of: by node, the numbers that seed the draws of its sensor's and its channel's memories.
    """
    first_name, first_node = next(iter(nodes.items()))
    # Sensors and channels. Memories are told apart by the numbers that seed them: without their names the nodes stack.
    pairs, seeds = [], []
    for name, node in nodes.items():
        pair = without_output_names(node.sensor), _get_carrying_channel(node)
        pairs.append(drop_names(pair) if len(memories_of[name]) else pair)
        seeds.append(_split_seeds((node.sensor, node.channel), memories_of[name]))
    sensor, channel = stack(pairs)
    sensor_seeds, channel_seeds = (np.stack(seeds_of_nodes) for seeds_of_nodes in zip(*seeds, strict=True))
    # What the sender knows of the receiver: the filter that is fed back to it, or whose prediction it compares with.
    filter_name: str | None = first_node.informed_by or first_node.predictor
    reference: PyTree = None
    if filter_name is not None:
        reference = stack([without_output_names(node.filters[filter_name]) for node in nodes.values()])
    index_of_reference = None if filter_name is None else network.estimate_indices[first_name, filter_name]
    return NodeGroup(
        sensor=sensor,
        inputs=network.inputs,
        channel=channel,
        checksums=np.array([checksum(name) for name in nodes], dtype=np.uint32),
        memories=channel_seeds,
        modes=sensor_seeds,
        reference_filter=reference,
        trigger=_stack_if_any([node.trigger for node in nodes.values()]),
        encoder=_stack_if_any([node.encoder for node in nodes.values()]),
        informed_at=None if index_of_reference is None else (index_of_reference.stack, index_of_reference.filter),
        reader=None if first_node.encoder is None else make_word_reader(first_node.channel),
        range=_stack_ranges(list(nodes.values())),
    )


def _stack_ranges(nodes: Sequence[Node]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the lowest and the highest numbers that count at some nodes (node, received); None where all count."""
    if not any(node.limits is not None and node.limits.has_range for node in nodes):
        return None
    no_limit = np.full(nodes[0].received, np.inf)
    low = np.stack([-no_limit if node.limits is None else node.limits.low for node in nodes])
    high = np.stack([no_limit if node.limits is None else node.limits.high for node in nodes])
    return low, high


def _stack_if_any(parts: Sequence[PyTree]) -> PyTree:
    """Return the triggers, or the encoders, of a group's nodes stacked; None where the nodes have none."""
    return None if parts[0] is None else stack(parts)


def _get_carrying_channel(node: Node) -> Channel:
    """Return the channel of the numbers by which a node's signal is carried: its words' bits where it sends words."""
    return node.channel if node.encoder is None else rewrite_in_bits(node.encoder, node.channel)


def _split_seeds(observed: tuple[AnySensor, Channel], seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the seeds of the sensor's memories and those of the channel's memories, out of the seeds of both together.

    A memory that both have is in both results.
    """
    # `memories` returns {identity: memory}; an identity is the memory's name, or unique if it has none.
    seed_by_identity = dict(zip(memories(observed), seeds, strict=True))
    sensor, channel = observed
    of_sensor = [seed_by_identity[identity] for identity in memories(sensor)]
    of_channel = [seed_by_identity[identity] for identity in memories(channel)]
    return np.array(of_sensor, np.uint32), np.array(of_channel, np.uint32)
