"""Fusion of the nodes' estimates inside a step: rules in parallel, reports, and the centres' knowledge of the nodes."""

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.fusion.joint_covariance_fusion import AbstractInformedFusion
from heliograph.fusion.network_fusion import Fusion
from heliograph.fusion.quantizer import widen
from heliograph.fusion.rules import AbstractFusion
from heliograph.model.estimate import Claim, Estimate
from heliograph.model.over_time import at, first, stack, structure
from heliograph.numerics.angle import Angles, wrap_angles, wrap_near
from heliograph.numerics.module import Module
from heliograph.numerics.types import Array, PyTree
from heliograph.simulation.centres.centre import CentreFilter, FusionCentre, along_estimates
from heliograph.simulation.centres.linearised import LinearisedCentre
from heliograph.simulation.centres.observation_model import Apart, Together, describe_channel, stack_nodes
from heliograph.simulation.centres.uplinks import InFlight, UplinkDraws, Uplinks
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.node import Node
from heliograph.simulation.runs.side_by_side import initial_state, map_all


class StackedFusions(Module):
    """Fusions that differ in numbers alone, stacked: rules, and the quantizers on the estimates' way (fusion, node).

    `sources` of each fusion: (kind, number within the kind) of the filters whose estimates it fuses, one group of nodes
    after another; `order` (fusion, node) brings what is gathered from them into the order of the fusion's nodes.
    """

    rules: AbstractFusion
    quantizers: PyTree
    order: np.ndarray
    names: tuple[str, ...] = eqx.field(static=True)
    sources: tuple[tuple[tuple[int, int], ...], ...] = eqx.field(static=True)
    claims: tuple[Claim, ...] = eqx.field(static=True)
    angles: Angles = eqx.field(static=True)

    def init(self, n: int) -> PyTree:
        """Return the initial states of the quantizers."""
        if self.quantizers is None:
            return ()
        fusions, nodes = self.order.shape
        return map_all(map_all(lambda quantizer: at(quantizer, 0).init(n), nodes), fusions)(self.quantizers)

    def step(
        self, states: PyTree, estimates: Sequence[Estimate], k: jax.Array
    ) -> tuple[PyTree, dict[str, Estimate], dict[str, PyTree]]:
        """Fuse the filters' estimates at step k, arrays (filter, node, ...) by kind.

        Returns: the quantizers' next states, the fused estimates by fusion, and what the quantizers did by fusion.
        """
        # Means and covariances in the order of each fusion's nodes.
        means = self._gather([e.mean for e in estimates])
        covariances = self._gather([e.covariance for e in estimates])
        uplinks: dict[str, PyTree] = {}
        # Quantized means, and covariances widened by the quantizers' errors.
        if self.quantizers is not None:
            fusions, nodes = self.order.shape
            send = map_all(map_all(lambda q, s, mean: at(q, k).step(s, mean), nodes), fusions)
            states, sent = send(self.quantizers, states, means)
            means, covariances = sent.value, jax.vmap(jax.vmap(widen))(covariances, sent.error)
            for i, name in enumerate(self.names):
                uplinks[name] = {"saturated": sent.saturated[i], "symbols": sent.symbols[i]}
        # Angles near those of the first node, then the rules in parallel.
        means = wrap_near(means, means[:, :1], self.angles)
        combine = map_all(lambda rule, *parts: rule.combine(*parts), len(self.names))
        mean, covariance = combine(self.rules, means, covariances)
        mean = wrap_angles(mean, self.angles)
        items = enumerate(zip(self.names, self.claims, strict=True))
        return states, {name: Estimate(mean[i], covariance[i], claim) for i, (name, claim) in items}, uplinks

    def _gather(self, parts: Sequence[jax.Array | np.ndarray]) -> jax.Array:
        """Return values of the filters, (filter, node, ...) by kind, as (fusion, node, ...) in each fusion's order."""
        joined = [jnp.concatenate([parts[kind][f] for kind, f in source]) for source in self.sources]
        # In order already: no gather is compiled.
        if all(np.array_equal(order, np.arange(len(order))) for order in self.order):
            return jnp.stack(joined)
        return jnp.stack([values[order] for values, order in zip(joined, self.order, strict=True)])


class ReportFusion(Module):
    """A fusion by reports: their uplinks, and the filter at the centre.

    `sources` and `order` as in `FusionCentre`.
    """

    uplinks: Uplinks
    centre: CentreFilter
    order: np.ndarray
    sources: tuple[tuple[int, int], ...] = eqx.field(static=True)
    nodes: tuple[str, ...] = eqx.field(static=True)

    def init(self) -> tuple[InFlight, PyTree]:
        """Return the state before any report is sent."""
        return self.uplinks.init(), initial_state(self.centre)

    def step(
        self,
        state: tuple[InFlight, PyTree],
        estimates: Sequence[Estimate],
        drawn: UplinkDraws,
        u: jax.Array,
        k: jax.Array,
    ) -> tuple[tuple[InFlight, PyTree], Estimate, dict[str, jax.Array], tuple[jax.Array, Array]]:
        """Send the nodes' means as reports, and correct the centre's filter with those that arrive at step k.

        Returns: the next state, the centre's estimate, what the quantizers did, and the reports sent with their delays.
        """
        flying, known = state
        means = jnp.concatenate([estimates[kind].mean[f] for kind, f in self.sources])[self.order]
        flying, sent, traffic = self.uplinks.send(flying, means, drawn, k)
        flying, reports = self.uplinks.arrive(flying, sent, drawn.delay)
        known, estimate = self.centre.step(known, jnp.ravel(reports)[np.array(self.centre.rows)], u, k)
        return (flying, known), estimate, traffic, (sent, drawn.delay)


