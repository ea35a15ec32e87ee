"""Errors of nodes that estimate from their neighbours, in the mean over independent losses, before any data.

Where a node's gains depend on what arrives at this step alone, J is independent of them, and losses of different
receivers of each other. For i != j

  J_ij+ = E[M_i] J E[M_j]' + E[F_i] Q E[F_j]' + sum_l E[K_il] R_l E[K_jl]'

and the diagonal blocks are means over all patterns of what may arrive at one node.
"""

from itertools import product
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.fusion.mesh.gains import NodeGains
from heliograph.fusion.mesh.graph import graph_of
from heliograph.fusion.mesh.joint_error_covariance import (
    blocks_of,
    error_transitions,
    measurement_weights,
    propagate_joint_covariance,
    scatter_blocks,
)
from heliograph.fusion.mesh.neighbour_rules import FrozenWeights
from heliograph.fusion.rules import AbstractFusion
from heliograph.linear.jump_system import propagate_by_mode
from heliograph.model.channel import Channel
from heliograph.numerics.check import check_count, fail
from heliograph.numerics.float64 import quickly_compiled, to_numpy
from heliograph.numerics.types import ArrayLike, Float
from heliograph.simulation.arguments import read_plant_inputs
from heliograph.simulation.centres.mesh import Mesh, MeshRows, MeshStep
from heliograph.simulation.centres.mesh_check import error_claim
from heliograph.simulation.centres.mesh_errors import MeshErrors, compute_full_step, find_mesh
from heliograph.simulation.centres.neighbour_edges import arrival_chance, edge_links
from heliograph.simulation.network import Network

NODES, DEGREE = 200, 10  # most nodes and neighbours of one node whose patterns are listed: 2^degree rows a node


class ArrivalPatterns(NamedTuple):
    """All patterns of what may arrive at each node, one row each, node after node, with their probabilities.

    Shapes: node (row,), present (row, degree), probability (row,); start (node,): a node's first row.
    """

    node: np.ndarray
    present: np.ndarray
    probability: np.ndarray
    start: np.ndarray


def mean_mesh_errors(
    network: Network, fusion: str, horizon: int, inputs: Float[ArrayLike, "horizon inputs"] | None = None
) -> MeshErrors:
    """Compute the covariances of all nodes' errors in the mean over losses, for weights made from this mean.

    A node then needs nothing but what arrives at this step: best weights are solved for it, from the mean joint
    covariance of its neighbourhood. Up to 200 nodes of at most 10 neighbours, losses independent over steps and edges.

    Args:
        network: the network.
        fusion: name of its fusion between neighbours, by best weights or diffusion.
        horizon: number of steps.
        inputs: inputs of the plant (horizon, inputs); by default a plant without inputs is assumed.

    Raises:
        ValueError: no such fusion, a rule whose gains remember losses (intersection), losses in bursts, too many
            neighbours.
    """
    # Only gains that depend on what arrives at this step alone are independent of J.
    mesh = find_mesh(network, fusion)
    between = network.meshes[fusion]
    if not (between.rule.needs_joint or isinstance(between.rule, FrozenWeights)):
        expected = "best weights or diffusion (an intersection remembers losses: mesh_errors of drawn arrivals)"
        raise fail(f"mean errors of fusion {fusion!r}", expected, type(between.rule).__name__)
    # P(pattern) = prod_j p_ij over the edges that deliver, 1 - p_ij over those that do not.
    network.check_horizon(check_count("horizon", horizon))
    u = read_plant_inputs(network, inputs, horizon)
    names = mesh.nodes
    graph = graph_of(between.neighbours or {}, names)
    links = {} if between.link is None else edge_links(between.link, graph)
    chances = [_get_known_probability(name, link) for name, link in links.items()] or [1.0] * len(graph.edges)
    patterns = _list_patterns(mesh, np.array(chances))
    rows = _repeat_by_pattern(mesh, between.rule.placed(graph), patterns)
    with jax.enable_x64(True):
        start = to_numpy(mesh.init())
    # J_k -> J_k+1 by the formula above: gains of every pattern from J_k, then means over the patterns.
    joint, covariance, moments = np.tile(start.plant[1], (len(names),) * 2), start.covariance, start.plant
    errors = []
    for k, u_k in enumerate(u):
        with jax.enable_x64(True):
            step = to_numpy(compute_full_step(mesh, start.covariance, moments, u_k, np.asarray(k)))
            shape = (len(names), len(network.states)) * 2
            blocks = np.asarray(blocks_of(joint.reshape(shape), mesh.senders))
            gains = to_numpy(_compute_gains(rows, covariance, blocks, patterns, step))
        joint, moments = _average_joint(mesh, joint, blocks, patterns, gains, step), step.plant
        n = len(step.motion.shift)
        errors.append(np.einsum("iaib->iab", joint.reshape(len(names), n, len(names), n)).copy())
        covariance = np.asarray(gains.covariance)[patterns.start]
    return MeshErrors(
        nodes=names,
        actual=np.stack(errors),
        claimed=np.stack(errors),
        joint=joint.reshape(len(names), n, len(names), n),
        claim=error_claim(fusion, between, network),
    )


