"""The best linear estimate behind links that remember, from all paths of the modes: no filter, no recursion of moments.

Given a path of modes, the measurements' first and second moments are those of independent maps; weighed by the path's
probability they are the moments over all paths, and the estimate is a projection on (1, z_1, ..., z_k).
"""

from itertools import product

import numpy as np


def plant_moments(matrices, shifts, noises, mean, covariance):
    """E[x~_k x~_l'] of x+ = A x + b + w for k, l = 1, ..., T; x~ = (x, 1)."""
    n, steps = len(mean), len(matrices)
    factors = [
        np.block([[a, b[:, None]], [np.zeros((1, n)), np.ones((1, 1))]]) for a, b in zip(matrices, shifts, strict=True)
    ]
    start = np.append(mean, 1.0)
    now = np.outer(start, start) + np.pad(covariance, ((0, 1), (0, 1)))
    second = np.zeros((steps, steps, n + 1, n + 1))
    for k in range(steps):
        now = factors[k] @ now @ factors[k].T + np.pad(noises[k], ((0, 1), (0, 1)))
        later = now
        second[k, k] = now
        for m in range(k + 1, steps):
            later = factors[m] @ later
            second[m, k], second[k, m] = later, later.T
    return second


def sent_moments(second, sensors, sensor_noises):
    """E[y~_k y~_l'], E[x_k y~_l'], E[y~_k] of what the sensors send, y~ = (y, 1), whatever the path.

    Shapes: sensors (T, p + 1, n + 1), each [[C, v], [0, 1]].
    """
    steps, n, c = len(second), second.shape[-1] - 1, np.array(sensors)[: len(second)]
    yy = np.einsum("kpa,klab,lqb->klpq", c, second, c)
    for k in range(steps):
        yy[k, k] += np.pad(sensor_noises[k], ((0, 1), (0, 1)))
    return yy, np.einsum("klab,lqb->klaq", second[:, :, :n], c), np.einsum("kpa,kka->kp", c, second[..., -1])


def path_moments(sent, means, spreads):
    """E[z z'], E[x z'], E[z] over the steps for one path.

    Shapes: means (T, m, p + 1), spreads (T, m, m, p + 1, p + 1).
    """
    (yy, xy, y1), means = sent, np.array(means)
    zz = np.einsum("kap,klpq,lbq->kalb", means, yy, means)
    for k, spread in enumerate(spreads):
        zz[k, :, k] += np.einsum("abij,ij->ab", spread, yy[k, k])
    return zz, np.einsum("klnq,laq->knla", xy, means), np.einsum("kap,kp->ka", means, y1)


def best_linear(second, zz, xz, z1):
    """Error covariance of x_k given (1, z_1, ..., z_k) for each k."""
    steps, n, m = len(second), second.shape[-1] - 1, z1.shape[1]
    result = []
    for k in range(steps):
        size = (k + 1) * m
        mean, x1 = z1[: k + 1].reshape(size), second[k, k][:n, -1]
        gram = zz[: k + 1, :, : k + 1].reshape(size, size) - np.outer(mean, mean)
        cross = xz[k][:, : k + 1].reshape(n, size) - np.outer(x1, mean)
        result.append(second[k, k][:n, :n] - np.outer(x1, x1) - cross @ np.linalg.solve(gram, cross.T))
    return np.array(result)


def by_all_paths(second, sensors, sensor_noises, initial, transitions, means, spreads):
    """Error covariances (T, n, n); transitions[k] leads from step k to k + 1, means[k][i] is mode i's at step k."""
    steps, total, sent = len(second), 0.0, sent_moments(second, sensors, sensor_noises)
    for path in product(range(len(initial)), repeat=steps):
        weight = initial[path[0]] * np.prod([transitions[k][path[k], path[k + 1]] for k in range(steps - 1)])
        if weight == 0:
            continue
        item = path_moments(
            sent, [means[k][i] for k, i in enumerate(path)], [spreads[k][i] for k, i in enumerate(path)]
        )
        total = (
            [weight * part for part in item]
            if isinstance(total, float)
            else [a + weight * b for a, b in zip(total, item, strict=True)]
        )
    return best_linear(second, *total)
