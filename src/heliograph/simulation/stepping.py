"""Filters of one kind run side by side: stacked along axes of filters and nodes, and vmapped, under the scan over time."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from heliograph.filters.base import AbstractFilter
from heliograph.fusion.quantizer import Quantized, widen
from heliograph.fusion.rules import AbstractFusion, Fusion
from heliograph.model.estimate import Claim, Estimate
from heliograph.model.over_time import at, stack
from heliograph.numerics.float64 import compiled
from heliograph.simulation.network import Network


class Alike(eqx.Module):
    """Filters that differ in numbers alone, stacked (filter, node), and the group of nodes that they belong to."""

    filters: AbstractFilter
    group: int = eqx.field(static=True)

    def init(self) -> PyTree:
        """States before the first step, (filter, node, ...)."""
        return _over_both(_initial)(self.filters)

    def step(self, states: PyTree, z: jax.Array, u: jax.Array, k: jax.Array) -> tuple[PyTree, Estimate]:
        """One step of each; z (node, received)."""

        def one(item: AbstractFilter, state: PyTree, z: jax.Array) -> tuple[PyTree, Estimate]:
            return item.step(state, z, u, k)

        over_nodes = eqx.filter_vmap(one, in_axes=(eqx.if_array(0), 0, 0))
        over_filters = eqx.filter_vmap(over_nodes, in_axes=(eqx.if_array(0), 0, None))
        result: tuple[PyTree, Estimate] = over_filters(self.filters, states, z)
        return result


class Fused(eqx.Module):
    """A fusion: its rule, where the estimates stand that it takes, and the quantizers on their way, stacked.

    `sources`: kind and filter, whose nodes' estimates follow one another; `order` brings them into the nodes' order.
    """

    rule: AbstractFusion
    order: np.ndarray | None
    quantizers: PyTree
    sources: tuple[tuple[int, int], ...] = eqx.field(static=True)
    claim: Claim = eqx.field(static=True)


class AllFilters(eqx.Module):
    """Every filter of a network: those of the nodes by kind, fusion rules, and central filters.

    `order` brings the groups' measurements, joined, into the order of the nodes.
    """

    alike: tuple[Alike, ...]
    rules: dict[str, Fused]
    central: dict[str, AbstractFilter]
    order: np.ndarray | None
    complete: tuple[bool, ...] = eqx.field(static=True)  # of each group: nothing is ever missing
    n: int = eqx.field(static=True)

    def __init__(self, network: Network):
        self.alike = tuple(
            Alike(_stacked([[network.nodes[name].filters[f] for name in network.groups[g]] for f in names]), g)
            for g, names in network.kinds
        )
        self.central = {name: item for name, item in network.fused.items() if isinstance(item, AbstractFilter)}
        fusions = {name: item for name, item in network.fused.items() if isinstance(item, Fusion)}
        self.rules = {name: _fused(network, item, network.claims()["fused"][name]) for name, item in fusions.items()}
        grouped = [name for names in network.groups for name in names]
        lengths = [network.nodes[name].received for name in grouped]
        entries = dict(zip(grouped, np.split(np.arange(sum(lengths)), np.cumsum(lengths)[:-1]), strict=True))
        self.order = _unless_sorted(np.concatenate([entries[name] for name in network.names]))
        self.complete = tuple(network.nodes[names[0]].complete for names in network.groups)
        self.n = len(network.states)

    def init(self) -> PyTree:
        """States before the first step: of the nodes' filters, of central filters, and of quantizers."""
        central = {name: _initial(item) for name, item in self.central.items()}
        start = eqx.filter_vmap(lambda item: at(item, 0).init(self.n), in_axes=eqx.if_array(0))
        sent = {name: start(item.quantizers) for name, item in self.rules.items() if item.quantizers is not None}
        return tuple(item.init() for item in self.alike), central, sent

    def step(
        self, states: PyTree, z: Sequence[jax.Array], u: jax.Array, k: jax.Array
    ) -> tuple[PyTree, dict[str, PyTree]]:
        """One step of all filters from the measurements of each group.

        Gives "estimates" by kind, (filter, node, ...), "fused" by name, and "uplinks" of what has quantizers.
        """
        own, central, sent = states
        results = [item.step(state, z[item.group], u, k) for item, state in zip(self.alike, own, strict=True)]
        estimates = tuple(estimate for _, estimate in results)
        joined = jnp.concatenate([jnp.ravel(part) for part in z])
        joined = joined if self.order is None else joined[self.order]
        heard = {name: item.step(central[name], joined, u, k) for name, item in self.central.items()}
        fused, uplinks, after = {name: estimate for name, (_, estimate) in heard.items()}, {}, {}
        for name, item in self.rules.items():
            means, covariances = _gathered(item, estimates)
            if item.quantizers is not None:
                after[name], received = _send(item.quantizers, sent[name], means, k)
                means, covariances = received.value, jax.vmap(widen)(covariances, received.error)
                uplinks[name] = {"saturated": received.saturated, "symbols": received.symbols}
            fused[name] = Estimate(*item.rule.combine(means, covariances), item.claim)
        following = tuple(state for state, _ in results), {name: state for name, (state, _) in heard.items()}, after
        return following, {"estimates": estimates, "fused": fused, "uplinks": uplinks}


