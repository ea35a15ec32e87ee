"""Fusion of the nodes' estimates inside a step: rules in parallel, reports, and the centres' knowledge of the nodes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import make_sizes
from heliograph.fusion.all_reports_fusion import AllReports
from heliograph.fusion.joint_covariance_fusion import AbstractInformedFusion
from heliograph.fusion.network_fusion import Fusion
from heliograph.fusion.quantizer import widen_by_quantization
from heliograph.fusion.rules import AbstractFusion
from heliograph.model.estimate import Claim, Estimate
from heliograph.model.over_time import at, first, stack, structure_key
from heliograph.numerics.angles.angle import Angles, wrap_angles, wrap_near
from heliograph.numerics.module import Module
from heliograph.numerics.types import Array, PyTree
from heliograph.simulation.centres.centre_filter import CentreFilter, NodeFiltersWithoutData
from heliograph.simulation.centres.fusion_centre import (
    FusionCentre,
    find_claim_of_report_fusion,
    has_data_dependent_gains,
)
from heliograph.simulation.centres.linearised_centre import LinearisedCentre
from heliograph.simulation.centres.observation_model import (
    SeparateObservations,
    SharedObservation,
    compute_channel_moments,
    stack_nodes,
)
from heliograph.simulation.centres.uplinks import ReportsInTransit, UplinkDraws, Uplinks, build_uplinks
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.network_index import EstimateIndex
from heliograph.simulation.node import Node, ReceivingNode
from heliograph.simulation.runs.stacked_filters import initial_state, map_all


class StackedFusions(Module):
    """Fusions that differ in numbers alone, stacked along a first axis of fusions.

    Args:
        rules: by which each fuses.
        quantizers: through which it receives each node's estimate (fusion, node); None where there are none.
        order: brings what is gathered from the sources into the order of the fusion's nodes (fusion, node).
        names: of the fusions.
        sources: by fusion, (stack, number within the stack) of the filters whose estimates it fuses, one group of nodes
            after another.
        claims: of what each fuses.
        angles: which states are angles, and their periods.
    """

    rules: AbstractFusion
    quantizers: PyTree
    order: np.ndarray
    names: tuple[str, ...] = eqx.field(static=True)
    sources: tuple[tuple[tuple[int, int], ...], ...] = eqx.field(static=True)
    claims: tuple[Claim, ...] = eqx.field(static=True)
    angles: Angles = eqx.field(static=True)

    def init(self, n: int) -> PyTree:
        """Return the states before the first step of the quantizers, by which nodes send their estimates in few bits.

        Without quantizers the result is (). Otherwise each leaf has leading axes (fusion, node).
        `n`: number of the plant's states.
        """
        if self.quantizers is None:
            return ()
        fusions, nodes = self.order.shape
        init_of_nodes = map_all(lambda quantizer: at(quantizer, k=0).init(n), nodes)
        return map_all(init_of_nodes, fusions)(self.quantizers)

    def step(
        self, states: PyTree, estimates: Sequence[Estimate], k: jax.Array
    ) -> tuple[PyTree, dict[str, Estimate], dict[str, PyTree]]:
        """Fuse the filters' estimates of step k.

        Args:
            states: states of the quantizers before the step, (fusion, node, ...). A quantizer rounds the mean that a
                node sends to the fusion centre.
            estimates: estimates of the filters by stack, (filter, node, ...).
            k: number of the step.

        Returns:
            The quantizers' states after the step, the fused estimates by name of the fusion, and by that name which
            components were beyond a quantizer's range ("saturated") and how many "symbols" it sent, (node, n).
        """
        # Means and covariances in the order of each fusion's nodes.
        means = self._gather_by_fusion([e.mean for e in estimates])
        covariances = self._gather_by_fusion([e.covariance for e in estimates])
        uplinks: dict[str, PyTree] = {}
        # Quantized means, and covariances enlarged by the bounds of the quantizers' errors.
        if self.quantizers is not None:
            fusions, nodes = self.order.shape
            send_one_mean = map_all(lambda quantizer, state, mean: at(quantizer, k).step(state, mean), nodes)
            send = map_all(send_one_mean, fusions)
            states, sent = send(self.quantizers, states, means)
            means, covariances = sent.value, jax.vmap(jax.vmap(widen_by_quantization))(covariances, sent.error)
            for i, name in enumerate(self.names):
                uplinks[name] = {"saturated": sent.saturated[i], "symbols": sent.symbols[i]}
        # Angles are taken near those of the first node, so that they can be averaged; then the rules in parallel.
        means = wrap_near(means, means[:, :1], self.angles)
        combine = map_all(lambda rule, *parts: rule.combine(*parts), len(self.names))
        mean, covariance = combine(self.rules, means, covariances)
        mean = wrap_angles(mean, self.angles)
        fused = {
            name: Estimate(mean[i], covariance[i], claim)
            for i, (name, claim) in enumerate(zip(self.names, self.claims, strict=True))
        }
        return states, fused, uplinks

    def _gather_by_fusion(self, values_by_stack: Sequence[jax.Array | np.ndarray]) -> jax.Array:
        """Return values of the filters as (fusion, node, ...), in the order of each fusion's nodes.

        `values_by_stack`: (filter, node, ...) for each stack of filters of one structure. `self.sources`: for each
        fusion, the pairs (stack, number of the filter in it) that it fuses. `self.order`: for each fusion, the order of
        their joined rows.
        """
        values_by_fusion = [
            jnp.concatenate([values_by_stack[stack][filter] for stack, filter in sources]) for sources in self.sources
        ]
        are_in_order = all(np.array_equal(order, np.arange(len(order))) for order in self.order)
        if are_in_order:  # so that no gather is compiled
            return jnp.stack(values_by_fusion)
        return jnp.stack([values[order] for values, order in zip(values_by_fusion, self.order, strict=True)])


class ReportFusion(Module):
    """A fusion by reports: nodes send their means over uplinks, and a filter at the centre receives them.

    Args:
        uplinks: from the nodes to the centre.
        centre: filter of what arrives.
        order: brings what is gathered from the sources into the order of the nodes.
        sources: (stack, number within the stack) of the filters whose means are sent, one group of nodes after another.
        nodes: their names.
    """

    uplinks: Uplinks
    centre: CentreFilter
    order: np.ndarray
    sources: tuple[tuple[int, int], ...] = eqx.field(static=True)
    nodes: tuple[str, ...] = eqx.field(static=True)

    def init(self) -> tuple[ReportsInTransit, PyTree]:
        """Return the state before any report is sent."""
        return self.uplinks.init(), initial_state(self.centre)

    def step(
        self,
        state: tuple[ReportsInTransit, PyTree],
        estimates: Sequence[Estimate],
        drawn: UplinkDraws,
        u: jax.Array,
        k: jax.Array,
    ) -> tuple[tuple[ReportsInTransit, PyTree], Estimate, dict[str, jax.Array], tuple[jax.Array, Array]]:
        """Send the nodes' means as reports, and correct the centre's filter with those that arrive at step k.

        Args:
            state: reports in transit and state of the centre's filter, before the step.
            estimates: estimates of the nodes' filters, for each stack of filters of one structure (filter, node, ...).
            drawn: gains, offsets and delays of the uplinks at this step: a report m arrives as gain m + offset.
            u: inputs of the plant over the step.
            k: number of the step.

        Returns:
            The state after the step; the centre's estimate; which components saturated a quantizer, and the symbols
            sent (empty without quantizers); the reports sent (node, m) as they arrive, and their delays (node,).
        """
        in_transit, filter_state = state
        # The nodes' means: from their stacks, then in the order of the nodes.
        means = jnp.concatenate([estimates[stack].mean[filter] for stack, filter in self.sources])[self.order]
        # Each node's report as it will arrive, and the reports (age, node, m) that arrive now, by age in steps.
        in_transit, sent, quantizer_outcome = self.uplinks.send(in_transit, means, drawn, k)
        in_transit, reports = self.uplinks.arrive(in_transit, sent, drawn.delay)
        # The measurement of the centre's filter is without what only pads shorter reports.
        received = jnp.ravel(reports)[np.array(self.centre.rows)]
        filter_state, estimate = self.centre.step(filter_state, received, u, k)
        return (in_transit, filter_state), estimate, quantizer_outcome, (sent, drawn.delay)


def build_report_fusions(
    network: Network, step_filters: Callable[[Network], NodeFiltersWithoutData]
) -> dict[str, ReportFusion]:
    """Return the network's fusions by reports, by name, each with its uplinks and its centre.

    `step_filters`: makes all filters of a network, which a centre steps without data for the moments of their errors.
    """
    results = {}
    for name, fusion in network.fused.items():
        if isinstance(fusion, Fusion) and fusion.by_report:
            nodes = network.nodes_with(fusion.filter)
            sources, order = find_source_filters(network, network.estimate_indices, nodes, fusion.filter)
            results[name] = ReportFusion(
                uplinks=build_uplinks(fusion, nodes, len(network.states)),
                centre=build_centre_filter(network, name, fusion, step_filters),
                order=order,
                sources=sources,
                nodes=tuple(nodes),
            )
    return results


def build_centre_filter(
    network: Network, name: str, fusion: Fusion, step_filters: Callable[[Network], NodeFiltersWithoutData]
) -> CentreFilter:
    """Return the filter of the centre that receives reports for `fusion`, which has this name in the network.

    The nodes' estimates are sent as reports. Their errors are correlated, by the common process noise, so the centre
    needs their joint moments: it steps all nodes' filters without data to find them (`step_filters` makes these). A
    claim is what a covariance is said to be: exact, upper bound or nominal.
    """
    # The centre's claim, from those of the nodes' filters and what their uplinks do.
    names = network.nodes_with(fusion.filter)
    complete = {node: network.nodes[node].complete for node in names}
    claim = find_claim_of_report_fusion(type(fusion.rule).__name__, network.claims()[FUSED][name], fusion, complete)
    # A network whose nodes have that filter alone, with a fusion that makes the joint moments of its errors be
    # computed.
    alone = Network(
        network.plant,
        {node: _keep_one_filter(network.nodes[node], fusion.filter) for node in network.names},
        {"all": Fusion(fusion.filter, AllReports())},
        network.relays,
        network.common,
    )
    # Reports are received in rows (age, node, component); `rows` are those that can arrive. A report's age is the
    # number of steps by which it is late.
    uplinks = build_uplinks(fusion, names, len(network.states))
    return CentreFilter(
        filters=step_filters(alone),
        links=uplinks.links,
        rows=tuple(uplinks.rows.tolist()),
        ages=uplinks.delay.shape[1],
        widest=max(uplinks.received),
        quantized=uplinks.quantizers is not None,
        **make_sizes(claim, network, len(uplinks.rows)),
    )


def _keep_one_filter(node: Node | ReceivingNode, name: str) -> Node | ReceivingNode:
    """Return a copy of the node that keeps only the filter `name`, or no filter if the node has none of this name."""
    filters = {label: filter for label, filter in node.filters.items() if label == name}
    if isinstance(node, Node):
        return Node(node.sensor, node.channel, filters)
    return replace(node, filters=filters)


def list_stacked_fusions(network: Network) -> tuple[StackedFusions, ...]:
    """Return the network's fusions by rules that need nothing but the estimates, those of one structure stacked.

    Fusions that differ in numbers alone are stacked along a leading axis, so that one vectorised program computes all.
    Rules that need the joint covariance of the nodes' errors (`AbstractInformedFusion`) are left out.
    """
    names_by_structure: dict[object, list[str]] = {}
    for name, fusion in network.fused.items():
        if isinstance(fusion, Fusion) and not isinstance(fusion.rule, AbstractInformedFusion):
            nodes = network.nodes_with(fusion.filter)
            # Fusions stack if their rules and quantizers have one structure, and they fuse equally many nodes: a tuple
            # of None, one for each node, makes their number part of the structure.
            node_count = (None,) * len(nodes)
            key = structure_key((fusion.rule, fusion.uplinks(nodes), node_count))
            names_by_structure.setdefault(key, []).append(name)
    indices_by_filter, claims = network.estimate_indices, network.claims().get(FUSED, {})
    return tuple(
        _stack_fusions(network, names, indices_by_filter, [claims[name] for name in names])
        for names in names_by_structure.values()
    )


def _stack_fusions(
    network: Network,
    names: Sequence[str],
    indices_by_filter: Mapping[tuple[str, str], EstimateIndex],
    claims: list[Claim],
) -> StackedFusions:
    """Return the fusions of these names, of one structure, stacked.

    `indices_by_filter`: of all estimates, by (node, filter). `claims`: of each fusion.

    A claim is what a covariance is said to be: exact, an upper bound, or nominal. `fusion.uplinks`: the quantizers
    through which a node's estimate is sent, or None.
    """
    fusions = [fusion for fusion in (network.fused[name] for name in names) if isinstance(fusion, Fusion)]
    sources, orders, quantizers = [], [], []
    for fusion in fusions:
        nodes = network.nodes_with(fusion.filter)
        source, order = find_source_filters(network, indices_by_filter, nodes, fusion.filter)
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


def list_centres(network: Network) -> tuple[FusionCentre | LinearisedCentre, ...]:
    """Return one centre for each filter whose estimates are fused by rules that need their errors' joint covariance.

    The centre propagates that covariance for all of these rules. Fusions of reports have centres of their own.
    """
    rules: dict[str, dict[str, AbstractInformedFusion]] = {}
    for name, fusion in network.fused.items():
        if isinstance(fusion, Fusion) and isinstance(fusion.rule, AbstractInformedFusion) and not fusion.by_report:
            rules.setdefault(fusion.filter, {})[name] = fusion.rule
    return tuple(_build_centre(network, name, rules_of_filter) for name, rules_of_filter in rules.items())


def _build_centre(
    network: Network, name: str, rules: dict[str, AbstractInformedFusion]
) -> FusionCentre | LinearisedCentre:
    """Return the centre that fuses the estimates of the filter `name` of all nodes that have it.

    The centre propagates the joint covariance of the nodes' errors, which its rules need, from models of all nodes.
    `rules`: the fusion rules by name of the fusion.
    """
    indices_by_filter, claims = network.estimate_indices, network.claims()[FUSED]
    nodes = network.nodes_with(name)
    # sources: (stack, number in the stack) of the filters; order: brings their nodes into the order of `nodes`.
    sources, order = find_source_filters(network, indices_by_filter, nodes, name)
    groups = [network.groups[network.stacks[stack].group] for stack, _ in sources]
    longest_measurement = max(network.nodes[node].received for node in nodes)
    claim = claims[next(iter(rules))]  # the same of all rules on one filter
    # Where gains depend on data, errors are propagated along the estimates of each run.
    if has_data_dependent_gains(network.parts_of(name)):
        return LinearisedCentre(
            plant=network.plant,
            rules=rules,
            order=order,
            sources=sources,
            size=longest_measurement,
            claim=claim,
        )
    return FusionCentre(
        plant=network.plant,
        observation_model=_model_measurements(network, nodes, groups, order, longest_measurement),
        rules=rules,
        order=order,
        sources=sources,
        size=longest_measurement,
        claim=claim,
    )


def find_source_filters(
    network: Network, indices_by_filter: Mapping[tuple[str, str], EstimateIndex], nodes: Sequence[str], name: str
) -> tuple[tuple[tuple[int, int], ...], np.ndarray]:
    """Return the sources of a fusion, each as (stack, number of the filter in the stack), and an order of their rows.

    A stack has filters of one structure, at all nodes of a group. Join the estimates (node, n) of the sources,
    one source after another, and index them by the order: row i is then the estimate of nodes[i].

    Args:
        network: the network.
        indices_by_filter: of all estimates, by (node, filter).
        nodes: names of the nodes, each of which has the filter.
        name: of the filter.
    """
    indices = [indices_by_filter[node, name] for node in nodes]
    sources = tuple(dict.fromkeys((index.stack, index.filter) for index in indices))  # each once, in order
    # The row of each node, if the sources' rows stand one source after another.
    nodes_in_rows = [node for stack, _ in sources for node in network.groups[network.stacks[stack].group]]
    row_of_node = {node: row for row, node in enumerate(nodes_in_rows)}
    return sources, np.array([row_of_node[node] for node in nodes])


def _model_measurements(
    network: Network, nodes: Sequence[str], groups: Sequence[Sequence[str]], order: np.ndarray, size: int
) -> SeparateObservations | SharedObservation:
    """Return the measurement models of these nodes for a centre.

    Args:
        network: the network.
        nodes: their names.
        groups: names of the nodes whose sensors have one structure, and so can be stacked; one list for each stack.
        order: indices that bring the nodes, one group after another, into the order of `nodes`.
        size: length of the longest measurement, to which others are padded.
    """
    if network.common is not None:
        # All receive parts of one channel's output: the rows of each node, padded with -1.
        rows = network.rows
        padded = [np.pad(rows[name], (0, size - len(rows[name])), constant_values=-1) for name in nodes]
        return SharedObservation(
            network.common.sensor, compute_channel_moments(network.common.channel), np.array(padded)
        )
    models = []
    for names in groups:
        members = [node for node in map(network.nodes.__getitem__, names) if isinstance(node, Node)]
        models.append(stack_nodes([node.sensor for node in members], [node.channel for node in members]))
    return SeparateObservations(tuple(models), order, size)
