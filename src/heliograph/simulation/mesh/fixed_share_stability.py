"""Whether errors decay where every node adds fixed shares c_ij of its neighbours' estimates to its own.

The plant is x+ = A x + w, Cov w = Q; node j measures z_j = H_j x + v_j, Cov v_j = R_j.
"""

from typing import NamedTuple

import numpy as np

from heliograph.factors.square_root_update import covariance_of_root, observe_information, roots_of
from heliograph.fusion.mesh.graph import Graph
from heliograph.fusion.mesh.joint_error_covariance import scatter_blocks
from heliograph.linear.jump_system import propagate_by_mode
from heliograph.numerics.check import fail

STEPS, LAST = 100, 40  # of the recursion of errors, and those at its end by which their growth is judged
SLOW = 1e-3  # growth a step that so few steps cannot tell from none


def check_error_decay(
    what: str, graph: Graph, shares: np.ndarray, arrival: np.ndarray, plant: tuple[np.ndarray, np.ndarray],
    squares: np.ndarray,
) -> None:  # fmt: skip
    """Raise ValueError if the nodes' errors grow with these fixed shares of their neighbours' estimates.

    Args:
        what: name of the fusion.
        graph: whom each node receives.
        shares: c_ij of node i for its neighbour j (node, degree), zero for the node itself.
        arrival: probability that the message of each edge (neighbour to node) arrives (edge,), receiver after receiver.
        plant: the plant's matrix A and noise covariance Q.
        squares: information H_j' R_j^-1 H_j of each node's measurement (node, n, n).

    Raises:
        ValueError: errors that grow, by the name of the node where they are largest.
    """
    arrives = np.zeros(graph.present.shape)
    arrives[:, 1:][graph.present[:, 1:]] = arrival  # place 0 of each node is the node itself
    error_maps = _make_error_maps(graph, shares, plant, squares)
    growth, error_sizes = _compute_growth_and_sizes(graph, arrives, error_maps)
    if growth > 1 + SLOW:
        node = graph.nodes[error_sizes.argmax()]
        raise fail(what, "shares with which errors decay, whatever is lost (or a rule that intersects)",
                   f"squares that grow by {growth:.3g} a step at node {node!r}")  # fmt: skip


class _ErrorMaps(NamedTuple):
    """One step of the errors, e_i+ = B_i e_i + sum_j (C_ij e_j + D_ij e_i) over the messages j that arrive at node i.

    Args:
        without_messages: B_i (node, n, n).
        of_sender: C_ij, from the error of the sender j (node, degree, n, n).
        of_receiver: D_ij, from the error of the receiver i (node, degree, n, n).
    """

    without_messages: np.ndarray
    of_sender: np.ndarray
    of_receiver: np.ndarray


def _make_error_maps(
    graph: Graph, shares: np.ndarray, plant: tuple[np.ndarray, np.ndarray], squares: np.ndarray
) -> _ErrorMaps:
    """Return the matrices that move the nodes' errors e_i over one step, with the gains that they have in the long run.

    A node predicts (A), corrects by its own measurement, and by each message of a neighbour j: by its measurement, and
    by the fixed share c_ij of its estimate. With the covariance P_i, S_j = H_j' R_j^-1 H_j and F_i = I - P_i sum_j S_j

      e_i+ = (A - P_i S_i A) e_i + sum_j [c_ij F_i A (e_j - e_i) - P_i S_j A e_i].

    The sum is over the messages that arrive. Noises are left out: only growth or decay of errors is to be judged.

    Args:
        graph: whom each node receives, itself first.
        shares: c_ij (node, degree), zero for the node itself.
        plant: A and Q.
        squares: S_j (node, n, n).
    """
    a, q = plant
    n = len(a)
    # P_i of a filter that receives all its neighbours' measurements, after STEPS steps of P- = A P A' + Q and
    # P = (P-^-1 + sum_j S_j)^-1.
    information = np.where(graph.present[:, :, None, None], squares[graph.senders], 0.0).sum(axis=1)
    root = np.tile(np.eye(n), (len(squares), 1, 1))
    process = np.broadcast_to(roots_of(q), root.shape)
    for _ in range(STEPS):
        root = observe_information(np.concatenate([a @ root, process], axis=-1), information).root
    p = covariance_of_root(root)
    # Message j adds of_sender e_j + of_receiver e_i, of_receiver = -c_ij F_i A - P_i S_j A.
    of_sender = shares[:, :, None, None] * ((np.eye(n) - p @ information) @ a)[:, None]  # c_ij F_i A
    return _ErrorMaps(
        without_messages=a - p @ squares @ a,
        of_sender=of_sender,
        of_receiver=-of_sender - p[:, None] @ squares[graph.senders] @ a,
    )


