"""H-infinity fusion in the paper's notation, one node: Theorem 1's matrix, also by enumeration, and Theorem 2's."""

from itertools import product

import numpy as np

A = 0.7
B = np.array([[-0.15], [0.15]])
M = np.array([[0.05, 0.05]])
D = (0.3, 0.15, 0.1, 0.25)
h = (0.15, 0.2, 0.25, 0.3)
b = tuple(x * np.sqrt(2) for x in h)
gamma = (1.8, 1.7, 1.8, 1.9)
beta = (0.8, 0.75, 0.7)
E = (1.0, 1.0, 2.0)
C = np.diag([0.1, 0.1, 0.15])
W = 15 * np.eye(4)
T = 15

E1 = np.diag([np.sqrt(E[0] * E[1]), np.sqrt(E[2])])  # the root is over the product
E2 = np.array([[np.sqrt(E[1]), 1.0, 0.0], [0.0, 0.0, 1.0]])
I1, I2 = np.array([[1.0], [0.0]]), np.array([[0.0], [1.0]])
I3 = np.diag([1.0, 0.0, 0.0])


def blocks(i, K, beta=beta):
    """The G_j with their weights w_j (equations (8), (20) to (26)); eta = (x, e, f, f~, h, h~, v, rho)."""
    b1, b2, b3 = beta
    theta = b1 * b2
    d1 = np.array([[theta], [b3]])
    d2 = np.diag([b2, 1.0, 1.0])
    zero = np.zeros((2, 1))
    KE1, KE2 = K @ E1, K @ E2
    R1 = np.block([[zero, zero], [zero, -KE1 @ d1]])
    Bbar = np.concatenate([B, B - KE1 @ d1 * D[i]])
    R4C = np.concatenate([np.zeros((2, 3)), -KE2 @ d2 @ C])
    R2D1 = np.block([[zero, zero], [-KE1 @ I1, zero]])
    R2D2 = np.block([[zero, zero], [-KE1 @ I2, zero]])
    R3I1D = np.concatenate([zero, -KE1 @ I1 * D[i]])
    R3I2D = np.concatenate([zero, -KE1 @ I2 * D[i]])
    R5I3C = np.concatenate([np.zeros((2, 3)), -KE2 @ I3 @ C])
    none4, none2, none1, none3 = (np.zeros((4, k)) for k in (4, 2, 1, 3))
    Theta, theta_, b2_, b3_ = theta * (1 - b2), theta * (1 - theta), b2 * (1 - b2), b3 * (1 - b3)
    return [
        (1.0, [none4, np.eye(4), R1, Bbar, R4C]),
        (Theta, [none4, none4, R2D1, R3I1D, R5I3C]),
        (theta_ - Theta, [none4, none4, R2D1, R3I1D, none3]),
        (b3_, [none4, none4, R2D2, R3I2D, none3]),
        (b2_ - Theta, [none4, none4, none2, none1, R5I3C]),
    ]


def supply(i, P, l1, l2, g, a=A):
    MM = np.zeros((4, 4))
    MM[2:, 2:] = M.T @ M
    top = (l1 * a**2 + l2 * b[i] ** 2) * np.eye(4) + MM - P
    result = np.zeros((14, 14))
    result[:4, :4] = top
    result[4:, 4:] = -np.diag([l1] * 4 + [l2] * 2 + [g**2] * 4)
    return result


def Phi(i, K, P, P_next, l1, l2, g, beta=beta):
    """Theorem 1, (18)."""
    result = supply(i, P, l1, l2, g)
    for w, parts in blocks(i, K, beta):
        G = np.concatenate(parts, axis=1)
        result += w * G.T @ P_next @ G
    return result


def Phi_by_enumeration(i, K, P, P_next, l1, l2, g, beta=beta):
    """The same from the eight outcomes of the dropouts, with (8) written out for each."""
    b1, b2, b3 = beta
    d1bar = np.array([[b1 * b2], [b3]])
    result = supply(i, P, l1, l2, g)
    for o1, o2, o3 in product([0, 1], repeat=3):
        p = np.prod([q if o else 1 - q for q, o in zip(beta, (o1, o2, o3), strict=True)])
        d1, d2 = np.array([[o1 * o2], [o3]]), np.diag([o2, 1.0, 1.0])
        G = np.zeros((4, 14))
        G[:2, 4:6] = G[2:, 6:8] = np.eye(2)
        G[:2, 10:11] = B
        G[2:, 10:11] = B - K @ E1 @ d1 * D[i]
        G[2:, 8:9] = -K @ E1 @ (d1 - d1bar)
        G[2:, 9:10] = -K @ E1 @ d1bar
        G[2:, 11:] = -K @ E2 @ d2 @ C
        result += p * G.T @ P_next @ G
    return result


def inequality_32(i, K, P, L_next, l1, l2, g, beta=beta):
    """Theorem 2's 34 x 34 matrix, with the roots of the weights off the diagonal, so that none is divided by."""
    parts = blocks(i, K, beta)
    rows = [np.sqrt(w) * np.concatenate(G, axis=1) for w, G in parts]
    result = np.zeros((34, 34))
    result[:14, :14] = supply(i, P, l1, l2, g)
    for j, row in enumerate(rows):
        at = slice(14 + 4 * j, 18 + 4 * j)
        result[at, :14], result[:14, at], result[at, at] = row, row.T, -L_next
    return result
