"""Fusions between neighbours, built from a network: graph, edges, models of the measurements and the rule's parts."""

from collections.abc import Sequence

import numpy as np

from heliograph.fusion.mesh.graph import graph_of
from heliograph.model.over_time import stack
from heliograph.numerics.check import fail
from heliograph.simulation.centres.observation_model import ObservationModel, SeparateObservations, stack_nodes
from heliograph.simulation.mesh.mesh import Mesh
from heliograph.simulation.mesh.neighbour_edges import build_edges
from heliograph.simulation.mesh.state_and_step import NodeBucket
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

DENSE = 200  # most nodes whose joint covariance is propagated at every step


def build_mesh(network: Network, name: str) -> Mesh:
    """Return the fusion `name` between neighbours of a network, ready to be stepped: its graph, edges and models.

    In such a fusion, a mesh, there is no centre: at each step every node fuses its own estimate with those that its
    neighbours send. Nodes of one structure are a group of the network.
    """
    fusion = network.meshes[name]
    assert fusion.neighbours is not None
    nodes = network.mesh_nodes(name)
    graph = graph_of(fusion.neighbours, nodes)
    # Nodes of about as many neighbours are computed together, as one bucket: arrays of (node, sender) need little
    # padding then. `senders` has one row a node, with the node itself first.
    buckets = []
    for part in graph.buckets():
        members, width = part.senders[:, 0], part.senders.shape[1]
        buckets.append(NodeBucket(rule=fusion.rule.placed(part), rows=members, width=width))
    # Place of each node among the results of all buckets, which are joined one after another.
    ranks = np.argsort(np.concatenate([bucket.rows for bucket in buckets]))
    # For each group of nodes of one structure that has the mesh's estimates: the numbers of its nodes in the mesh.
    index = {node: i for i, node in enumerate(nodes)}
    groups = [network.groups[stacked.group] for stacked in network.mesh_stacks if stacked.filters == (name,)]
    return Mesh(
        plant=network.plant,
        buckets=tuple(buckets),
        ranks=ranks,
        edges=build_edges(fusion, graph),
        observation_model=_model_measurements(network, nodes),
        senders=graph.senders,
        indices=tuple(tuple(index[node] for node in group) for group in groups),
        nodes=graph.nodes,
        alpha=None if fusion.alpha is None else np.asarray(fusion.alpha),  # an argument of the program, no constant
        quantizer=stack(fusion.quantizers(graph.nodes)) if fusion.quantizer is not None else None,
        needs_joint=fusion.rule.needs_joint,
        claim=network.claims()[nodes[0]][name],  # the same at every node
    )


def _model_measurements(network: Network, nodes: Sequence[str]) -> SeparateObservations:
    """Return the measurement models of these nodes of a network, in their order; without a sensor they measure nothing.

    Nodes of one group of the network have models of one structure, which are stacked.
    """
    models_by_group: list[ObservationModel | None] = []  # None: nodes without a sensor
    for names in network.groups:
        members = [network.nodes[name] for name in names]
        with_sensor = [node for node in members if isinstance(node, Node)]  # all of a group, or none
        sensors, channels = [node.sensor for node in with_sensor], [node.channel for node in with_sensor]
        models_by_group.append(stack_nodes(sensors, channels) if with_sensor else None)
    # Place of each node among all, group after group.
    names_by_group = [name for names in network.groups for name in names]
    place_of_node = {name: place for place, name in enumerate(names_by_group)}
    return SeparateObservations(
        groups=tuple(models_by_group),
        order=np.array([place_of_node[node] for node in nodes]),
        size=max(1, *(node.received for node in network.nodes.values())),
        counts=tuple(map(len, network.groups)),
    )


def build_meshes(network: Network) -> dict[str, Mesh]:
    """Return the network's fusions between neighbours (meshes) by name, ready to be stepped.

    Raises:
        ValueError: more than DENSE nodes with a rule that needs the joint covariance of all their errors at every step.
            The message names two ways out: `freeze`, which takes a mean of that covariance once and for all, and rules
            of covariance intersection, which do without it.
    """
    for name, fusion in network.meshes.items():
        nodes = len(network.mesh_nodes(name))
        if fusion.rule.needs_joint and nodes > DENSE:
            kind = type(fusion.rule).__name__
            expected = f"at most {DENSE} nodes, whose joint covariance it follows (freeze it, or intersect)"
            raise fail(f"fusion {name!r} between neighbours by {kind}", expected, nodes)
    return {name: build_mesh(network, name) for name in network.meshes}
