"""A filter of a network by name: a node's, one of the centre, or one of a node between neighbours."""

from dataclasses import dataclass

from heliograph.filters.base import AbstractFilter
from heliograph.fusion.network_fusion import Fusion
from heliograph.numerics.check import fail, instance, text
from heliograph.numerics.module import readable
from heliograph.simulation.centres.uplinks import build_uplinks
from heliograph.simulation.mesh.node_filter import node_filter
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.network_filters import centre_filter


@readable
@dataclass(frozen=True)
class NamedFilter:
    """A filter of a network as it runs alone, the place where it stands, and the names of the numbers it receives.

    Args:
        place: name of its node, "fused" of the centre.
        filter: the filter, as it runs alone.
        received: names of the components of its measurement.
    """

    place: str
    filter: AbstractFilter
    received: tuple[str, ...]


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
    return NamedFilter(place, filter, network.nodes[place].received_names[: filter.received])


def _find_at_centre(network: Network, name: str) -> NamedFilter:
    """Return the filter of this name at the centre: a central filter, or the filter of a fusion by reports.

    Raises:
        ValueError: a fusion that weighs finished estimates, which has no filter of what arrives.
    """
    fused = network.fused[name]
    if isinstance(fused, AbstractFilter):
        names = [f"{node}_{number}" for node in network.names for number in network.nodes[node].received_names]
        # A central filter receives the numbers of all nodes, or no numbers (fused.received is 0).
        return NamedFilter(FUSED, fused, tuple(names[: fused.received]))
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
    neighbours = network.meshes[name].neighbours or {}
    for sender in neighbours[node]:
        measurement = network.nodes[sender].received_names
        names += [f"{sender}_{number}" for number in (*means, *covariances, *measurement)]
    return NamedFilter(node, node_filter(network, name, node), tuple(names))
