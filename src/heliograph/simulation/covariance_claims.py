"""Claims (exact, upper, nominal) of a network's covariances: a filter's own where its model is the world, else nominal.

An assumed model is the world that a filter was made for, or in which it stands: plant, sensor, channel and so on.
"""

from collections.abc import Iterator, Mapping
from copy import copy
from typing import NamedTuple

import jax

from heliograph.filters.base import AbstractFilter
from heliograph.filters.linear.scheduled_gains import ScheduledFilter
from heliograph.fusion.joint_covariance_fusion import AbstractInformedFusion
from heliograph.fusion.network_fusion import Fusion
from heliograph.model.assumed.agreement import RANGE, join_assumed, list_differences, restrict_assumed_to_rows
from heliograph.model.assumed.assumed_model import AssumedModel, StaticAssumedModel
from heliograph.model.estimate import Claim
from heliograph.numerics.check import fail
from heliograph.simulation.centres.fusion_centre import (
    find_claim_of_informed_fusion,
    find_claim_of_report_fusion,
    has_data_dependent_gains,
)
from heliograph.simulation.mesh.check import find_claim_of_mesh
from heliograph.simulation.node import FUSED, HasNodes, Node, ReceivingNode

UNSAID = "something that it does not say"


class MistakenBelief(NamedTuple):
    """A filter of a network, and the parts of its model that differ from the world at its node.

    Args:
        node: name of the node; `FUSED` for a filter of all measurements.
        filter: its name.
        parts: the parts of the model in which it believes another world, such as "sensor".
        lowered: whether it would claim more than "nominal" in the world that it believes.
    """

    node: str
    filter: str
    parts: tuple[str, ...]
    lowered: bool

    @property
    def another(self) -> str:
        """Which models the filter has that differ from those at its node, such as "another sensor and channel".

        A filter that does not tell for which models it was made has the one part UNSAID, which is text of its own.
        """
        return UNSAID if self.parts == (UNSAID,) else f"another {' and '.join(self.parts)}"

    @property
    def words(self) -> str:
        """Return the mistake as a sentence such as "filter 'f' believes another channel than node 'a'".

        `self.node` is FUSED for a filter of all nodes' measurements. RANGE in `self.parts` says that some readings are
        refused, UNSAID that the filter does not tell for which models it was made.
        """
        place = "all nodes together" if self.node == FUSED else f"node {self.node!r}"
        reason = ", where some are refused" if RANGE in self.parts else ""
        preposition = "at" if self.parts == (UNSAID,) else "than"
        return f"filter {self.filter!r} believes {self.another} {preposition} {place}{reason}"


def lower_claim(claim: Claim) -> Claim:
    """Return "nominal" for any claim of a covariance, "none" for none."""
    return "none" if claim == "none" else "nominal"


def lower_to_nominal(filter: AbstractFilter) -> AbstractFilter:
    """Return a copy of the filter that claims "nominal" at most for its covariance, as do the filters inside it.

    "nominal" means that the covariance is right only if the filter's models are. In its field `kept` the copy remembers
    the models for which it was made (its assumed model), and whether its claim was lowered.
    """

    def is_inner(leaf: object) -> bool:
        """Return whether this is a filter inside the filter."""
        return leaf is not filter and isinstance(leaf, AbstractFilter)

    leaves, tree = jax.tree.flatten(filter, is_leaf=is_inner)
    inner = [lower_to_nominal(leaf) if is_inner(leaf) else leaf for leaf in leaves]
    lowered: AbstractFilter = copy(jax.tree.unflatten(tree, inner))
    was_lowered = filter.claim != lower_claim(filter.claim) or filter.kept.lowered
    # Fields are frozen. The copy is no one else's yet, so that they may be set here.
    object.__setattr__(lowered, "claim", lower_claim(filter.claim))
    object.__setattr__(lowered, "kept", StaticAssumedModel(filter.assumed, was_lowered))
    return lowered


