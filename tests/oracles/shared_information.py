"""Joint errors of local filters by brute force: every error as a linear map of all random sources, stacked."""

import numpy as np


def stacked_errors(plant, nodes, steps, starts=None):
    """E x, Cov x, E e, Cov of (x, e_1, ..., e_N) and the central filter's covariance, after `steps` steps.

    plant: (A, Q, mean, P0). nodes: (H, S(second), gains) of each: M_i = E[G] C, a function of E[x x'] that gives the
    covariance of z - M x, and the filter's gains K over time. All errors are kept as one big covariance.
    """
    a, q, mean, p0 = plant
    n, count = len(a), len(nodes)
    size = (1 + count) * n
    joint = np.kron(np.ones((1 + count, 1 + count)), p0)
    central = p0
    for k in range(steps):
        move = np.kron(np.eye(1 + count), a)
        joint = move @ joint @ move.T + np.kron(np.ones((1 + count, 1 + count)), q)
        mean = a @ mean
        second = joint[:n, :n] + np.outer(mean, mean)
        use, noise = np.eye(size), np.zeros((size, size))
        spreads = []
        for i, (h, spread, gains) in enumerate(nodes):
            rows = slice((1 + i) * n, (2 + i) * n)
            use[rows, rows] -= gains[k] @ h
            spreads.append(spread(second))
            noise[rows, rows] = gains[k] @ spreads[-1] @ gains[k].T
        joint = use @ joint @ use.T + noise
        received = np.concatenate([h for h, _, _ in nodes])
        total = np.zeros((len(received), len(received)))
        start = 0
        for spread in spreads:
            total[start : start + len(spread), start : start + len(spread)] = spread
            start += len(spread)
        before = a @ central @ a.T + q
        central = before - before @ received.T @ np.linalg.solve(
            received @ before @ received.T + total, received @ before
        )
    return joint, central


def local_gains(plant, h, spread, steps):
    """The gains of the best linear filter of one node."""
    a, q, mean, p = plant
    second, gains = p, []
    for _ in range(steps):
        second, p, mean = a @ second @ a.T + q, a @ p @ a.T + q, a @ mean
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + spread(second + np.outer(mean, mean)))
        gains.append(gain)
        p = p - gain @ h @ p
    return gains
