"""Check that errors between neighbours decay with gains that are given before data, whatever is lost.

Without noise J+ = E[M J M'], where a lost edge (j, i) takes D_ij = c_ij F_i A (e_j - e_i) - K_ij H_j A e_i from node i:

  J_ij+ = E[M_i] J E[M_j]', and for i = j + sum_j q_ij (1 - q_ij) D_ij J D_ij'.
"""

import numpy as np

from heliograph.fusion.mesh.graph import Graph
from heliograph.fusion.mesh.joint import congruence, spread
from heliograph.linear.recursion import information_step
from heliograph.numerics.check import fail

STEPS, LAST = 100, 40  # of the recursion, and those by which its growth is judged
SLOW = 1e-3  # growth of a variance within so many steps' precision


def check_decay(
    what: str, graph: Graph, shares: np.ndarray, arrival: np.ndarray, plant: tuple[np.ndarray, np.ndarray],
    squares: np.ndarray,
) -> None:  # fmt: skip
    """Refuse fixed shares (node, degree) with which the errors of a node grow.

    Args:
        what: name of the fusion.
        graph: whom each node receives.
        shares: c_ij, zero for the node itself.
        arrival: probability of every edge's message (edge,), receiver after receiver.
        plant: A and Q.
        squares: H_j' R_j^-1 H_j (node, n, n).

    Raises:
        ValueError: errors that grow, by the name of the node where they are largest.
    """
    arrives = np.zeros(graph.present.shape)
    arrives[:, 1:][graph.present[:, 1:]] = arrival
    growth, sizes = _growth(graph, arrives, *_steps(graph, shares, plant, squares))
    if growth > 1 + SLOW:
        raise fail(what, "shares with which errors decay, whatever is lost (or a rule that intersects)",
                   f"squares that grow by {growth:.3g} a step at node {graph.nodes[sizes.argmax()]!r}")  # fmt: skip


def _steps(
    graph: Graph, shares: np.ndarray, plant: tuple[np.ndarray, np.ndarray], squares: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Step of a node's error: alone (node, n, n), and what a message adds of the sender's and of its (node, degree)."""
    a, q = plant
    n = len(a)
    # Gains of a filter that receives all its neighbours' measurements, in the long run.
    total = np.where(graph.present[:, :, None, None], squares[graph.senders], 0.0).sum(axis=1)
    p = np.tile(np.eye(n), (len(squares), 1, 1))
    for _ in range(STEPS):
        p = information_step(a @ p @ a.T + q, total)
    # c_ij F_i A e_j, and -c_ij F_i A e_i - P_i S_j A e_i.
    pulled = shares[:, :, None, None] * ((np.eye(n) - p @ total) @ a)[:, None]
    return a - p @ squares @ a, pulled, -pulled - p[:, None] @ squares[graph.senders] @ a


def _growth(
    graph: Graph, arrives: np.ndarray, alone: np.ndarray, pulled: np.ndarray, pushed: np.ndarray
) -> tuple[float, np.ndarray]:
    """Growth of the errors' second moments in a step, and in the end their sizes by node."""
    nodes, n = alone.shape[:2]
    # Mean over what gets lost, and its variance.
    mean = arrives[:, :, None, None] * pulled
    mean[:, 0] = alone + (arrives[:, :, None, None] * pushed)[:, 1:].sum(axis=1)
    m = spread(mean, graph.senders, graph.present)
    variance = (arrives * (1 - arrives))[:, :, None, None]
    # Second moments without noise, in units of their size before a step.
    joint, logarithms, places, senders = np.eye(nodes * n), [], np.arange(nodes), graph.senders
    both = np.concatenate([pushed, pulled], axis=3)
    for _ in range(STEPS):
        blocks = joint.reshape(nodes, n, nodes, n)
        cross = blocks[places[:, None], :, senders, :]
        top = np.concatenate([np.broadcast_to(blocks[places, :, places, :][:, None], cross.shape), cross], axis=3)
        below = np.concatenate([cross.swapaxes(2, 3), blocks[senders, :, senders, :]], axis=3)
        more = both @ np.concatenate([top, below], axis=2) @ both.swapaxes(2, 3)
        joint = np.asarray(congruence(m, joint))
        joint.reshape(nodes, n, nodes, n)[places, :, places, :] += (variance * more).sum(axis=1)
        # Their size, of which the next step is a multiple.
        logarithms.append(np.log(np.trace(joint)))
        joint /= np.trace(joint)
    return float(np.exp(np.mean(logarithms[-LAST:]))), np.einsum("iaia->i", joint.reshape(nodes, n, nodes, n))
