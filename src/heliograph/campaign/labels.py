"""Labels of the axes of a campaign's store, shared by its settings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypedDict

from heliograph.numerics.check import fail
from heliograph.simulation.network import Network

Claims = dict[str, dict[str, str]]


@dataclass(frozen=True)
class Labels:
    """Names along the axes of a campaign's store, and the size of the largest measurement."""

    states: tuple[str, ...]
    nodes: tuple[str, ...]
    filters: tuple[str, ...]
    received: int


class Table(TypedDict):
    """Labels in a form that JSON can represent."""

    states: Sequence[str]
    nodes: Sequence[str]
    filters: Sequence[str]
    received: int


class Description(TypedDict):
    """Labels of one network and its claims by node and filter, in a form that JSON can represent."""

    labels: Table
    claims: Claims


def describe(network: Network) -> Description:
    """Return labels and claims of one network."""
    claims: Claims = {node: dict(filters) for node, filters in network.claims().items()}
    labels = Table(
        states=network.states,
        nodes=tuple(claims),
        filters=tuple(dict.fromkeys(name for filters in claims.values() for name in filters)),
        received=max(node.received for node in network.nodes.values()),
    )
    return {"labels": labels, "claims": claims}


def labels_from(table: Table) -> Labels:
    """Restore labels from the form that `describe` returns."""
    return Labels(tuple(table["states"]), tuple(table["nodes"]), tuple(table["filters"]), table["received"])


def join(parts: Mapping[int, Labels]) -> Labels:
    """Return the union of the labels of all settings, in order of first appearance."""
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
