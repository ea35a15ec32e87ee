"""Riccati steps by the textbook, and E P of a scalar plant under bursts of losses to many digits."""

import numpy as np
from numpy.polynomial import chebyshev


def riccati(a, c, q, r, p, arrived):
    """P+ = A P A' + Q, less A P C' (C P C' + R)^-1 C P A' where z arrived."""
    moved = a @ p @ a.T + q
    return moved - a @ p @ c.T @ np.linalg.solve(c @ p @ c.T + r, c @ p @ a.T) if arrived else moved


def mean_error(a, c, q, r, fail, recover, degree=40, longest=600):
    """E P of a scalar plant; arrivals fail with `fail` and losses end with `recover`, independently of all else.

    After an arrival P = x lies between q and a^2 r / c^2 + q; l losses make it g^l(x), g(x) = a^2 x + q. So
    E f(x) over arrivals is that of a map x -> h(g^l(x)) with l random, here on Chebyshev polynomials, and E P the mean
    of x + g(x) + ... + g^l(x) by that of l + 1.
    """
    losses = np.arange(longest)
    after = np.where(losses == 0, 1.0, fail * (1 - recover) ** (losses - 1.0))  # P(l >= losses)
    exactly = after - np.append(after[1:], 0.0)
    growth = (a * a) ** losses.astype(float)
    added = q * (growth - 1) / (a * a - 1)
    low, high = q, a * a * r / c**2 + q
    nodes = np.cos(np.pi * (np.arange(degree) + 0.5) / degree)
    x = low + (high - low) * (nodes + 1) / 2
    before = x[:, None] * growth + added
    next_x = a * a * before * r / (c * c * before + r) + q
    values = chebyshev.chebvander(2 * (next_x - low) / (high - low) - 1, degree - 1)
    to_next = np.linalg.solve(chebyshev.chebvander(nodes, degree - 1), np.einsum("l,xld->xd", exactly, values))
    for _ in range(8):  # to_next^256: the mean of any polynomial after long, in its constant coefficient
        to_next = to_next @ to_next
    mean_x = low + (high - low) * (to_next[0, 1] + 1) / 2
    return float((mean_x * after @ growth + after @ added) / after.sum())