def _repeat_by_pattern(mesh: Mesh, rule: AbstractFusion, patterns: ArrivalPatterns) -> Mesh:
    """Return the mesh with a row for each pattern of each node; `rule`: placed on the nodes, its arrays' last axis."""
    rule = jax.tree.map(lambda leaf: leaf[..., patterns.node] if eqx.is_array(leaf) else leaf, rule)
    bucket = MeshRows(rule, np.arange(len(patterns.node)), mesh.senders.shape[1])
    repeated: Mesh = eqx.tree_at(lambda m: (m.senders, m.buckets), mesh, (mesh.senders[patterns.node], (bucket,)))
    return repeated


@quickly_compiled
def _compute_gains(
    rows: Mesh, covariance: np.ndarray, blocks: np.ndarray, patterns: ArrivalPatterns, step: MeshStep
) -> NodeGains:
    """Return the gains of each pattern: what arrives of information is summed, and weights are solved for it.

    Shapes: covariance (node, n, n) before the step, blocks (node, degree, n, degree, n) of J at each neighbourhood.
    """
    information = rows.sum_of(jnp.asarray(step.data.information), jnp.asarray(patterns.present))
    complete = jnp.asarray(step.information)[patterns.node]
    blocks_by_pattern = jnp.asarray(blocks)[patterns.node]
    return rows.gains(jnp.asarray(covariance), blocks_by_pattern, jnp.asarray(patterns.present), step.motion,
                      information, complete)  # fmt: skip


def _average_joint(
    mesh: Mesh, joint: np.ndarray, blocks: np.ndarray, patterns: ArrivalPatterns, gains: NodeGains, step: MeshStep
) -> np.ndarray:
    """Return J+ (N, N): of two nodes by products of mean gains, of one node by the mean over its patterns."""
    count, degree = mesh.senders.shape
    q, s, n = np.asarray(step.motion.noise), np.asarray(step.data.information), len(step.motion.shift)

    def mean(values: np.ndarray) -> np.ndarray:
        """Return E[value] of each node, sum_r p_r value_r over its patterns r."""
        weighted = values * patterns.probability.reshape(-1, *[1] * (values.ndim - 1))
        return np.asarray(np.add.reduceat(weighted, patterns.start, axis=0))

    # Of every pattern r: M_r (the node itself first), F_r and the weights of what arrived, K_r H' R^-1.
    m, f = np.asarray(error_transitions(gains, step.motion.matrix)), np.asarray(gains.innovation)
    w = np.asarray(measurement_weights(gains.gain, patterns.present))
    # i != j: J_ij+ = E[M_i] J E[M_j]' + E[F_i] Q E[F_j]' + sum_l E[K_il] R_l E[K_jl]'.
    mean_w = mean(w)
    scattered = [
        scatter_blocks(x, mesh.senders, mesh.edges.present) for x in (mean(m), mean_w @ s[mesh.senders], mean_w)
    ]
    after = propagate_joint_covariance(joint, scattered[0], mean(f), q, *scattered[1:])
    # i = j: J_ii+ = E[M_r J M_r' + F_r Q F_r' + sum_l K_rl R_l K_rl'], with J of the neighbourhood of i.
    flat = m.swapaxes(1, 2).reshape(len(m), n, degree * n)
    inside = blocks.reshape(count, degree * n, degree * n)[patterns.node]
    noise = np.einsum("rdab,rdbc,rdec->rae", w, s[mesh.senders][patterns.node], w)
    diagonal = mean(propagate_by_mode(flat, inside, propagate_by_mode(f, q, noise)))
    blocks_after = after.reshape(count, n, count, n)  # a view: writing here changes `after`
    nodes = np.arange(count)
    blocks_after[nodes, :, nodes, :] = diagonal
    return np.asarray(after)


def _list_patterns(mesh: Mesh, chances: np.ndarray) -> ArrivalPatterns:
    """Return all patterns of what may arrive at every node, with their probabilities.

    `chances`: probability of arrival of every edge, receiver after receiver.
    """
    counts = mesh.edges.present[:, 1:].sum(axis=1)
    if len(counts) > NODES or counts.max() > DEGREE:
        raise fail("mean errors between neighbours", f"at most {NODES} nodes of at most {DEGREE} neighbours",
                   f"{len(counts)} nodes of up to {counts.max()}")  # fmt: skip
    rows: list[int] = []
    present: list[list[bool]] = []
    probability: list[float] = []
    start: list[int] = []
    for i, of_node in enumerate(np.split(chances, np.cumsum(counts)[:-1])):
        start.append(len(rows))
        for flags in product(*[[True] if p == 1 else [True, False] for p in of_node]):
            rows.append(i)
            present.append([True, *flags, *[False] * (mesh.senders.shape[1] - 1 - len(flags))])
            probability.append(float(np.prod(np.where(flags, of_node, 1 - of_node))))
    return ArrivalPatterns(np.array(rows), np.array(present), np.array(probability), np.array(start))


def _get_known_probability(edge: str, link: Channel) -> float:
    """Return the probability that a message of this edge arrives, at every step the same and drawn anew."""
    chance = arrival_chance(link)
    if chance is None:
        expected = "losses that are independent over steps (mesh_errors of drawn arrivals for others)"
        raise fail(f"mean errors: link {edge!r}", expected, type(link).__name__)
    return chance
