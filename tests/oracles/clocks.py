"""The error of those who take a wrong clock's stamps as true, exactly: given the clock all is linear."""

import numpy as np


def ignored(f, q, r, mean, covariance, dt, deviation, steps):
    """Mean square errors of position and speed and NEES / 2, of two sensors of the position, one with the clock.

    The fourth moments of offset and drift are those of five nodes each (Gauss and Hermite).
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(5)
    weights = weights / weights.sum()
    both, apart = np.array([[1.0, 0.0], [1.0, 0.0]]), np.array([[1.0, 0, -1, 0, 0], [0, 1, 0, -1, 0]])
    move = np.zeros((5, 5))
    move[:2, :2], move[2:4, 2:4], move[4, 4] = f, f, 1.0
    error, claimed = np.zeros((2, 2)), covariance
    for i, j in np.ndindex(5, 5):
        start = np.array([*mean, *mean, 1.0])
        joint, spread = np.outer(start, start), covariance
        joint[:2, :2] += covariance
        for k in range(1, steps + 1):
            spread = f @ spread @ f.T + q
            gain = spread @ both.T @ np.linalg.inv(both @ spread @ both.T + r * np.eye(2))
            spread = spread - gain @ both @ spread
            joint = move @ joint @ move.T
            joint[:2, :2] += q
            use = np.eye(5)
            late = deviation[0] * nodes[i] + deviation[1] * nodes[j] * k * dt
            use[2:4, :2] += gain @ np.array([[1.0, 0.0], [1.0, -late]])
            use[2:4, 2:4] -= gain @ both
            joint = use @ joint @ use.T
            joint[2:4, 2:4] += r * gain @ gain.T
        error, claimed = error + weights[i] * weights[j] * apart @ joint @ apart.T, spread
    return np.diag(error), np.trace(np.linalg.solve(claimed, error)) / 2