def lower_claim_if_mistaken(own_models: AssumedModel, filter: AbstractFilter) -> AbstractFilter:
    """Return the filter itself if it was made for `own_models`, else a copy that claims "nominal" at most.

    Args:
        own_models: the models at the place where it stands: plant, sensor, channel and trigger.
        filter: the filter, which itself keeps its claim.
    """
    # A claim of "nominal" or less need not be lowered, whatever the filter was made for.
    is_weak = lower_claim(filter.claim) == filter.claim
    return filter if is_weak or not list_mistaken_parts(own_models, filter) else lower_to_nominal(filter)


def lower_claims_of_nodes(network: HasNodes) -> dict[str, Node | ReceivingNode]:
    """Return the nodes with claims that hold there: a filter made for other models than its node's claims "nominal".

    A filter's claim is what its covariance is said to be: exact, an upper bound, or nominal (right if its models are).
    """
    nodes = dict(network.nodes)
    for name, node in network.nodes.items():
        if node.filters:
            own_models = find_assumed(network, name)
            filters = {label: lower_claim_if_mistaken(own_models, filter) for label, filter in node.filters.items()}
            nodes[name] = _replace_filters(node, filters)
    return nodes


def pad_filters_alike(nodes: Mapping[str, Node | ReceivingNode]) -> dict[str, Node | ReceivingNode]:
    """Return the nodes with filters whose arrays are padded to the largest of all filters, so that they can be stacked.

    Only filters that know a sender's heartbeat, the most steps between two messages, differ in the length of their
    arrays: all are padded to the longest heartbeat.
    """
    all_filters = [filter for node in nodes.values() for filter in node.filters.values()]
    padded: dict[str, Node | ReceivingNode] = {}
    for name, node in nodes.items():
        filters = {label: filter.with_room_for_heartbeats_of(all_filters) for label, filter in node.filters.items()}
        padded[name] = _replace_filters(node, filters)
    return padded


def lower_claims_of_central_filters(network: HasNodes) -> dict[str, Fusion | AbstractFilter]:
    """Return the network's fusions and central filters; of the latter those with wrong models claim "nominal" at most.

    A central filter receives the measurements of all nodes. Its models are wrong if they are not the plant, and the
    sensors and channels of all nodes together; its covariance is then neither exact nor a bound.
    """
    if not any(isinstance(fusion, AbstractFilter) for fusion in network.fused.values()):
        return network.fused
    own_models = find_common_assumed(network)
    fused = dict(network.fused)
    for name, fusion in network.fused.items():
        if isinstance(fusion, AbstractFilter):
            fused[name] = lower_claim_if_mistaken(own_models, fusion)
    return fused


def make_nodes_nominal(network: HasNodes) -> dict[str, Node | ReceivingNode]:
    """Return the nodes with filters whose covariances claim "nominal" at most: neither to be exact nor a bound."""
    return {
        name: _replace_filters(node, {label: lower_to_nominal(filter) for label, filter in node.filters.items()})
        for name, node in network.nodes.items()
    }


def make_fusions_nominal(network: HasNodes) -> dict[str, Fusion | AbstractFilter]:
    """Return the fusions by name; those that are filters of all measurements claim "nominal" at most.

    Fusions of the nodes' estimates are unchanged: what they claim follows from the nodes' claims.
    """
    fused = dict(network.fused)
    for name, fusion in network.fused.items():
        if isinstance(fusion, AbstractFilter):
            fused[name] = lower_to_nominal(fusion)
    return fused


def _replace_filters(node: Node | ReceivingNode, filters: dict[str, AbstractFilter]) -> Node | ReceivingNode:
    """Return the node with other filters of the same names, or the node itself if all are its own.

    The copy is made without the constructor, which would check and compute everything again.
    """
    if all(filters[name] is node.filters[name] for name in filters):
        return node
    changed = copy(node)
    object.__setattr__(changed, "filters", filters)  # fields are frozen
    return changed


