"""Both forms of the likelihood of a scalar or vector state behind one stacked channel, as recursions in NumPy."""

import numpy as np


def likelihood(model, z, u, form):
    """sum_k -(log det 2 pi S + e' S^-1 e) / 2 over what arrived.

    model: a, b, q (plant), c, r, v (sensor), m, offset (mean of the channel), spread: W (y, 1) -> Cov(z | y), mean and
    covariance of the start. W is E[(y, 1)(y, 1)'] of the state's own moments (linear) or of what is known
    (conditional).
    """
    a, b, q, c, r, v, m, offset, spread, x, p = model
    local_x, local_p, total = x, p, 0.0
    for z_k, u_k in zip(z, u, strict=True):
        x, p = a @ x + b @ u_k, a @ p @ a.T + q
        local_x, local_p = a @ local_x + b @ u_k, a @ local_p @ a.T + q
        of_x, of_p = (local_x, local_p) if form == "linear" else (x, p)
        y = np.append(c @ of_x + v, 1.0)
        w = np.outer(y, y)
        w[:-1, :-1] += c @ of_p @ c.T + r
        there = ~np.isnan(z_k)
        if not there.any():
            continue
        s = (m @ (c @ p @ c.T + r) @ m.T + spread(w))[np.ix_(there, there)]
        e = (z_k - m @ (c @ x + v) - offset)[there]
        gain = (p @ c.T @ m.T)[:, there] @ np.linalg.inv(s)
        total -= (np.linalg.slogdet(2 * np.pi * s)[1] + e @ np.linalg.solve(s, e)) / 2
        x, p = x + gain @ e, p - gain @ s @ gain.T
    return total