def list_stacked_fusions(network: Network) -> tuple[StackedFusions, ...]:
    """Return the fusions of the network, those of one structure stacked."""
    alike: dict[object, list[str]] = {}
    for name, fusion in network.fused.items():
        if isinstance(fusion, Fusion) and not isinstance(fusion.rule, AbstractInformedFusion):
            nodes = network.nodes_with(fusion.filter)
            alike.setdefault(structure((fusion.rule, fusion.uplinks(nodes), (None,) * len(nodes))), []).append(name)
    places, claims = network.places, network.claims().get(FUSED, {})
    return tuple(_stack_fusions(network, names, places, [claims[name] for name in names]) for names in alike.values())


def _stack_fusions(
    network: Network, names: Sequence[str], places: Mapping[tuple[str, str], tuple[int, int, int]], claims: list[Claim]
) -> StackedFusions:
    """Stack fusions of one structure, with the places of the estimates that they fuse."""
    fusions = [fusion for fusion in (network.fused[name] for name in names) if isinstance(fusion, Fusion)]
    sources, orders, quantizers = [], [], []
    for fusion in fusions:
        nodes = network.nodes_with(fusion.filter)
        source, order = find_source_filters(network, places, nodes, fusion.filter)
        sources.append(source)
        orders.append(order)
        quantizers.append(fusion.uplinks(nodes))
    return StackedFusions(
        rules=stack([fusion.rule for fusion in fusions]),
        quantizers=stack(quantizers),
        order=np.array(orders),
        names=tuple(names),
        sources=tuple(sources),
        claims=tuple(claims),
        angles=first(network.plant).angles,
    )


def centres_of(network: Network) -> tuple[FusionCentre | LinearisedCentre, ...]:
    """Return the centres of the network, one for the informed fusions of each filter."""
    rules: dict[str, dict[str, AbstractInformedFusion]] = {}
    for name, fusion in network.fused.items():
        if isinstance(fusion, Fusion) and isinstance(fusion.rule, AbstractInformedFusion) and not fusion.by_report:
            rules.setdefault(fusion.filter, {})[name] = fusion.rule
    return tuple(_build_centre(network, name, rules_of_filter) for name, rules_of_filter in rules.items())


def _build_centre(
    network: Network, name: str, rules: dict[str, AbstractInformedFusion]
) -> FusionCentre | LinearisedCentre:
    """Build the centre for the nodes that have the filter `name`."""
    places, claims = network.places, network.claims()[FUSED]
    nodes = network.nodes_with(name)
    # Places of the nodes' filters, and the longest measurement.
    sources, order = find_source_filters(network, places, nodes, name)
    groups = [network.groups[network.kinds[kind].group] for kind, _ in sources]
    size = max(network.nodes[node].received for node in nodes)
    claim = claims[next(iter(rules))]
    # Gains that depend on data: moments along the estimates.
    if along_estimates(network.parts_of(name)):
        return LinearisedCentre(network.plant, rules, order, sources, size, claim)
    return FusionCentre(
        plant=network.plant,
        observation_model=_model_measurements(network, nodes, groups, order, size),
        rules=rules,
        order=order,
        sources=sources,
        size=size,
        claim=claim,
    )


def find_source_filters(
    network: Network, places: Mapping[tuple[str, str], tuple[int, int, int]], nodes: Sequence[str], name: str
) -> tuple[tuple[tuple[int, int], ...], np.ndarray]:
    """Return (kind, number within the kind) of the filters of this name at the nodes, and the nodes' order in them.

    The estimates of the sources one after another, indexed by the order, are those of `nodes`.
    """
    sources = tuple({places[node, name][:2]: None for node in nodes})
    groups = [network.groups[network.kinds[kind].group] for kind, _ in sources]
    positions = {node: i for i, node in enumerate(node for names in groups for node in names)}
    return sources, np.array([positions[node] for node in nodes])


def _model_measurements(
    network: Network, nodes: Sequence[str], groups: Sequence[Sequence[str]], order: np.ndarray, size: int
) -> Apart | Together:
    """Return the measurement models of these nodes for a centre."""
    if network.common is not None:
        rows = network.rows
        padded = [np.pad(rows[name], (0, size - len(rows[name])), constant_values=-1) for name in nodes]
        return Together(network.common.sensor, describe_channel(network.common.channel), np.array(padded))
    stacked = []
    for names in groups:
        members = [node for node in map(network.nodes.__getitem__, names) if isinstance(node, Node)]
        stacked.append(stack_nodes([node.sensor for node in members], [node.channel for node in members]))
    return Apart(tuple(stacked), order, size)
