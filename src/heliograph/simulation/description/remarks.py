"""What filters say of their states at the end of a run, such as that a gate gave in."""

from collections.abc import Iterator

import jax

from heliograph.filters.base import AbstractFilter
from heliograph.numerics.types import PyTree
from heliograph.simulation.network import FUSED, Network


def list_remarks(network: Network, state: PyTree) -> Iterator[str]:
    """Yield what each filter says of its state, a line each.

    Args:
        network: the network.
        state: states of all its filters, as the step of the network has them.
    """
    alike, central = state[0], state[1]
    for (node, name), place in network.places.items():
        filter = network.nodes[node].filters[name]
        row = place.filter * len(network.groups[network.kinds[place.kind].group]) + place.node
        if _can_remark(filter) and (
            said := filter.remark(jax.tree.map(lambda leaf, r=row: leaf[r], alike[place.kind]))
        ):
            yield f"{node}/{name}: {said}"
    for name, fusion in network.fused.items():
        if isinstance(fusion, AbstractFilter) and _can_remark(fusion) and (said := fusion.remark(central[name])):
            yield f"{FUSED}/{name}: {said}"


def _can_remark(filter: AbstractFilter) -> bool:
    """Ask whether a filter ever says anything."""
    return type(filter).remark is not AbstractFilter.remark
