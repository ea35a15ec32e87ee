"""Nodes of one structure run side by side: stacked along a leading axis and vmapped, under the scan over time."""

from typing import Any, NamedTuple
from zlib import crc32

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.fusion.quantizer import Quantized, widen
from heliograph.fusion.rules import Fusion
from heliograph.model.estimate import Estimate
from heliograph.model.over_time import alike, at, stack
from heliograph.simulation.network import FUSED, Network, Node


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


class AllFilters:
    """Every filter of a network stepped once: nodes of a group vmapped, then fusion rules and central filters."""

    def __init__(self, network: Network, parts: list[Group]):
        self.network, self.parts = network, parts
        self.central = {name: item for name, item in network.fused.items() if isinstance(item, AbstractFilter)}
        self.rules = {name: item for name, item in network.fused.items() if isinstance(item, Fusion)}
        uplinks = {name: item.uplinks(network.nodes_with(item.filter)) for name, item in self.rules.items()}
        self.uplinks = {name: uplink for name, uplink in uplinks.items() if uplink is not None}

    def init(self) -> tuple[list[Any], dict[str, Any]]:
        """States before the first step: of groups and uplinks with a leading node axis, and of each central filter."""
        groups = [eqx.filter_vmap(_init, in_axes=eqx.if_array(0))(part.stacked) for part in self.parts]
        n = len(self.network.states)
        start = eqx.filter_vmap(lambda uplink: at(uplink, 0).init(n), in_axes=eqx.if_array(0))
        return groups, _initial(self.central) | {name: start(uplink) for name, uplink in self.uplinks.items()}

    def __call__(self, states: Any, z: dict[str, jax.Array], u: jax.Array, k: jax.Array) -> tuple[Any, Any]:
        """One step of all filters from the measurements of each node.

        Gives "estimates" by node and filter and, where a fusion has quantizers, "uplinks" by the fusion's name.
        """
        step = eqx.filter_vmap(_step, in_axes=(eqx.if_array(0), eqx.if_array(0), eqx.if_array(0), None, None))
        after, estimates = [], {}
        for part, state in zip(self.parts, states[0], strict=True):
            following, group = step(part.stacked, state, jnp.stack([z[name] for name in part.names]), u, k)
            after.append(following)
            for i, name in enumerate(part.names):
                estimates[name] = jax.tree.map(lambda leaf, i=i: leaf[i], group)
        central, fused, sent = self._fuse(states[1], estimates, z, u, k)
        if self.network.fused:
            estimates[FUSED] = fused
        return (after, central), {"estimates": estimates} | ({"uplinks": sent} if sent else {})

    def _fuse(self, states: Any, estimates: Any, z: Any, u: jax.Array, k: jax.Array) -> tuple[Any, Any, Any]:
        joined = jnp.concatenate([z[name] for name in self.network.names])
        results = {name: item.step(states[name], joined, u, k) for name, item in self.central.items()}
        after, fused = ({name: result[part] for name, result in results.items()} for part in (0, 1))
        uplinks = {}
        for name, fusion in self.rules.items():
            local = [estimates[node][fusion.filter] for node in self.network.nodes_with(fusion.filter)]
            means, bounds = jnp.stack([e.mean for e in local]), jnp.stack([e.covariance for e in local])
            if name in self.uplinks:
                after[name], sent = _send(self.uplinks[name], states[name], means, k)
                means, bounds = jnp.asarray(sent.value), jax.vmap(widen)(bounds, jnp.asarray(sent.error))
                uplinks[name] = {"saturated": sent.saturated, "symbols": sent.symbols}
            fused[name] = Estimate(*fusion.rule.combine(means, bounds), fusion.claim([e.claim for e in local]))
        return after, fused, uplinks


def _send(uplinks: Any, states: Any, means: jax.Array, k: jax.Array) -> tuple[Any, Quantized]:
    """Each node's mean (node, n) through its own quantizer."""
    step = eqx.filter_vmap(lambda uplink, state, mean: at(uplink, k).step(state, mean), in_axes=(eqx.if_array(0), 0, 0))
    result: tuple[Any, Quantized] = step(uplinks, states, means)
    return result


def _init(node: Node) -> dict[str, Any]:
    return _initial(node.filters)


def _initial(filters: dict[str, AbstractFilter]) -> dict[str, Any]:
    return {name: jax.tree.map(jnp.asarray, item.init()) for name, item in filters.items()}


def _step(
    node: Node, states: dict[str, Any], z: jax.Array, u: jax.Array, k: jax.Array
) -> tuple[dict[str, Any], dict[str, Estimate]]:
    results = {name: item.step(states[name], z, u, k) for name, item in node.filters.items()}
    return {name: r[0] for name, r in results.items()}, {name: r[1] for name, r in results.items()}
