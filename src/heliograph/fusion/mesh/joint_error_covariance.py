"""Joint covariance J of the errors of all nodes over a step, by dense matrices in a program, by sparse ones outside.

  J+ = M J M' + F Q F' + sum_l K_l R_l K_l',  K_il R_l K_jl' = W_i S_l W_j'

Blocks (node, degree, n, n) of a matrix are those of each node and its neighbours, itself first; N = nodes n.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy

from heliograph.fusion.mesh.node_gains import NodeGains
from heliograph.linear.jump_system import propagate_by_mode
from heliograph.numerics.numpy_or_jax import is_traced, library
from heliograph.numerics.types import Array, Bool, Float, Int


def error_transitions(gains: NodeGains, matrix: Float[Array, "n n"]) -> Float[Array, "node degree n n"]:
    """Return M_ij of e_i+ = sum_j M_ij e_j + noise, for each node i: first of itself, then of its neighbours.

    e_i is the error of node i. M_ij, the gain of neighbour j's estimate, is L_i D_ij = `gains.common_factor`
    `gains.neighbour_factors`. M_ii = F_i A - sum_j M_ij, with A = `matrix` of the plant and F_i = I - W_i S_i
    (`gains.correction_map`), what a correction leaves of an error.
    """
    factors = gains.neighbour_factors
    matrices = factors if factors.ndim == 4 else factors[..., None] * np.eye(len(matrix))  # from diagonals
    # Along the axis of neighbours the node itself comes first, whose M_ii follows from the others.
    of_neighbours = (gains.common_factor[:, None] @ matrices)[:, 1:]
    of_itself = gains.correction_map @ matrix - of_neighbours.sum(axis=1)
    transitions: Float[Array, "node degree n n"] = library(gains).concatenate(
        [of_itself[:, None], of_neighbours], axis=1
    )
    return transitions


def measurement_weights(
    gain: Float[Array, "node n n"], arrived: Bool[Array, "node degree"]
) -> Float[Array, "node degree n n"]:
    """Return W_i for the measurements that arrived, and zeros for the others.

    W_i is the gain of node i, the same for the measurements of all its neighbours.
    """
    weights: Float[Array, "node degree n n"] = library(gain, arrived).where(
        arrived[..., None, None], gain[:, None], 0.0
    )
    return weights


def scatter_blocks(
    blocks: Float[Array, "node degree n n"], senders: Int[Array, "node degree"], present: Bool[Array, "node degree"]
) -> Any:
    """Return the matrix (N, N) with these blocks at (node, sender) where present; it is sparse unless it is traced.

    `senders`: index of each neighbour in a node's row, with the node itself as padding (not `present`). N: nodes times
    n.
    """
    nodes, _, n, _ = blocks.shape
    if is_traced(blocks):
        # Padding adds zeros at the node itself.
        masked = jnp.where(present[:, :, None, None], blocks, 0.0)
        zeros = jnp.zeros((nodes, nodes, n, n))
        by_node_and_sender = zeros.at[np.arange(nodes)[:, None], senders].add(masked)
        return by_node_and_sender.swapaxes(1, 2).reshape(nodes * n, nodes * n)
    row_ends = np.concatenate([[0], np.cumsum(present.sum(axis=1))])  # `indptr` of the block sparse row format
    blocks_columns_and_ends = np.asarray(blocks)[present], senders[present], row_ends
    return scipy.sparse.bsr_array(blocks_columns_and_ends, shape=(nodes * n, nodes * n), blocksize=(n, n))


def propagate_joint_covariance(
    joint: Float[Array, "N N"],
    transition: Any,
    correction_map: Float[Array, "node n n"],
    process_noise: Float[Array, "n n"],
    weighted_information: Any,
    weights: Any,
) -> Float[Array, "N N"]:
    """Return J+ = M J M' + F Q F' + (W S) W', the joint covariance of all nodes' errors after a step, symmetric.

    Nodes estimate the plant's state of n numbers, exchange estimates and measurements with neighbours, and mix them;
    N is n times the number of nodes. Their errors are correlated by common noises and by the mixing.

    Args:
        joint: J before the step.
        transition: M (N, N), with blocks M_ij by which the error of node j enters that of node i.
        correction_map: F_i = I - W_i S_i of each node, one below the other in F: what a correction leaves of an error.
        process_noise: Q, the covariance of the plant's noise.
        weighted_information: matrix W S (N, N) of the blocks W_i S_j of the measurements that node i has, with the
            information S_j of a measurement of node j.
        weights: matrix W (N, N) of the gains W_i for these measurements.
    """
    # Noise of the measurements: W S W'.
    measured = weighted_information @ weights.T
    # Sparse matrices, outside of a program, are made dense before they are added.
    measured = measured if is_traced(measured) else measured.toarray()
    # F Q F' + W S W', with the F_i one below the other, (N, n); then M J M' plus that. (`propagate_by_mode(A, P, Q)` is
    # A P A' + Q.) The result is made symmetric, as rounding leaves it only nearly.
    added = propagate_by_mode(correction_map.reshape(len(joint), -1), process_noise, measured)
    after = propagate_by_mode(transition, joint, added)
    symmetric: Float[Array, "N N"] = (after + after.T) / 2
    return symmetric


def blocks_of(joint: Float[Array, "node n node n"], senders: Int[Array, "node degree"]) -> Float[Array, "..."]:
    """Return the joint covariance of each node and its neighbours, (node, degree, n, degree, n).

    It is the part of `joint`, that of all nodes, with the rows and columns of the nodes in a row of `senders`.
    """
    blocks: Float[Array, "..."] = joint[senders[:, :, None], :, senders[:, None], :].swapaxes(2, 3)
    return blocks
