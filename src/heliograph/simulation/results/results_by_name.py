"""Results by names of nodes and filters, from arrays whose axes are groups of nodes and stacks of filters."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from heliograph.filters.innovation import Weighed
from heliograph.fusion.network_fusion import Fusion
from heliograph.numerics.types import Float, PyTree
from heliograph.simulation.centres.uplinks import SentReports, Uplink
from heliograph.simulation.network import FUSED, Network


def reports_by_name(
    network: Network, outcome: dict[str, tuple[np.ndarray, np.ndarray]]
) -> dict[str, dict[str, SentReports]]:
    """Return the reports by fusion and node, without a node's padding.

    `outcome`: by fusion, what was sent (..., node, m) and its delays (..., node); between neighbours what arrived.
    """
    reports: dict[str, dict[str, SentReports]] = {}
    for name, (values, delay) in outcome.items():
        if name in network.meshes:
            reports[name] = _name_arrivals(network, name, np.asarray(values))
            continue
        fusion = network.fused[name]
        assert isinstance(fusion, Fusion)  # no other rule uses reports
        nodes, n = network.nodes_with(fusion.filter), len(network.states)
        sizes = [link.received(n) for link in fusion.links(nodes)]
        reports[name] = {
            node: SentReports(np.asarray(values)[..., i, : sizes[i]], np.asarray(delay)[..., i])
            for i, node in enumerate(nodes)
        }
    return reports


def _name_arrivals(network: Network, name: str, arrived: np.ndarray) -> dict[str, SentReports]:
    """Return for each node what arrived from its neighbours (..., rounds times neighbours): 1 or the age, NaN if lost.

    `arrived`: what arrived in the fusion `name` (..., node, rounds, degree), as flags, or as ages in steps with -1 for
    lost messages.
    """
    neighbours = network.meshes[name].neighbours or {}
    reports = {}
    for i, node in enumerate(network.mesh_nodes(name)):
        if count := len(neighbours[node]):
            arrivals = arrived[..., i, :, 1 : count + 1]  # without the node's own message, and without padding
            are_flags = arrivals.dtype == bool
            ages = np.where(arrivals, 1.0, np.nan) if are_flags else np.where(arrivals >= 0, arrivals, np.nan)
            values = ages.reshape(*arrivals.shape[:-2], -1)
            # The ages say already how late messages are, so that the delays are zeros.
            reports[node] = SentReports(values, np.zeros(values.shape[:-1], dtype=int))
    return reports


def split_measurements(
    network: Network, groups: Sequence[Float[np.ndarray, "*runs node received"]]
) -> dict[str, np.ndarray]:
    """Split measurements of the groups of nodes (..., node, received) by node, in the order of the network.

    Args:
        network: the network; `network.groups` has the names of each group's nodes.
        groups: measurements of each group, as a reducer collects them.
    """
    received = {
        name: np.asarray(z)[..., i, :]
        for names, z in zip(network.groups, groups, strict=True)
        for i, name in enumerate(names)
    }
    return {name: received[name] for name in network.names}


def transmissions_by_name(network: Network, groups: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return for each node why its sender transmitted at each step: codes of `SendReason`, (..., m).

    `groups`: arrays (..., node, m) by the number of the nodes' group (nodes of one structure), as text.
    """
    return {
        name: np.asarray(node_group)[..., i, :]
        for group, node_group in groups.items()
        for i, name in enumerate(network.groups[int(group)])
    }


def collect_mode_probabilities(network: Network, batch: PyTree) -> dict[tuple[str, str], np.ndarray]:
    """Return the probabilities of the plant's modes (..., M), by (node, filter), of the filters that estimate them.

    `batch`: "estimates" of many steps, in one stack (..., filter, node, M) for filters of one structure, and
    "fused" estimates by name. Fused estimates have FUSED in place of a node.
    """
    estimates_by_stack = batch["estimates"]
    fused = batch["fused"] if network.fused else {}
    modes = {
        (FUSED, name): np.asarray(estimate.modes) for name, estimate in fused.items() if estimate.modes is not None
    }
    for name, index in network.estimate_indices.items():
        # A stack's probabilities are (..., filter, node, M), if the batch has estimates of this stack.
        if index.stack < len(estimates_by_stack) and estimates_by_stack[index.stack].modes is not None:
            modes[name] = np.asarray(estimates_by_stack[index.stack].modes)[..., index.filter, index.node, :]
    return modes


def collect_weighted_innovations(network: Network, batch: PyTree) -> dict[str, dict[str, Weighed]]:
    """Return innovations with the weight that each component got, by node and filter, of filters that weigh components.

    `batch["weighed"]` has them by stack of filters (time, filter, node, m), with None for stacks that do not weigh; it
    is missing in simulations. Those of filters of all measurements are under "weighed_centrally" by name, and under
    FUSED in the result.
    """
    weighed_by_stack = batch.get("weighed", ())
    weighed: dict[str, dict[str, Weighed]] = {}
    for (node, name), index in network.estimate_indices.items() if weighed_by_stack else ():
        of_stack = weighed_by_stack[index.stack]
        if of_stack is not None:
            fields = [np.asarray(field)[:, index.filter, index.node] for field in of_stack]
            weighed.setdefault(node, {})[name] = Weighed(*fields)
    central = {name: values for name, values in batch.get("weighed_centrally", {}).items() if values is not None}
    if central:
        weighed[FUSED] = central
    return weighed


def split_by_name(
    network: Network, batch: PyTree, read: Callable[[PyTree], Any], axis: int
) -> dict[str, dict[str, np.ndarray]]:
    """Return arrays that are stacked over filters and nodes as one array for each node and filter, by their names.

    Simulations stack filters of one structure, for speed: those that differ in numbers alone, at nodes that do so too
    (a group), are of one structure, and have their arrays along one axis. Users ask by the names of node and filter.

    Args:
        network: the network; its `stacks` are (group, names of the filters) of each stack, and `mesh_stacks` those of
            fusions between neighbours, which have an estimate at each node too.
        batch: "estimates" with an entry for each stack, and "fused" by name, without axes of filters and nodes.
        read: returns the array of an entry of `batch`.
        axis: index of the axis of filters in that array; the axis of nodes follows it.
    """
    by_node: dict[str, dict[str, np.ndarray]] = {name: {} for name in network.names}
    entries = batch["estimates"]
    # Judgements of measurements are made by filters alone: then there is no entry for fusions between neighbours.
    stacks = (network.stacks + network.mesh_stacks)[: len(entries)]
    for (group, filters), entry in zip(stacks, entries, strict=True):
        values = np.moveaxis(np.asarray(read(entry)), (axis, axis + 1), (0, 1))  # (filter, node, ...)
        for name, values_of_filter in zip(filters, values, strict=True):
            for node, value in zip(network.groups[group], values_of_filter, strict=True):
                by_node[node][name] = value
    if network.fused:
        by_node[FUSED] = {name: np.asarray(read(estimate)) for name, estimate in batch["fused"].items()}
    return by_node


def uplinks_by_name(network: Network, outcome: dict[str, dict[str, np.ndarray]]) -> dict[str, Uplink]:
    """Return what the nodes sent to each fusion (its uplinks), by the fusion's name.

    `outcome`: for each fusion, the arrays by field; their last axes are (node, n).
    """
    uplinks = {}
    for name, fusion in network.fused.items() if outcome else ():
        if isinstance(fusion, Fusion) and name in outcome:
            uplinks[name] = Uplink(tuple(network.nodes_with(fusion.filter)), **outcome[name])
    return uplinks
