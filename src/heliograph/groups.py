"""Nodes of one structure run side by side: stacked along a leading axis and vmapped, under the scan over time."""

from typing import Any, NamedTuple
from zlib import crc32

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filter.base import Estimate
from heliograph.network import Network, Node
from heliograph.over_time import alike, stack


class Group(NamedTuple):
    """Nodes that share structure and shapes, stacked; checksums of their names identify their random draws."""

    names: tuple[str, ...]
    stacked: Node
    checksums: np.ndarray


def groups(network: Network) -> list[Group]:
    """Group the network's nodes by structure, in order of first appearance."""
    collected: list[tuple[list[str], list[Node]]] = []
    for name, node in network.nodes.items():
        for names, members in collected:
            if alike(node, members[0]):
                names.append(name)
                members.append(node)
                break
        else:
            collected.append(([name], [node]))
    return [
        Group(tuple(names), stack(members), np.array([crc32(n.encode()) for n in names], dtype=np.uint32))
        for names, members in collected
    ]


class NodeSteps:
    """Every filter of every group, stepped once: the node axis is vmapped, the groups are a list."""

    def __init__(self, parts: list[Group]):
        self.parts = parts

    def init(self) -> list[Any]:
        """States before the first step, for each group a dictionary by filter with a leading node axis."""
        return [eqx.filter_vmap(_init, in_axes=eqx.if_array(0))(part.stacked) for part in self.parts]

    def __call__(self, states: list[Any], z: list[Any], u: jax.Array, k: jax.Array) -> tuple[list[Any], list[Any]]:
        """One step of all filters; estimates have a leading node axis."""
        step = eqx.filter_vmap(_step, in_axes=(eqx.if_array(0), eqx.if_array(0), eqx.if_array(0), None, None))
        results = [step(part.stacked, s, z_part, u, k) for part, s, z_part in zip(self.parts, states, z, strict=True)]
        return [r[0] for r in results], [r[1] for r in results]


def _init(node: Node) -> dict[str, Any]:
    return {name: jax.tree.map(jnp.asarray, item.init()) for name, item in node.filters.items()}


def _step(
    node: Node, states: dict[str, Any], z: jax.Array, u: jax.Array, k: jax.Array
) -> tuple[dict[str, Any], dict[str, Estimate]]:
    results = {name: item.step(states[name], z, u, k) for name, item in node.filters.items()}
    return {name: r[0] for name, r in results.items()}, {name: r[1] for name, r in results.items()}


def scatter(parts: list[Group], estimates: list[dict[str, Estimate]], axis: int) -> dict[str, dict[str, Estimate]]:
    """Estimates by node and filter, from those of groups with the node axis at `axis`."""
    return {
        name: jax.tree.map(lambda leaf, i=i: jnp.take(leaf, i, axis=axis), group)
        for part, group in zip(parts, estimates, strict=True)
        for i, name in enumerate(part.names)
    }
