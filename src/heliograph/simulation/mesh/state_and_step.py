"""Fusion between neighbours: its state, what a step computes without the estimates, and the formulas of a step.

`n`: number of the plant's states; `m`: of the longest measurement; `degree`: most messages that a node receives, its
own counted first.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.fusion.cross_covariance import JointObservation, Motion
from heliograph.fusion.mesh.joint_error_covariance import (
    error_transitions,
    measurement_weights,
    propagate_joint_covariance,
    scatter_blocks,
)
from heliograph.fusion.mesh.node_gains import NeighbourEstimates, NeighbourWeights, NodeGains, information_of
from heliograph.fusion.rules import AbstractFusion
from heliograph.numerics.module import Module
from heliograph.numerics.types import Array, Bool, Float
from heliograph.simulation.mesh.late_and_quantized_messages import MessagesOnTheWay

# Which messages arrive, each node's from itself first; where they may be late, their ages in steps, -1 of none.
Arrived = Bool[Array, "node rounds degree"]
# Weights computed before a step: for each bucket of nodes the `neighbour_factors` and the `covariance` of
# `NeighbourWeights`, a row for each node of the bucket; empty where none are.
PrecomputedWeights = Sequence[Sequence[Array]]


class NodeBucket(Module):
    """Nodes of a mesh that have about as many neighbours, and the rule placed on them.

    Args:
        rule: by which each of them weighs what it receives, with arrays whose last axis is the node.
        rows: numbers of these nodes in the mesh.
        width: the most messages that one of them receives, its own included.
    """

    rule: AbstractFusion
    rows: np.ndarray
    width: int = eqx.field(static=True)


class MeshState(NamedTuple):
    """Estimates of all nodes, the covariances by which they weigh, and what is known before any data.

    Args:
        mean: estimates of the nodes (node, n).
        covariance: by which rules weigh them (node, n, n).
        joint: covariance of all nodes' errors (node, n, node, n); None where the rule does without.
        plant: mean (n,) and covariance (n, n) of the plant's state before any data.
        sent: estimates that each node received last of its neighbours (node, degree, n), predicted to the present step;
            None where every estimate is sent at every step.
        way: messages that may still arrive later; None where none is late or quantized.
    """

    mean: Float[jax.Array, "node n"]
    covariance: Float[jax.Array, "node n n"]
    joint: Float[jax.Array, "node n node n"] | None
    plant: tuple[Float[jax.Array, " n"], Float[jax.Array, "n n"]]
    sent: Float[jax.Array, "node degree n"] | None
    way: MessagesOnTheWay | None


class MeasurementInformation(NamedTuple):
    """Information in the measurements of one step, z_j = H_j x + offset_j + noise of covariance R_j, by node j.

    Args:
        observation: H_j, offset_j and R_j of all nodes.
        weighted: H_j' R_j^-1 (node, n, m) of the components that are not missing.
        information: S_j = H_j' R_j^-1 H_j (node, n, n) of the components that are not missing.
        complete: S_j (node, n, n) as if no component were missing.
    """

    observation: JointObservation
    weighted: Float[jax.Array, "node n m"]
    information: Float[jax.Array, "node n n"]
    complete: Float[jax.Array, "node n n"]


class MeshStep(NamedTuple):
    """All of one step of all nodes that does not depend on the estimates.

    Args:
        motion: the plant over the step.
        plant: mean (n,) and covariance (n, n) of the plant's state after the step, before any data.
        exchanges: weights in every round of exchange but the last, with a leading axis of nodes.
        data: information in the step's measurements, by the node that took them.
        information: sum of S_j over the measurements that reach each node (node, n, n).
        gains: of fusing, predicting and correcting, with a leading axis of nodes.
    """

    motion: Motion
    plant: tuple[Float[jax.Array, " n"], Float[jax.Array, "n n"]]
    exchanges: tuple[NeighbourWeights, ...]
    data: MeasurementInformation
    information: Float[jax.Array, "node n n"]
    gains: NodeGains


def compute_information(observation: JointObservation, measured: Bool[jax.Array, "node m"]) -> MeasurementInformation:
    """Return the information H' R^-1 H of each node's measurement: of the components that came, and of all components.

    `observation`: gain H and noise covariance R of each node. `measured`: which components came.
    """
    # A row of zeros without noise only pads a shorter measurement, so it is not counted as a number.
    is_number = jnp.any(observation.gain != 0, axis=-1) | (jnp.einsum("imm->im", observation.noise) > 0)
    gain, noise = jnp.asarray(observation.gain), jnp.asarray(observation.noise)
    weighted, information = jax.vmap(information_of)(gain, noise, is_number & measured)
    _, complete = jax.vmap(information_of)(gain, noise, is_number)
    return MeasurementInformation(observation, weighted, information, complete)


def weigh_measurements(
    data: MeasurementInformation,
    measured: Float[jax.Array, "node m"],
    present: Bool[jax.Array, "node m"],
    common: Float[jax.Array, " n"],
) -> Float[jax.Array, "node n"]:
    """Return H_j' R_j^-1 (z_j - offset_j - H_j m) for each node's measurement z_j; missing components add 0.

    H_j, R_j: gain and noise covariance of node j. m: `common`, one point for all nodes. `present`: which components of
    z_j came.
    """
    observation = data.observation
    innovation = jnp.where(present, measured - observation.offset - observation.gain @ common, 0.0)
    return jnp.einsum("inm,im->in", data.weighted, innovation)  # weighted: H_j' R_j^-1


def widen_for_events(received: NeighbourEstimates, alpha: Array) -> NeighbourEstimates:
    """Return the received estimates with covariances that hold if neighbours send only on events.

    A neighbour's last message may be off by more than the covariance P of its estimate, but by at most
    (1 + sqrt(alpha n))^2 P (see `find_event_senders`). A node's own estimate, in place 0, stays as it is.

    Args:
        received: estimates, with a leading axis of nodes.
        alpha: threshold of the events.
    """
    degree, n = received.information.shape[1:3]
    factor = jnp.where(np.arange(degree) > 0, (1 + jnp.sqrt(alpha * n)) ** 2, 1.0)
    information = received.information / factor[:, None, None]
    return received._replace(traces=received.traces * factor, information=information)


def pull_to_neighbours(
    common_factor: Float[jax.Array, "node n n"],
    neighbour_factors: Float[jax.Array, "node degree n *n"],
    mean: Float[jax.Array, "node n"],
    received: Float[jax.Array, "node degree n"],
) -> Float[jax.Array, "node n"]:
    """Return L_i sum_j D_ij (xhat_ij - xhat_i) over the neighbours j of each node i: its move towards their estimates.

    Args:
        common_factor: L_i, a matrix for each node.
        neighbour_factors: D_ij, a matrix for each message, or its diagonal alone.
        mean: the nodes' own estimates xhat_i.
        received: the estimates xhat_ij that each node received. Place 0 is its own estimate, which adds nothing.
    """
    difference = (received - mean[:, None]).at[:, 0].set(0.0)
    if neighbour_factors.ndim == 4:
        weighted_sum = jnp.einsum("idab,idb->ia", neighbour_factors, difference)
    else:
        weighted_sum = jnp.sum(neighbour_factors * difference, axis=1)
    return jnp.einsum("iab,ib->ia", common_factor, weighted_sum)


def propagate_joint(
    joint: Float[jax.Array, "node n node n"],
    step: MeshStep,
    arrived: Bool[Array, "node degree"],
    senders: np.ndarray,
    present: np.ndarray,
) -> Float[jax.Array, "node n node n"]:
    """Return the joint covariance J+ = M J M' + F Q F' + sum_l W_l S_l W_l' of all nodes' errors after a step.

    The errors e_i = x - xhat_i of all nodes, one below the other, become M e + F w - sum_l W_l H_l' R_l^-1 v_l. w is
    the plant's noise, Cov w = Q; the correction of node i multiplies an error by F_i = I - W_i S
    (`step.gains.correction_map`). v_l is the noise of node l's measurement, Cov v_l = R_l, weighted by W_l at the nodes
    that receive it; S_l = H_l' R_l^-1 H_l. M mixes the estimates.

    Args:
        joint: J before the step.
        step: the plant's motion F and Q, the nodes' gains (`gains.gain` is W), and S_l of the nodes' measurements.
        arrived: which messages of a node's neighbours arrive.
        senders: numbers of the neighbours from which each node receives (node, degree).
        present: True for a neighbour (node, degree); all other places only pad the rows to one length.
    """
    gains, motion = step.gains, step.motion
    # Blocks (node, degree, n, n) of W (0 for measurements that did not arrive), of M and of W S.
    w_blocks = measurement_weights(gains.gain, jnp.asarray(arrived))
    m_blocks = error_transitions(gains, motion.matrix)
    ws_blocks = w_blocks @ step.data.information[senders]
    # The same as matrices (N, N) of all nodes, N = nodes n.
    m, ws, w = (scatter_blocks(jnp.asarray(blocks), senders, present) for blocks in (m_blocks, ws_blocks, w_blocks))
    nodes, n = joint.shape[:2]
    covariance = propagate_joint_covariance(
        joint.reshape(nodes * n, nodes * n), m, gains.correction_map, motion.noise, weighted_information=ws, weights=w
    )
    return jnp.asarray(covariance).reshape(joint.shape)
