"""Errors of nodes that estimate from their neighbours, in the mean over independent losses, before any data.

In a step the errors become e_i+ = M_i e + F_i w - sum_l K_il v_l: e the errors of all nodes, of joint covariance J; w
the plant's noise, of covariance Q; v_l the noise of node l's measurement, of covariance R_l. What arrives at node i
decides its M_i, F_i and K_il. Where these depend on what arrives at this step alone, J is independent of them, and
losses of different receivers of each other. For i != j

  J_ij+ = E[M_i] J E[M_j]' + E[F_i] Q E[F_j]' + sum_l E[K_il] R_l E[K_jl]'

and the diagonal blocks are means over all patterns of what may arrive at one node. N = nodes n.
"""

from itertools import product
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.fusion.mesh.graph import graph_of
from heliograph.fusion.mesh.joint_error_covariance import (
    blocks_of,
    error_transitions,
    measurement_weights,
    propagate_joint_covariance,
    scatter_blocks,
)
from heliograph.fusion.mesh.neighbour_rules import FrozenWeights
from heliograph.fusion.mesh.node_gains import NodeGains
from heliograph.fusion.network_fusion import Fusion
from heliograph.fusion.rules import AbstractFusion
from heliograph.linear.jump_system import propagate_by_mode
from heliograph.model.channel import Channel
from heliograph.numerics.check import check_count, fail
from heliograph.numerics.float64 import quickly_compiled, to_numpy
from heliograph.numerics.types import ArrayLike, Float
from heliograph.simulation.arguments import read_plant_inputs
from heliograph.simulation.mesh.check import find_claim_of_errors
from heliograph.simulation.mesh.errors import MeshErrors, compute_full_step, find_mesh
from heliograph.simulation.mesh.mesh import Mesh
from heliograph.simulation.mesh.neighbour_edges import find_arrival_probability, links_by_edge
from heliograph.simulation.mesh.state_and_step import MeshStep, NodeBucket
from heliograph.simulation.network import Network

NODES, DEGREE = 200, 10  # most nodes and neighbours of one node whose patterns are listed: 2^degree rows a node


