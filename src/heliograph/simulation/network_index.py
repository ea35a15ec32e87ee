"""Index of a network: nodes and filters of one structure together, and where each estimate stands."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from heliograph.model.over_time import structure_key


class StackIndex(NamedTuple):
    """Filters that differ in numbers alone, and so are stacked: those named `filters` at the nodes of one group."""

    group: int
    filters: tuple[str, ...]


class EstimateIndex(NamedTuple):
    """Where an estimate stands: number of its stack, of its filter in the stack, and of its node in the group."""

    stack: int
    filter: int
    node: int


def find_estimate_indices(
    groups: Sequence[Sequence[str]], stacks: Sequence[StackIndex]
) -> dict[tuple[str, str], EstimateIndex]:
    """Return the index of each estimate in the stacks of filters, by (node, name of the filter).

    `groups`: names of the nodes of each structure. `stacks`: filters of one structure at the nodes of a group.
    """
    return {
        (node, name): EstimateIndex(stack=k, filter=f, node=i)
        for k, stack in enumerate(stacks)
        for f, name in enumerate(stack.filters)
        for i, node in enumerate(groups[stack.group])
    }


def group_by_structure(items: Iterable[tuple[str, object]]) -> tuple[tuple[str, ...], ...]:
    """Return the names of models of one structure together, in order of first appearance.

    Models of one structure differ in the numbers of their arrays alone, so that arrays stack and one program serves
    all.
    """
    names_by_structure: dict[object, list[str]] = {}
    for name, model in items:
        names_by_structure.setdefault(structure_key(model), []).append(name)
    return tuple(tuple(names) for names in names_by_structure.values())


def list_stacks(groups: Sequence[Sequence[str]], filters: Mapping[str, Mapping[str, object]]) -> tuple[StackIndex, ...]:
    """Return the stacks of filters, group after group; a stack is filters of one structure at the nodes of one group.

    `filters`: the filters of each node, by node and name. Nodes of a group have filters of one structure, so the
    first node of a group tells for all.
    """
    return tuple(
        StackIndex(g, names_of_stack)
        for g, names in enumerate(groups)
        for names_of_stack in group_by_structure(filters[names[0]].items())
    )


def list_mesh_stacks(groups: Sequence[Sequence[str]], meshes: Mapping[str, Sequence[str]]) -> tuple[StackIndex, ...]:
    """Return a stack of one filter for each fusion between neighbours and each group of nodes that takes part in it.

    The fusions are sorted by name, as in compiled code. `meshes`: names of the fusions of each node.
    """
    all_meshes = sorted({mesh for meshes_of_node in meshes.values() for mesh in meshes_of_node})
    stacks = []
    for mesh in all_meshes:
        for group, names in enumerate(groups):
            if mesh in meshes[names[0]]:  # all nodes of a group take part in the same fusions
                stacks.append(StackIndex(group, filters=(mesh,)))
    return tuple(stacks)


def find_rows_of_nodes(received: Mapping[str, int]) -> dict[str, range]:
    """Return where each node's measurements stand among all, joined in this order; `received` says how many it has."""
    ends = accumulate(received.values())
    return {name: range(end - size, end) for (name, size), end in zip(received.items(), ends, strict=True)}


def find_measurement_order(groups: Iterable[Sequence[str]], rows: Mapping[str, range]) -> np.ndarray | None:
    """Return the order that brings measurements joined group after group into the order of the nodes.

    If z_by_group has the measurements of the first group's nodes, then of the second group's, and so on, then
    z_by_group[order] has those of the first node, of the second node, and so on. The result is None if both orders are
    the same, so that no gather is compiled.

    Args:
        groups: names of the nodes of each group.
        rows: where each node's measurements stand in the order of the nodes.
    """
    # For each measurement, group after group, its place in the order of the nodes; `argsort` inverts this.
    place_in_node_order = np.concatenate([rows[name] for names in groups for name in names])
    order = np.argsort(place_in_node_order)
    return None if np.array_equal(order, np.arange(len(order))) else order
