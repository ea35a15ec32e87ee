"""A filter of a network by name: a node's, one of the centre, or one of a node between neighbours."""

from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.fusion.network_fusion import Fusion
from heliograph.numerics.check import fail, instance, text
from heliograph.numerics.module import readable
from heliograph.numerics.types import Array, Float
from heliograph.simulation.centres.uplinks import build_uplinks
from heliograph.simulation.mesh.node_filter import node_filter
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.network_filters import centre_filter
from heliograph.simulation.node import Node


@readable
@dataclass(frozen=True)
class NamedFilter:
    """A filter of a network as it runs alone, the place where it stands, and the names of the numbers it receives.

    Args:
        place: name of its node, "fused" of the centre.
        filter: the filter, as it runs alone.
        received: names of the components of its measurement.
        refusing: nodes that refuse some of what it receives, by limits or codes, and where their readings stand in it.
    """

    place: str
    filter: AbstractFilter
    received: tuple[str, ...]
    refusing: tuple[tuple[slice, Node], ...] = ()

    def leave_out_refused(self, z: Float[Array, " received"]) -> Float[jax.Array, " received"]:
        """Return a measurement with NaN in place of the numbers that nodes refuse; `z`: what arrived.

        Readings that are stuck stay, as one measurement does not show them.
        """
        left = jnp.asarray(z)
        for rows, node in self.refusing:
            assert node.limits is not None
            is_refused = node.limits.outside(left[rows])
            kept: Array = jnp.where(is_refused, jnp.nan, left[rows])
            if node.trigger is not None:  # a refused value was sent all the same
                kept = node.trigger.leave_out_refused(left[rows], is_refused, len(node.outputs))
            left = left.at[rows].set(jnp.asarray(kept))
        return left

    @property
    def refused_values(self) -> tuple[str, ...]:
        """In words which values of each number count as not arrived, such as "-999, below 0"; "" where all count."""
        words = [""] * len(self.received)
        for rows, node in self.refusing:
            limits = node.limits
            assert limits is not None
            for i, low, high in zip(range(len(words))[rows], limits.low, limits.high, strict=True):
                ends = [f"below {low:g}"] * bool(low > -np.inf) + [f"above {high:g}"] * bool(high < np.inf)
                words[i] = ", ".join([*(f"{code:g}" for code in limits.invalid), *ends])
        return tuple(words)

    @property
    def looks_for_stuck(self) -> bool:
        """Whether some node refuses readings that repeat for too long, which needs those before."""
        return any(node.limits is not None and node.limits.stuck is not None for _rows, node in self.refusing)


def find_filter_by_name(network: Network, name: str, node: str | None = None) -> NamedFilter:
    """Find a filter of a network by name, as it runs alone: of a node, of the centre, or of a node between neighbours.

    A central filter receives all measurements. The centre of a fusion by `AllReports` receives reports, as
    `centre_filter` says. A node between neighbours receives its own measurement, and then of each neighbour mean,
    covariance and measurement. Other fusions weigh finished estimates: no filter computes them.

    Args:
        network: the network.
        name: name of a filter or fusion.
        node: the node that has it, "fused" for the centre, which receives from all nodes; by default None, which is
            enough unless several have a filter of that name.

    Raises:
        ValueError: no network, no such name or place, a fusion of finished estimates.
    """
    # Places that have a filter of this name, read from the claims {place: {filter: claim}} of all estimates.
    claims = instance("network", network, Network, "a Network").claims()
    text("filter", name)
    places = [place for place, claims_at_place in claims.items() if name in claims_at_place]
    if not places:
        known = sorted({label for claims_at_place in claims.values() for label in claims_at_place})
        raise fail("filter", f"one of the network's filters {known}", repr(name))
    if node is None and len(places) > 1:
        raise fail("node", f"one of {places}, which all have a filter {name!r}", "none")
    if node is not None and node not in places:
        raise fail("node", f"one that has a filter {name!r} {places}", repr(node))
    # One of the three sorts: at the centre, of a node that exchanges with neighbours (a mesh), or of a node by itself.
    place = places[0] if node is None else node
    if place == FUSED:
        return _find_at_centre(network, name)
    if name in network.meshes:
        return _find_between_neighbours(network, name, place)
    filter = network.nodes[place].filters[name]
    names = network.nodes[place].received_names[: filter.received]
    return NamedFilter(place, filter, names, _list_refusing(network, {place: range(len(names))} if names else {}))


