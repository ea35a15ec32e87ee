"""Fusions between neighbours, built from a network: graph, edges, models of the measurements and the rule's parts."""

import numpy as np

from heliograph.fusion.mesh.graph import graph_of
from heliograph.model.over_time import stack
from heliograph.numerics.check import fail
from heliograph.simulation.centres.mesh import Mesh, MeshRows
from heliograph.simulation.centres.neighbour_edges import build_edges
from heliograph.simulation.centres.observation_model import Apart, ObservationModel, stack_nodes
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

DENSE = 200  # nodes whose joint covariance is propagated at every step


def build_mesh(network: Network, name: str) -> Mesh:
    """Build the fusion `name` between neighbours of a network."""
    fusion = network.meshes[name]
    assert fusion.neighbours is not None
    nodes = network.mesh_nodes(name)
    graph = graph_of(fusion.neighbours, nodes)
    # Models of the measurements, group after group.
    index = {node: i for i, node in enumerate(nodes)}
    groups: list[ObservationModel | None] = []
    group_places: dict[str, int] = {}
    for names in network.groups:
        sensors = [node for node in map(network.nodes.__getitem__, names) if isinstance(node, Node)]
        groups.append(stack_nodes([n.sensor for n in sensors], [n.channel for n in sensors]) if sensors else None)
        group_places |= {node: len(group_places) + i for i, node in enumerate(names)}
    # Kinds of its filters, and the places of their nodes in the mesh.
    kinds = [kind for kind in network.mesh_kinds if kind.filters == (name,)]
    kind_places = [tuple(index[node] for node in network.groups[kind.group]) for kind in kinds]
    return Mesh(
        plant=network.plant,
        buckets=tuple(MeshRows(fusion.rule.placed(b), b.senders[:, 0], b.senders.shape[1]) for b in graph.buckets()),
        ranks=np.argsort(np.concatenate([bucket.senders[:, 0] for bucket in graph.buckets()])),
        edges=build_edges(fusion, graph),
        observation_model=Apart(
            groups=tuple(groups),
            order=np.array([group_places[node] for node in nodes]),
            size=max(1, *(node.received for node in network.nodes.values())),
            counts=tuple(map(len, network.groups)),
        ),
        senders=graph.senders,
        places=tuple(kind_places),
        nodes=graph.nodes,
        alpha=None if fusion.alpha is None else np.asarray(fusion.alpha),  # an argument of the program, no constant
        quantizer=stack(fusion.quantizers(graph.nodes)) if fusion.quantizer is not None else None,
        needs_joint=fusion.rule.needs_joint,
        claim=network.claims()[nodes[0]][name],
    )


def build_meshes(network: Network) -> dict[str, Mesh]:
    """Return the fusions between neighbours, by name, to be stepped.

    Raises:
        ValueError: too many nodes for a rule that follows the joint covariance of their errors.
    """
    for name, fusion in network.meshes.items():
        nodes = len(network.mesh_nodes(name))
        if fusion.rule.needs_joint and nodes > DENSE:
            kind = type(fusion.rule).__name__
            expected = f"at most {DENSE} nodes, whose joint covariance it follows (freeze it, or intersect)"
            raise fail(f"fusion {name!r} between neighbours by {kind}", expected, nodes)
    return {name: build_mesh(network, name) for name in network.meshes}
