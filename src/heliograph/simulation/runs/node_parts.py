"""Networks of many nodes that share nothing but the plant, simulated a few nodes at a time."""

from dataclasses import fields
from typing import TypeVar

import equinox as eqx
import jax
import numpy as np

from heliograph.model.over_time import first
from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.frozen_mapping import FrozenMapping
from heliograph.numerics.module import Module
from heliograph.numerics.types import PyTree
from heliograph.random_affine.memories_of_channels import number_unnamed_memories
from heliograph.simulation.network import Network
from heliograph.simulation.network_filters import AllFilters
from heliograph.simulation.network_index import StackIndex, find_estimate_indices
from heliograph.simulation.node import Node
from heliograph.simulation.runs.stacked_filters import StackedFilters
from heliograph.simulation.simulation_step import World
from heliograph.simulation.transmission.build_reception import make_reception
from heliograph.simulation.transmission.medium import SeparateChannels

M = TypeVar("M", bound=Module)

NODES = 4  # simulated by one program: the plant is simulated again for each so many nodes, which costs a tenth


def is_apart(network: Network) -> bool:
    """Return whether all nodes have filters and share nothing but the plant: no fusion, sensor, hop or memory.

    Then some of the nodes can be simulated alone with the same results.
    """
    nodes = [node for node in network.nodes.values() if isinstance(node, Node) and node.filters]
    all_have_filters = len(nodes) == len(network.nodes)
    are_fused = bool(network.fused or network.meshes)
    has_memory = any(first(node.channel).remembers for node in nodes)  # which channels may share
    return all_have_filters and not are_fused and not has_memory


@cache_by_object
def build_world(network: Network, smoothed_stacks: tuple[int, ...] | None = None) -> World:
    """Return the world of a network, plant, transmission and filters, once for all simulations of it.

    `smoothed_stacks`: numbers of the stacks (filters of one structure) that are smoothed; None: no smoothing.
    """
    return World(number_unnamed_memories(network.plant), make_reception(network), AllFilters(network, smoothed_stacks))


def count_parts(network: Network) -> int:
    """Return how many parts `split_nodes` makes of a network."""
    return sum(-(-len(names) // NODES) for names in network.groups)


@cache_by_object
def split_nodes(network: Network) -> tuple[tuple[Network, World], ...]:
    """Return (network, world) for parts of at most NODES nodes of one structure, of a network whose nodes are apart.

    Nodes are apart if they share nothing but the plant. A world is what is simulated: plant, channels and filters.
    The nodes of a structure are stacked once, and each part takes its rows. Stacking each part would take longer than
    simulating three hundred runs, and so would splitting the network again for each simulation.
    """
    networks_with_worlds = []
    for names in network.groups:
        network_of_group = _select_nodes(network, names)
        world = jax.tree.map(_on_host, build_world(network_of_group))
        for start in range(0, len(names), NODES):
            node_range = slice(start, start + NODES)
            networks_with_worlds.append((_select_nodes(network, names[node_range]), _select_rows(world, node_range)))
    return tuple(networks_with_worlds)


def _on_host(leaf: PyTree) -> PyTree:
    """Return an array of a device as one of NumPy; anything else as it is."""
    return np.asarray(leaf) if isinstance(leaf, jax.Array) else leaf


def _select_nodes(network: Network, names: tuple[str, ...]) -> Network:
    """Return the network of these nodes alone, all of one structure.

    Its fields are set without the constructor, which would check again what the whole network has passed.
    """
    # In the whole network these nodes are part of one group (nodes of one structure); here they are the only group,
    # number 0. A stack is the filters of one structure at the nodes of a group.
    group = next(g for g, members in enumerate(network.groups) if names[0] in members)
    stacks = tuple(StackIndex(group=0, filters=stack.filters) for stack in network.stacks if stack.group == group)
    size = network.nodes[names[0]].received  # numbers that each of them receives
    claimed = {(name, f): network.claimed[name, f] for name in names for f in network.nodes[name].filters}
    return _with_fields(
        network,
        nodes={name: network.nodes[name] for name in names},
        names=names,
        groups=(names,),
        stacks=stacks,
        estimate_indices=FrozenMapping(find_estimate_indices((names,), stacks)),  # where each filter's estimate stands
        rows=FrozenMapping({name: range(i * size, (i + 1) * size) for i, name in enumerate(names)}),
        claimed=FrozenMapping(claimed),  # what each filter claims of its covariance
    )


def _with_fields(module: M, **changed: object) -> M:
    """Return a copy of a module with these fields changed, made without its constructor, which would compute them.

    `changed`: new values by name of the field; the other fields are those of the module.
    """
    changed_copy = object.__new__(type(module))
    for field in fields(module):
        value = changed.get(field.name, getattr(module, field.name))
        object.__setattr__(changed_copy, field.name, value)  # fields are frozen
    return changed_copy


def _select_rows(world: World, nodes: slice) -> World:
    """Return the world (plant, channels and filters) of some nodes, from one whose nodes all have one structure.

    All arrays of channels and filters are stacked by node, so that these nodes have some rows of each.
    """
    assert isinstance(world.medium, SeparateChannels)

    def select(leaf: PyTree) -> PyTree:
        """Return the rows of `nodes` of an array that is stacked by node; anything else as it is."""
        return leaf[nodes] if eqx.is_array(leaf) else leaf

    medium = SeparateChannels(jax.tree.map(select, world.medium.groups))
    stacks = tuple(_select_filters(stacked, nodes) for stacked in world.filters.stacks)
    return World(world.plant, medium, _with_fields(world.filters, stacks=stacks))


def _select_filters(stacked: StackedFilters, nodes: slice) -> StackedFilters:
    """Return the filters of some nodes; they are stacked filter by filter, node after node for each.

    `nodes`: which of the nodes, by number. The result is a stack like `stacked`, of as many filters at these nodes
    alone.
    """
    count = len(range(*nodes.indices(stacked.nodes)))

    def select(leaf: PyTree) -> PyTree:
        """Return, for each filter, the rows of `nodes` (`count` of them) of an array (filter and node, ...).

        `stacked`: how many filters and nodes the array has. Anything but an array is returned as it is.
        """
        if not eqx.is_array(leaf):
            return leaf
        by_filter = leaf.reshape(stacked.count, stacked.nodes, *leaf.shape[1:])
        return by_filter[:, nodes].reshape(stacked.count * count, *leaf.shape[1:])

    return StackedFilters(
        filters=jax.tree.map(select, stacked.filters),
        group=stacked.group,
        count=stacked.count,
        nodes=count,
        smooths=stacked.smooths,
        judges=stacked.judges,
    )