def _compute_growth_and_sizes(graph: Graph, arrives: np.ndarray, maps: _ErrorMaps) -> tuple[float, np.ndarray]:
    """Return by which factor the errors' second moments grow in a step, in the long run, and each node's share of them.

    Nodes fuse their neighbours' estimates with fixed shares; a factor below 1 means that errors stay bounded in spite
    of lost messages. J = E[e e'] of all nodes' errors e. The message from j to i arrives with probability p_ij,
    independently of others, and then adds G_ij (e_i, e_j) to the error of node i, G_ij = (of_receiver_ij,
    of_sender_ij). Without messages the error of node i becomes without_messages_i e_i. With the mean step E[M]

      J+ = E[M] J E[M]', plus sum_j p_ij (1 - p_ij) G_ij E[(e_i, e_j) (e_i, e_j)'] G_ij' in the block of node i.

    Noise does not matter to growth.

    `arrives`: p_ij of each message (node, degree). `maps`: the step of the errors.
    """
    nodes, n = maps.without_messages.shape[:2]
    # E[M]: e_j enters by p_ij of_sender_ij, e_i by without_messages_i + sum_j p_ij of_receiver_ij. Column 0 of the axis
    # `degree` is the node itself.
    probability = arrives[:, :, None, None]
    mean_step = probability * maps.of_sender
    mean_step[:, 0] = maps.without_messages + (probability * maps.of_receiver)[:, 1:].sum(axis=1)
    m = scatter_blocks(mean_step, graph.senders, graph.present)
    variance = (arrives * (1 - arrives))[:, :, None, None]
    g = np.concatenate([maps.of_receiver, maps.of_sender], axis=3)  # (node, degree, n, 2 n)
    # Power iteration: the step of J is repeated, with J scaled to trace 1 each time.
    joint, logarithms, each_node = np.eye(nodes * n), [], np.arange(nodes)
    for _ in range(STEPS):
        by_message = propagate_by_mode(g, _take_moments_of_pairs(joint.reshape(nodes, n, nodes, n), graph), 0.0)
        joint = np.asarray(propagate_by_mode(m, joint, 0.0))
        blocks = joint.reshape(nodes, n, nodes, n)  # a view: writing here changes `joint`
        blocks[each_node, :, each_node, :] += (variance * by_message).sum(axis=1)
        # Growth in this step, since before it the trace was 1 (but for the first, which is not used).
        logarithms.append(np.log(np.trace(joint)))
        joint /= np.trace(joint)
    # In the long run: the geometric mean of the last steps.
    growth = float(np.exp(np.mean(logarithms[-LAST:])))
    return growth, np.einsum("iaia->i", joint.reshape(nodes, n, nodes, n))


def _take_moments_of_pairs(blocks: np.ndarray, graph: Graph) -> np.ndarray:
    """Return E[(e_i, e_j) (e_i, e_j)'] for each node i and each of its senders j, (node, degree, 2 n, 2 n).

    e_i is the error of node i. `blocks`: E[e_i e_j'] of all nodes (node, n, node, n).
    """
    nodes, senders = np.arange(len(graph.senders)), graph.senders
    cross = blocks[nodes[:, None], :, senders, :]
    of_node = np.broadcast_to(blocks[nodes, :, nodes, :][:, None], cross.shape)
    top = np.concatenate([of_node, cross], axis=3)
    bottom = np.concatenate([cross.swapaxes(2, 3), blocks[senders, :, senders, :]], axis=3)
    return np.concatenate([top, bottom], axis=2)
