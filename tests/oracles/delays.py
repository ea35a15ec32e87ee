"""The best linear estimate behind late links, from the moments of all that was sent: no filter, no augmented state.

z_k = g_k y_{k-d_k} + n_k, y = C x + v, and y_j = 0 for j < 1; x_0 at index 0, so that y_j and z_j have index j.
"""

import numpy as np


def signals(a, q, c, r, mean, covariance, steps):
    """Means and covariances of all x_k and y_k: mean (T, n), (T, m), and Cov(x, x), Cov(x, y), Cov(y, y) by step."""
    n, m = len(mean), len(c)
    xx, means, now = np.zeros((steps + 1, n, steps + 1, n)), [np.asarray(mean, dtype=float)], covariance
    for k in range(steps + 1):
        if k:
            now, means = a @ now @ a.T + q, [*means, a @ means[-1]]
        later = now
        for j in range(k, steps + 1):
            xx[j, :, k], xx[k, :, j] = later, later.T
            later = a @ later
    xy = np.einsum("kalb,mb->kalm", xx, c)
    yy = np.einsum("ma,kalb->kmlb", c, xy)
    yy[np.arange(steps + 1), :, np.arange(steps + 1), :] += r
    y = np.array(means) @ c.T
    y[0], xy[:, :, 0], yy[0], yy[:, :, 0] = np.zeros(m), 0.0, 0.0, 0.0
    return np.array(means), y, xx, xy, yy


def of_unknown(parts, pair, first, second, noise):
    """E z, Cov(x, z), Cov(z, z) for z_1, ..., z_T; `pair(k, j)` is P(d_k, d_j), `first`, `second` are E g, E g^2."""
    _, y, _, xy, yy = parts
    steps, m = len(y) - 1, y.shape[1]
    raw = yy + np.einsum("ka,lb->kalb", y, y)
    z, zz = np.zeros((steps + 1, m)), np.zeros_like(yy)
    xz = np.zeros_like(xy)
    for k in range(1, steps + 1):
        for j in range(1, steps + 1):
            law = pair(k, j)
            for d, e in np.argwhere(law > 0):
                source, other = max(k - d, 0), max(j - e, 0)
                zz[k, :, j] += law[d, e] * (second if k == j else first**2) * raw[source, :, other]
        zz[k, :, k] += noise
        for d, p in enumerate(pair(k, k).sum(axis=1)):
            z[k] += first * p * y[max(k - d, 0)]
            xz[:, :, k] += first * p * xy[:, :, max(k - d, 0)]
    return z, xz, zz - np.einsum("ka,lb->kalb", z, z)


def of_known(parts, delays, first, second, noise):
    """The same for known delays d_1, ..., d_T: what is received twice is one y, with two noises."""
    law = max(delays) + 1

    def pair(k, j):
        both = np.zeros((law, law))
        both[delays[k - 1], delays[j - 1]] = 1.0
        return both

    return of_unknown(parts, pair, first, second, noise)


def best_linear(parts, received, k):
    """Error covariance of x_k from (1, z_1, ..., z_k)."""
    _, _, xx, _, _ = parts
    _, xz, zz = received
    n, m = xx.shape[1], zz.shape[1]
    gram, cross = zz[1 : k + 1, :, 1 : k + 1].reshape(k * m, k * m), xz[k, :, 1 : k + 1].reshape(n, k * m)
    return xx[k, :, k] - cross @ np.linalg.solve(gram, cross.T)


def error_of(parts, received, weights, offset, k):
    """E[(x_k - xhat)(x_k - xhat)'] of xhat = sum_j weights[j] z_j + offset; weights (k, n, m)."""
    mean, _, xx, _, _ = parts
    z, xz, zz = received
    n, m = xx.shape[1], zz.shape[1]
    w = np.concatenate(list(weights), axis=1)
    gram, cross = zz[1 : k + 1, :, 1 : k + 1].reshape(k * m, k * m), xz[k, :, 1 : k + 1].reshape(n, k * m)
    bias = mean[k] - w @ z[1 : k + 1].ravel() - offset
    return xx[k, :, k] - cross @ w.T - w @ cross.T + w @ gram @ w.T + np.outer(bias, bias)


def kalman(a, q, c, r, mean, covariance, steps):
    """Weights (steps, n, m) and offset of the Kalman filter's last estimate, and what it claims."""
    weights, estimate, spread = [], np.asarray(mean, dtype=float), covariance
    for _ in range(steps):
        spread = a @ spread @ a.T + q
        gain = spread @ c.T @ np.linalg.inv(c @ spread @ c.T + r)
        keep = np.eye(len(a)) - gain @ c
        spread = keep @ spread
        weights, estimate = [*(keep @ a @ w for w in weights), gain], keep @ a @ estimate
    return np.array(weights), estimate, spread
