"""Remarks of filters on their own states after a run, such as that a gate gave in."""

from collections.abc import Iterator

import jax

from heliograph.filters.base import AbstractFilter
from heliograph.filters.remark import Remark
from heliograph.numerics.types import PyTree
from heliograph.simulation.network import FUSED, Network

Place = tuple[str, str]  # node and filter


def find_remarking_filters(network: Network) -> tuple[Place, ...]:
    """Return the places (node, name) of the filters that may remark on their state; FUSED is the centre's "node".

    A remark is what a filter has to say of its state after a run, such as how often its gate gave in. A filter of all
    nodes' measurements stands at the centre.
    """
    places = [(node, name) for node, name in network.estimate_indices if network.nodes[node].filters[name].remarks]
    for name, fusion in network.fused.items():
        if isinstance(fusion, AbstractFilter) and fusion.remarks:  # a filter of all nodes' measurements
            places.append((FUSED, name))
    return tuple(places)


def yield_remarks(network: Network, state: PyTree) -> Iterator[tuple[Place, Remark]]:
    """Yield each remark that a filter makes on its state, with the filter's place.

    A stack has filters of one structure, at nodes of one structure (a group). A place is (node, name), with FUSED in
    place of the node of a central filter, which receives all measurements.

    Args:
        network: the network.
        state: states of all filters, as `NetworkFilters.init` returns them: stacks, then central ones by name.
    """
    stacks, central, *_ = state  # states of the nodes' filters by stack, and of the central ones by name
    for node, name in find_remarking_filters(network):
        if node == FUSED:
            fusion = network.fused[name]
            assert isinstance(fusion, AbstractFilter)
            yield (node, name), fusion.remark(central[name])
            continue
        index = network.estimate_indices[node, name]
        # A stack has the first filter of all nodes, then the second filter of all nodes, and so on.
        row = index.filter * len(network.groups[network.stacks[index.stack].group]) + index.node
        filter_state = jax.tree.map(lambda leaf, row=row: leaf[row], stacks[index.stack])
        yield (node, name), network.nodes[node].filters[name].remark(filter_state)


def describe_remarks(network: Network, state: PyTree) -> list[str]:
    """Return a line for each filter that remarks on its state, if what it remarks on happened at least once."""
    return [f"{node}/{name}: {said.words}" for (node, name), said in yield_remarks(network, state) if said.times]
