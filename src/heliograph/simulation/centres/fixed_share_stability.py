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
        arrival: probability of every edge's message (edge,), receiver after receiver.
        plant: A and Q.
        squares: H_j' R_j^-1 H_j (node, n, n).

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
    """One step of the errors: e_i+ = alone_i e_i + sum_j (pulled_ij e_j + pushed_ij e_i), j the messages that arrive.

    Shapes: alone (node, n, n), pulled and pushed (node, degree, n, n).
    """

    alone: np.ndarray
    pulled: np.ndarray
    pushed: np.ndarray


def _make_error_maps(
    graph: Graph, shares: np.ndarray, plant: tuple[np.ndarray, np.ndarray], squares: np.ndarray
) -> _ErrorMaps:
    """Return the step of the errors with the gains of the long run; arguments as of `check_error_decay`."""
    a, q = plant
    n = len(a)
    # P_i in the long run of a filter that receives all its neighbours' measurements, of information `total`: by STEPS
    # steps of P- = A P A' + Q, P = (P-^-1 + total)^-1.
    total = np.where(graph.present[:, :, None, None], squares[graph.senders], 0.0).sum(axis=1)
    root = np.tile(np.eye(n), (len(squares), 1, 1))
    process = np.broadcast_to(roots_of(q), root.shape)
    for _ in range(STEPS):
        root = observe_information(np.concatenate([a @ root, process], axis=-1), total).root
    p = covariance_of_root(root)
    # With F_i = I - P_i total_i and S_j = H_j' R_j^-1 H_j a message of j adds c_ij F_i A (e_j - e_i) - P_i S_j A e_i.
    pulled = shares[:, :, None, None] * ((np.eye(n) - p @ total) @ a)[:, None]
    return _ErrorMaps(
        alone=a - p @ squares @ a, pulled=pulled, pushed=-pulled - p[:, None] @ squares[graph.senders] @ a
    )


def _compute_growth_and_sizes(graph: Graph, arrives: np.ndarray, maps: _ErrorMaps) -> tuple[float, np.ndarray]:
    """Return the growth of the errors' second moments in a step, in the long run, and their sizes by node in the end.

    With E[M] the mean of the step over what gets lost, J+ = E[M] J E[M]' and on the diagonal, since messages get lost
    independently, sum_j p_j (1 - p_j) D_j E[(e_i, e_j) (e_i, e_j)'] D_j' more, where D_j = (pushed_ij, pulled_ij) and
    p_j is the probability of the message. Noise does not matter to growth.

    `arrives`: probability of each message (node, degree).
    """
    nodes, n = maps.alone.shape[:2]
    probability = arrives[:, :, None, None]
    mean = probability * maps.pulled
    mean[:, 0] = maps.alone + (probability * maps.pushed)[:, 1:].sum(axis=1)
    m = scatter_blocks(mean, graph.senders, graph.present)
    variance = (arrives * (1 - arrives))[:, :, None, None]
    changes = np.concatenate([maps.pushed, maps.pulled], axis=3)  # D_j (node, degree, n, 2 n)
    joint, logarithms, itself = np.eye(nodes * n), [], np.arange(nodes)
    for _ in range(STEPS):
        added = propagate_by_mode(changes, _take_moments_of_pairs(joint.reshape(nodes, n, nodes, n), graph), 0.0)
        joint = np.asarray(propagate_by_mode(m, joint, 0.0))
        blocks = joint.reshape(nodes, n, nodes, n)  # a view: writing here changes `joint`
        blocks[itself, :, itself, :] += (variance * added).sum(axis=1)
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