def list_mistaken_parts(own: AssumedModel, filter: AbstractFilter) -> tuple[str, ...]:
    """Return in which parts of the model (such as "sensor") a filter differs from the models at its node, `own`."""
    return (UNSAID,) if filter.assumed is None else list_differences(filter.assumed, own)


def find_assumed(network: HasNodes, name: str) -> AssumedModel:
    """Return the models at a node, for which a filter there has to be made if its claim is to hold.

    A claim (that a filter's covariance is exact or a bound) is about one world: the plant, and the
    node's sensor, channel and trigger (rule of when to send), with its limits if they refuse values. In a network of
    relays it is the plant, the relays, and the relays' gains.
    """
    node, plant = network.nodes[name], network.plant
    if isinstance(node, Node):
        # Limits without bounds refuse only error codes of the sensor, which depend on the state in no way: to lose a
        # value by them does no harm, unless filters take it for silence, or for a sign of the link's mode.
        limits = node.limits
        if limits is not None and not limits.bounded and not node.absence_tells:
            limits = None
        return AssumedModel(plant, node.sensor, node.channel, node.trigger, range=limits, encoder=node.encoder)
    # Nodes that share one channel receive certain rows of it.
    if network.common is not None:
        return restrict_assumed_to_rows(
            AssumedModel(plant, network.common.sensor, network.common.channel), network.rows[name]
        )
    if network.relays is None:  # a node without a sensor
        return AssumedModel(plant)
    # Gains of the relays, each of which runs a single filter by a schedule.
    schedules = {
        relay: filter
        for relay in network.relays.relays
        if relay in network.nodes
        for filter in network.nodes[relay].filters.values()
    }
    gains = {relay: f.gains.values.gain for relay, f in schedules.items() if isinstance(f, ScheduledFilter)}
    return AssumedModel(plant, relays=network.relays, gains=gains)


def find_common_assumed(network: HasNodes) -> AssumedModel:
    """Return the models of a central filter: the plant, and the sensors and channels of all nodes in their order.

    `network.common`: the sensor and channel that all nodes share, or None.
    """
    if network.common is not None:
        return AssumedModel(network.plant, network.common.sensor, network.common.channel)
    models = [find_assumed(network, name) for name in network.names if isinstance(network.nodes[name], Node)]
    if not models:  # no node has a sensor
        return AssumedModel(network.plant)
    return join_assumed(models)


def yield_mistaken_beliefs(network: HasNodes) -> Iterator[MistakenBelief]:
    """Yield the filters made for other models than those of the place where they stand; central ones come last.

    A central filter receives the measurements of all nodes: its models have to be those of all nodes together.
    """
    for name in network.names:
        if filters := network.nodes[name].filters:
            yield from _yield_mistaken_beliefs(name, find_assumed(network, name), filters)
    central = {name: fusion for name, fusion in network.fused.items() if isinstance(fusion, AbstractFilter)}
    if central:
        yield from _yield_mistaken_beliefs(FUSED, find_common_assumed(network), central)


def _yield_mistaken_beliefs(
    node: str, own_models: AssumedModel, filters: Mapping[str, AbstractFilter]
) -> Iterator[MistakenBelief]:
    """Yield the filters of a node that claim a covariance but were made for other models than `own_models`, the node's.

    Each comes with the parts of the models that differ. A filter may not say for which models it was made: it is left
    out then. But if its claim was lowered already (`filter.kept.lowered`), it is yielded: somebody knew that
    its models are not the node's.
    """
    for label, filter in filters.items():
        was_lowered = filter.kept.lowered
        can_be_judged = filter.assumed is not None or was_lowered
        if filter.claim != "none" and can_be_judged and (mistaken_parts := list_mistaken_parts(own_models, filter)):
            yield MistakenBelief(node=node, filter=label, parts=mistaken_parts, lowered=was_lowered)


