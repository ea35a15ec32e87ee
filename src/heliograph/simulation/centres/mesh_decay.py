"""Check that errors between neighbours decay with gains that are given before data, whatever is lost.

Without noise J+ = E[M J M'], where a lost edge (j, i) takes D_ij = c_ij F_i A (e_j - e_i) - K_ij H_j A e_i from node i:

  J_ij+ = E[M_i] J E[M_j]', and for i = j + sum_j q_ij (1 - q_ij) D_ij J D_ij'.
"""

import numpy as np
from scipy.sparse import bsr_array

from heliograph.fusion.mesh.graph import Graph
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
    a, q = plant
    nodes, n = len(graph.nodes), len(a)
    # Gains of a filter that receives all its neighbours' measurements, after it has settled.
    there = graph.present[:, :, None, None]
    total = np.where(there, squares[graph.senders], 0.0).sum(axis=1)
    p = np.tile(np.eye(n), (nodes, 1, 1))
    for _ in range(STEPS):
        before = a @ p @ a.T + q
        p = np.linalg.solve(np.eye(n) + before @ total, before)
        p = (p + p.swapaxes(1, 2)) / 2
    # What each edge adds to the error of its receiver: from the sender's and from its own.
    arrives = np.zeros(graph.present.shape)
    arrives[:, 1:][graph.present[:, 1:]] = arrival
    pulled = shares[:, :, None, None] * ((np.eye(n) - p @ total) @ a)[:, None]
    pushed = -pulled - p[:, None] @ squares[graph.senders] @ a
    mean = arrives[:, :, None, None] * pulled
    mean[:, 0] = a - p @ squares @ a + (arrives[:, :, None, None] * pushed)[:, 1:].sum(axis=1)
    ends = np.concatenate([[0], np.cumsum(graph.present.sum(axis=1))])
    m = bsr_array((mean[graph.present], graph.senders[graph.present], ends), shape=(nodes * n,) * 2, blocksize=(n, n))
    spread = (arrives * (1 - arrives))[:, :, None, None]
    # Second moments without noise, in units of their size before a step.
    joint, sizes, places = np.eye(nodes * n), [], np.arange(nodes)
    for _ in range(STEPS):
        blocks = joint.reshape(nodes, n, nodes, n)
        receivers, senders = places[:, None], graph.senders
        cross = pushed @ blocks[receivers, :, senders, :] @ pulled.swapaxes(2, 3)
        same = pushed @ blocks[receivers, :, receivers, :] @ pushed.swapaxes(2, 3) + pulled @ blocks[
            senders, :, senders, :
        ] @ pulled.swapaxes(2, 3)
        more = (spread * (same + cross + cross.swapaxes(2, 3))).sum(axis=1)
        joint = m @ np.ascontiguousarray((m @ joint).T)
        joint.reshape(nodes, n, nodes, n)[places, :, places, :] += more
        sizes.append(np.trace(joint))
        joint /= sizes[-1]
    growth = np.exp(np.mean(np.log(sizes[-LAST:])))
    if growth > 1 + SLOW:
        worst = np.einsum("iaia->i", joint.reshape(nodes, n, nodes, n)).argmax()
        raise fail(what, "shares with which errors decay, whatever is lost (or a rule that intersects)",
                   f"squares that grow by {growth:.3g} a step at node {graph.nodes[worst]!r}")  # fmt: skip