@compiled
def plan(filters: AllFilters, u: Any) -> AllFilters:
    """The filters with what does not depend on data computed before, where all data arrive."""

    def one(item: AbstractFilter) -> AbstractFilter:
        return item.planned(u)

    alike = tuple(
        Alike(_over_both(one)(item.filters), item.group) if filters.complete[item.group] else item
        for item in filters.alike
    )
    central = {name: one(item) if all(filters.complete) else item for name, item in filters.central.items()}
    return eqx.tree_at(lambda f: (f.alike, f.central), filters, (alike, central))


def plans(filters: AllFilters) -> bool:
    """Whether some filter has anything to compute before."""
    return any(
        type(item).planned is not AbstractFilter.planned
        for item in (*(part.filters for part in filters.alike), *filters.central.values())
    )


def _fused(network: Network, fusion: Fusion, claim: Claim) -> Fused:
    """Where the estimates of a fusion stand."""
    nodes, places = network.nodes_with(fusion.filter), network.places()
    sources = {places[node, fusion.filter][:2]: None for node in nodes}
    found = [name for k, _ in sources for name in network.groups[network.kinds[k].group]]
    order = _unless_sorted(np.array([found.index(node) for node in nodes]))
    return Fused(fusion.rule, order, fusion.uplinks(nodes), tuple(sources), claim)


def _gathered(item: Fused, estimates: Sequence[Estimate]) -> tuple[jax.Array, jax.Array]:
    """Means (node, n) and covariances (node, n, n) that a fusion takes."""
    means = jnp.concatenate([estimates[k].mean[f] for k, f in item.sources])
    covariances = jnp.concatenate([estimates[k].covariance[f] for k, f in item.sources])
    return (means, covariances) if item.order is None else (means[item.order], covariances[item.order])


def _send(quantizers: PyTree, states: PyTree, means: jax.Array, k: jax.Array) -> tuple[PyTree, Quantized]:
    """Each node's mean (node, n) through its own quantizer."""
    step = eqx.filter_vmap(lambda item, state, mean: at(item, k).step(state, mean), in_axes=(eqx.if_array(0), 0, 0))
    result: tuple[PyTree, Quantized] = step(quantizers, states, means)
    return result


def _initial(item: AbstractFilter) -> PyTree:
    return jax.tree.map(jnp.asarray, item.init())


def _over_both(function: Any) -> Any:
    return eqx.filter_vmap(eqx.filter_vmap(function, in_axes=eqx.if_array(0)), in_axes=eqx.if_array(0))


def _stacked(rows: Sequence[Sequence[AbstractFilter]]) -> AbstractFilter:
    """Filters (filter, node) as one."""
    return stack([stack(row) for row in rows])


def _unless_sorted(order: np.ndarray) -> np.ndarray | None:
    return None if np.array_equal(order, np.arange(len(order))) else order