def find_claims(network: HasNodes) -> dict[tuple[str, str], Claim]:
    """Return what each estimate of a network claims of its covariance: "exact", "upper" (a bound), "nominal" or "none".

    Keys are (node, name of the filter or fusion); those of the fusion centre come last, under FUSED in place of a node.
    """
    # Filters of the nodes state their claims. A mesh is a fusion between neighbours, with one claim for all its nodes.
    claims = {
        (name, filter_name): filter.claim
        for name, node in network.nodes.items()
        for filter_name, filter in node.filters.items()
    }
    for name, mesh in network.meshes.items():
        claim_of_mesh = find_claim_of_mesh(name, mesh, network)
        claims |= {(node, name): claim_of_mesh for node in network.mesh_nodes(name)}
    # If a node sends or uses a message only for some of its values, the errors depend on the data in a way that no
    # fusion follows: it can claim "nominal" at most, neither an exact covariance nor a bound. Where codewords are sent
    # this holds for fusions that follow the nodes' errors by their sensors and channels; one of estimates alone claims
    # what their filters do.
    nodes = [node for node in network.nodes.values() if isinstance(node, Node)]
    do_data_decide = any(node.chosen_by_value for node in nodes)
    is_disturbed = any(node.disturbs_what_is_sent for node in nodes)
    for name, fusion in network.fused.items():
        claim = _find_claim_of_fusion(network, fusion)
        if isinstance(fusion, Fusion):
            is_informed = isinstance(fusion.rule, AbstractInformedFusion)
            claim = lower_claim(claim) if do_data_decide or (is_disturbed and is_informed) else claim
        claims[FUSED, name] = claim
    return claims


def _find_claim_of_fusion(network: HasNodes, fusion: Fusion | AbstractFilter) -> Claim:
    """Return what a fusion can claim of its covariance, from its rule, its nodes' claims and how they report.

    A claim is what the covariance is said to be: exact, an upper bound, or nominal. An informed rule is one that needs
    the joint covariance of the nodes' errors. A report is the estimate that a node sends to the centre; with
    `by_report` the centre models the report's way, its uplink or its quantizer.

    Args:
        network: the network, whose nodes have filters and claims.
        fusion: the fusion, or a filter of the centre on all measurements, which has its own claim.

    Raises:
        ValueError: a rule that needs the joint covariance of the nodes' errors, which cannot be computed here.
    """
    if isinstance(fusion, AbstractFilter):
        return fusion.claim
    names = network.nodes_with(fusion.filter)
    # A rule that needs nothing but the estimates.
    if not isinstance(fusion.rule, AbstractInformedFusion):
        return fusion.claim([network.nodes[n].filters[fusion.filter].claim for n in names])
    # A rule that needs the joint moments of the errors, and so a model of all links from the sensors to the centre.
    rule = type(fusion.rule).__name__
    if fusion.quantizer is not None and not fusion.by_report:
        raise fail(f"fusion by {rule}", "uplinks that deliver what is sent", "a quantizer")
    parts = network.parts_of(fusion.filter)  # of each node that has a sensor: sensor, channel, filter
    if len(parts) < len(names):
        raise fail(f"fusion by {rule}", "nodes that receive sensors through channels", "relays")
    # Where gains depend on data, the errors' moments can be propagated along the data's estimates, but the plant's own
    # second moment E[x x'], which is needed before any data, cannot.
    needs_plant_moments = fusion.by_report or fusion.rule.needs_plant_moments
    if needs_plant_moments and has_data_dependent_gains(parts):
        _, _, first_filter = next(iter(parts.values()))
        raise fail(f"fusion by {rule}", "filters whose gains depend on no data, for the plant's own moments",
                   type(first_filter).__name__)  # fmt: skip
    claim = find_claim_of_informed_fusion(rule, network.plant, parts, shared=network.common is not None)
    if not fusion.by_report:
        return claim
    return find_claim_of_report_fusion(rule, claim, fusion, {n: network.nodes[n].complete for n in names})
