"""The names that the settings of a campaign share: what the axes of its store are called."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypedDict

from heliograph.numerics.check import fail
from heliograph.simulation.network import Network

Claims = dict[str, dict[str, str]]


@dataclass(frozen=True)
class Labels:
    """Names along the axes of a campaign's store, and the longest measurement."""

    states: tuple[str, ...]
    nodes: tuple[str, ...]
    filters: tuple[str, ...]
    received: int


class Table(TypedDict):
    """Labels as JSON can hold them."""

    states: Sequence[str]
    nodes: Sequence[str]
    filters: Sequence[str]
    received: int


class Description(TypedDict):
    """The labels of one network, and its claims by node and filter, as JSON can hold them."""

    labels: Table
    claims: Claims


def describe(network: Network) -> Description:
    """Labels and claims of one network."""
    claims: Claims = {node: dict(filters) for node, filters in network.claims().items()}
    labels = Table(
        states=network.states,
        nodes=tuple(claims),
        filters=tuple(dict.fromkeys(name for filters in claims.values() for name in filters)),
        received=max(node.received for node in network.nodes.values()),
    )
    return {"labels": labels, "claims": claims}


def labels_from(table: Table) -> Labels:
    """The labels that `describe` gave, after their way through JSON."""
    return Labels(tuple(table["states"]), tuple(table["nodes"]), tuple(table["filters"]), table["received"])


def join(parts: Mapping[int, Labels]) -> Labels:
    """Labels that hold those of every setting, in order of first appearance.

    Raises:
        ValueError: settings whose plants have other states: their errors have no common axis.
    """
    first, labels = next(iter(parts.items()))
    for setting, other in parts.items():
        if other.states != labels.states:
            raise fail(f"setting {setting}", f"the states of setting {first}, {labels.states}", other.states)
    return Labels(
        states=labels.states,
        nodes=_union([part.nodes for part in parts.values()]),
        filters=_union([part.filters for part in parts.values()]),
        received=max(part.received for part in parts.values()),
    )


def check_within(labels: Labels, known: Labels, setting: int) -> None:
    """Raise ValueError if a setting has a name that the store was not made for."""
    lacking = [name for name in (*labels.nodes, *labels.filters) if name not in (*known.nodes, *known.filters)]
    if labels.states != known.states or labels.received > known.received or lacking:
        raise fail(f"setting {setting}", f"states, nodes and filters of the store, {known}", labels)


def _union(names: Sequence[Sequence[str]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for part in names for name in part))