class ArrivalPatterns(NamedTuple):
    """All patterns of what may arrive at each node, one row each, node after node.

    Args:
        node: number of the node (row,).
        present: which of its messages arrive (row, degree), its own first.
        probability: of the pattern (row,).
        start: first row of each node (node,).
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
    # J may be averaged over losses only where gains depend on what arrives at this step alone, not on earlier losses.
    mesh = find_mesh(network, fusion)
    between = network.meshes[fusion]
    if not (between.rule.needs_joint or isinstance(between.rule, FrozenWeights)):
        expected = "best weights or diffusion (an intersection remembers losses: mesh_errors of drawn arrivals)"
        raise fail(f"mean errors of fusion {fusion!r}", expected, type(between.rule).__name__)
    network.check_horizon(check_count("horizon", horizon))
    u = read_plant_inputs(network, inputs, horizon)
    patterns, rows = _list_patterns(mesh, between)
    with jax.enable_x64(True):
        start = to_numpy(mesh.init())
    # J_k -> J_k+1: gains of every pattern from J_k, then means over the patterns. Before any data all nodes have the
    # same error, x_0 - E x_0.
    count, n = start.mean.shape
    covariance, moments = start.covariance, start.plant
    _, initial_covariance = start.plant
    joint = np.tile(initial_covariance, (count, count))
    errors = []
    for k, u_k in enumerate(u):
        with jax.enable_x64(True):
            step = to_numpy(compute_full_step(mesh, start.covariance, moments, u_k, np.asarray(k)))
            blocks = np.asarray(blocks_of(joint.reshape(count, n, count, n), mesh.senders))
            gains = to_numpy(_compute_gains_by_pattern(rows, covariance, blocks, patterns, step))
        joint, moments = _average_joint(mesh, joint, blocks, patterns, gains, step), step.plant
        errors.append(np.einsum("iaib->iab", joint.reshape(count, n, count, n)).copy())
        # The first pattern of each node stands for all: only diffusion reads this covariance, and by diffusion it is
        # the same in every pattern of a node.
        covariance = np.asarray(gains.covariance)[patterns.start]
    return MeshErrors(
        nodes=mesh.nodes,
        actual=np.stack(errors),
        claimed=np.stack(errors),
        joint=joint.reshape(count, n, count, n),
        claim=find_claim_of_errors(fusion, between, network),
    )


def _list_patterns(mesh: Mesh, fusion: Fusion) -> tuple[ArrivalPatterns, Mesh]:
    """Return all patterns of arriving messages that a node can have in a step, and the mesh with a row for each.

    A pattern says of each neighbour's message whether it arrives.
    """
    graph = graph_of(fusion.neighbours or {}, mesh.nodes)
    # The probability that a message arrives, for each edge from neighbour to neighbour; without links all arrive.
    links = {} if fusion.link is None else links_by_edge(fusion.link, graph)
    chances = [_get_known_probability(name, link) for name, link in links.items()] or [1.0] * len(graph.edges)
    patterns = _compute_pattern_probabilities(mesh, np.array(chances))
    return patterns, _repeat_nodes_by_pattern(mesh, fusion.rule.placed(graph), patterns)


def _repeat_nodes_by_pattern(mesh: Mesh, rule: AbstractFusion, patterns: ArrivalPatterns) -> Mesh:
    """Return the mesh with one row for each pattern of each node, instead of one row for each node.

    A pattern says which messages reach the node. `rule`: the fusion rule, with nodes as the last axis of its arrays.
    """
    node_of_row = patterns.node  # several rows of one node have the same numbers
    rule_of_rows = jax.tree.map(lambda leaf: leaf[..., node_of_row] if eqx.is_array(leaf) else leaf, rule)
    # All rows are computed together, as one bucket of the mesh.
    bucket = NodeBucket(rule=rule_of_rows, rows=np.arange(len(node_of_row)), width=mesh.senders.shape[1])
    senders = mesh.senders[node_of_row]
    repeated: Mesh = eqx.tree_at(lambda m: (m.senders, m.buckets), mesh, (senders, (bucket,)))
    return repeated


@quickly_compiled
def _compute_gains_by_pattern(
    rows: Mesh, covariance: np.ndarray, blocks: np.ndarray, patterns: ArrivalPatterns, step: MeshStep
) -> NodeGains:
    """Return the gains of a node for each pattern of arriving messages, with a leading axis of patterns.

    A pattern says which of its neighbours' messages reach a node in the step.

    Args:
        rows: the mesh with a row for each pattern of each node, instead of one for each node.
        covariance: covariances of the nodes' estimates before the step (node, n, n), which set the weights.
        blocks: joint covariance of the errors of each node and its neighbours (node, degree, n, degree, n).
        patterns: which messages arrive, and at which node.
        step: a step at which everything arrives; its models and its measurements' information are used.
    """
    # Sums of H_j' R_j^-1 H_j over the measurements that arrive in the pattern, and over all that could.
    information = rows.sum_over_messages(jnp.asarray(step.data.information), jnp.asarray(patterns.present))
    complete = jnp.asarray(step.information)[patterns.node]
    return rows.compute_gains(
        covariance=jnp.asarray(covariance),
        blocks=jnp.asarray(blocks)[patterns.node],
        present=jnp.asarray(patterns.present),
        motion=step.motion,
        information=information,
        complete=complete,
    )


def _average_joint(
    mesh: Mesh, joint: np.ndarray, blocks: np.ndarray, patterns: ArrivalPatterns, gains: NodeGains, step: MeshStep
) -> np.ndarray:
    """Return J+ (N, N), the covariance of all nodes' errors after a step, averaged over which messages arrive.

    J has blocks J_ij = E[e_i e_j'] (n, n) of the errors e_i of the nodes' estimates; N = nodes times n. Messages arrive
    independently at different nodes, so for two nodes the mean of a product of gains is the product of the means. For
    one node the products are averaged over its patterns, a pattern being the set of its messages that arrive.

    Args:
        mesh: the fusion between neighbours; `senders` (node, degree) are those whom each node receives, itself first.
        joint: J (N, N).
        blocks: parts of J for the neighbourhood of each node (node, degree, n, degree, n).
        patterns: for each row r the node, which messages arrive, and the probability p_r.
        gains: gains of the node in each row's pattern.
        step: the plant over the step, and the measurements' information S_l = H_l' R_l^-1 H_l.
    """
    count, degree = mesh.senders.shape
    q, s, n = np.asarray(step.motion.noise), np.asarray(step.data.information), len(step.motion.offset)

    def mean(values: np.ndarray) -> np.ndarray:
        """Return E[value] of each node (node, ...), sum_r p_r value_r over its patterns r, from `values` (row, ...)."""
        weighted = values * patterns.probability.reshape(-1, *[1] * (values.ndim - 1))
        return np.asarray(np.add.reduceat(weighted, patterns.start, axis=0))

    # In pattern r the node's error becomes e+ = sum_j M_rj e_j + F_r w - sum_l K_rl v_l, with w of covariance Q and v_l
    # of R_l. `w` holds W_rl, 0 where nothing arrived: K_rl = W_rl H_l' R_l^-1, so K_rl R_l K_rl' = W_rl S_l W_rl'.
    m, f = np.asarray(error_transitions(gains, step.motion.matrix)), np.asarray(gains.correction_map)
    w = np.asarray(measurement_weights(gains.gain, patterns.present))
    # i != j: J_ij+ = E[M_i] J E[M_j]' + E[F_i] Q E[F_j]' + sum_l E[K_il] R_l E[K_jl]'.
    mean_w = mean(w)
    sparse_m, sparse_ws, sparse_w = (  # matrices (N, N) of all nodes
        scatter_blocks(x, mesh.senders, mesh.edges.present) for x in (mean(m), mean_w @ s[mesh.senders], mean_w)
    )
    after = propagate_joint_covariance(joint, sparse_m, mean(f), q, sparse_ws, sparse_w)
    # i = j: J_ii+ = E[M_r J M_r' + F_r Q F_r' + sum_l K_rl R_l K_rl'], with J of the neighbourhood of i.
    flat = m.swapaxes(1, 2).reshape(len(m), n, degree * n)  # M_r as one matrix
    inside = blocks.reshape(count, degree * n, degree * n)[patterns.node]
    noise = np.einsum("rdab,rdbc,rdec->rae", w, s[mesh.senders][patterns.node], w)  # sum_l W_rl S_l W_rl'
    diagonal = mean(propagate_by_mode(flat, inside, propagate_by_mode(f, q, noise)))
    blocks_after = after.reshape(count, n, count, n)  # a view: writing here changes `after`
    nodes = np.arange(count)
    blocks_after[nodes, :, nodes, :] = diagonal
    return np.asarray(after)


def _compute_pattern_probabilities(mesh: Mesh, chances: np.ndarray) -> ArrivalPatterns:
    """Return all patterns of what may arrive at every node, with their probabilities.

    Nodes of the mesh send their estimates to neighbours, and edge j to i delivers with probability p_ij. A pattern of
    node i says which messages arrive there. Its probability is the product over all edges to i: p_ij for an edge that
    delivers, 1 - p_ij for one that does not. `chances` has p of every edge (edges,), receiver after receiver.
    """
    # Number of neighbours of each node; in the axis of messages the node's own, which always arrives, comes first.
    counts = mesh.edges.present[:, 1:].sum(axis=1)
    if len(counts) > NODES or counts.max() > DEGREE:
        raise fail("mean errors between neighbours", f"at most {NODES} nodes of at most {DEGREE} neighbours",
                   f"{len(counts)} nodes of up to {counts.max()}")  # fmt: skip
    # One row a pattern, node after node; `start` has the first row of each node.
    node: list[int] = []
    present: list[list[bool]] = []
    probability: list[float] = []
    start: list[int] = []
    degree = mesh.senders.shape[1]
    for i, node_chances in enumerate(np.split(chances, np.cumsum(counts)[:-1])):
        start.append(len(node))
        # A message that arrives for certain has one outcome.
        for flags in product(*[[True] if p == 1 else [True, False] for p in node_chances]):
            node.append(i)
            padding = [False] * (degree - 1 - len(flags))  # up to the node with the most neighbours
            present.append([True, *flags, *padding])
            probability.append(float(np.prod(np.where(flags, node_chances, 1 - node_chances))))
    return ArrivalPatterns(
        node=np.array(node), present=np.array(present), probability=np.array(probability), start=np.array(start)
    )


def _get_known_probability(edge: str, link: Channel) -> float:
    """Return the probability that a message of this edge arrives; raise unless losses are independent over steps.

    A mean over losses in bursts would need the state of each link. For these the error names `mesh_errors`, which gives
    the errors for one drawn sequence of arrivals. `edge`: the edge's name, for the error.
    """
    chance = find_arrival_probability(link)
    if chance is None:
        expected = "losses that are independent over steps (mesh_errors of drawn arrivals for others)"
        raise fail(f"mean errors: link {edge!r}", expected, type(link).__name__)
    return chance
