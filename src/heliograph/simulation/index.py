"""Index of a network: nodes and filters of one structure together, and where each estimate stands."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from heliograph.model.over_time import structure


class Kind(NamedTuple):
    """Filters that differ in numbers alone: `filters` of the nodes of one group."""

    group: int
    filters: tuple[str, ...]


class Place(NamedTuple):
    """Where an estimate stands: which kind of filters, and which filter and node along its axes."""

    kind: int
    filter: int
    node: int


def places_of(groups: Sequence[Sequence[str]], kinds: Sequence[Kind]) -> dict[tuple[str, str], Place]:
    """Return the place of each estimate, by node and filter."""
    return {
        (node, name): Place(k, f, i)
        for k, kind in enumerate(kinds)
        for f, name in enumerate(kind.filters)
        for i, node in enumerate(groups[kind.group])
    }


def group_by_structure(items: Iterable[tuple[str, object]]) -> tuple[tuple[str, ...], ...]:
    """Group names by the structure of their items, in order of first appearance."""
    results: dict[object, list[str]] = {}
    for name, described in items:
        results.setdefault(structure(described), []).append(name)
    return tuple(tuple(names) for names in results.values())