def _list_refusing(network: Network, rows: Mapping[str, range]) -> tuple[tuple[slice, Node], ...]:
    """Return those of some nodes that refuse readings, each with its rows of the measurement; `rows`: by node."""
    nodes = {name: network.nodes[name] for name in rows}
    return tuple(
        (slice(rows[name].start, rows[name].stop), node)
        for name, node in nodes.items()
        if isinstance(node, Node) and node.limits is not None
    )


def _find_at_centre(network: Network, name: str) -> NamedFilter:
    """Return the filter of this name at the centre: a central filter, or the filter of a fusion by reports.

    Raises:
        ValueError: a fusion that weighs finished estimates, which has no filter of what arrives.
    """
    fused = network.fused[name]
    if isinstance(fused, AbstractFilter):
        names = [f"{node}_{number}" for node in network.names for number in network.nodes[node].received_names]
        # A central filter receives the numbers of all nodes, or no numbers (fused.received is 0).
        refusing = _list_refusing(network, network.rows if fused.received else {})
        return NamedFilter(FUSED, fused, tuple(names[: fused.received]), refusing)
    if not fused.rule.uses_reports:
        rule = type(fused.rule).__name__
        expected = "a central filter or a fusion by AllReports(), whose centre is a filter of what arrives"
        advice = f"take {fused.filter!r} of the nodes, or fuse by AllReports()"
        raise fail(f"filter {name!r}", expected, f"one by {rule}, which weighs finished estimates: {advice}")
    return NamedFilter(FUSED, centre_filter(network, name), tuple(_name_reports(network, fused)))


def _name_reports(network: Network, fusion: Fusion) -> list[str]:
    """Return the names of the reports' numbers, as NODE_STATE, in the order in which the centre's filter receives them.

    A number of a report that comes AGE steps late has the suffix _AGE_late.
    """
    nodes = network.nodes_with(fusion.filter)
    uplinks = build_uplinks(fusion, nodes, len(network.states))
    names = []
    ages = uplinks.delay.shape[1]
    for age in range(ages):
        suffix = f"_{age}_late" if age else ""  # age: steps between sending and arrival
        for node, link, size in zip(nodes, fusion.links(nodes), uplinks.received, strict=True):
            numbers = network.states if link.channel is None else [f"report{i}" for i in range(size)]
            names += [f"{node}_{number}{suffix}" for number in numbers]
    return names


def _find_between_neighbours(network: Network, name: str, node: str) -> NamedFilter:
    """Return the filter of one node of the fusion `name` between neighbours, which receives their messages.

    A message has the neighbour's mean, its covariance (row after row) and its measurement. The numbers are named
    NEIGHBOUR_mean_STATE, NEIGHBOUR_covariance_STATE_STATE and NEIGHBOUR_NUMBER.
    """
    states = network.states
    means = [f"mean_{state}" for state in states]
    covariances = [f"covariance_{state}_{other}" for state in states for other in states]
    # The node's own measurement, then the message of each neighbour.
    names = list(network.nodes[node].received_names)
    rows = {node: range(len(names))}  # where measurements stand
    neighbours = network.meshes[name].neighbours or {}
    for sender in neighbours[node]:
        measurement = network.nodes[sender].received_names
        names += [f"{sender}_{number}" for number in (*means, *covariances, *measurement)]
        rows[sender] = range(len(names) - len(measurement), len(names))
    return NamedFilter(node, node_filter(network, name, node), tuple(names), _list_refusing(network, rows))
