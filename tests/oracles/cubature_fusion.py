"""Oracle: cubature Kalman fusion filter under amplify-and-forward relays, in the notation of the paper.

Leading axes are free, the nodes last: x (..., n), P (..., n, n), C (..., m, n). The plant is in `relayed_machine`.
Source: Li, Wang, Hu, Dong, Liu, "Cubature Kalman Fusion Filtering Under Amplify-and-Forward Relays with
Randomly Varying Channel Parameters", (10)-(34), Algorithm 1; departures are stated in place.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np

from tests.oracles.relayed_machine import Array, Law, Setting, f, hessians, jacobian

Scalar = float | Array


class Terms(NamedTuple):
    """Of a bound: mu, V >= E(xi gamma - mu)^2, d >= |E xi gamma - mu|, M2 >= E(xi gamma)^2, X2 >= E xi^2."""

    mu: float
    V: float
    d: float
    M2: float
    X2: float


def amplitude(s: Setting) -> float:
    """c = alpha sqrt(El Er)."""
    return float(s["alpha"] * np.sqrt(s["El"] * s["Er"]))


def nominal_and_radii(law: Law) -> tuple[float, float, float, float]:
    """First and second nominal moments and the radii of (11), (18)."""
    v, p, r = law
    return float(v @ p), float(v**2 @ p), float(np.abs(v) @ r), float(v**2 @ r)


def box_terms(s: Setting, sign: int) -> Terms:
    """(11): Var xi = E xi^2 - (E xi)^2 <= xi2 + kappa2 - max(|xi1| - kappa1, 0)^2; sign 1 is the print."""
    x1, x2, kx1, kx2 = nominal_and_radii(s["xi"])
    g1, g2, kg1, kg2 = nominal_and_radii(s["gamma"])
    lows = [m - r if sign > 0 else max(abs(m) - r, 0) for m, r in ((x1, kx1), (g1, kg1))]
    vx, vg = x2 + kx2 + sign * lows[0] ** 2, g2 + kg2 + sign * lows[1] ** 2
    aV = vx * (g2 + kg2) + (abs(x1) + kx1) ** 2 * vg
    d = abs(x1) * kg1 + kx1 * abs(g1) + kx1 * kg1
    return Terms(x1 * g1, aV + d**2, d, (x2 + kx2) * (g2 + kg2), x2 + kx2)


printed_terms, tight_terms = partial(box_terms, sign=1), partial(box_terms, sign=-1)


def vertices(law: Law) -> Array:
    """Vertices of {q : |q - p| <= r, sum q = 1, 0 <= q <= 1}: all coordinates but one at an end."""
    lo, hi = np.maximum(law[1] - law[2], 0.0), np.minimum(law[1] + law[2], 1.0)
    n, results = len(lo), []
    for free in range(n):
        for ends in product(*[(lo[j], hi[j]) for j in range(n) if j != free]):
            q = np.insert(np.array(ends), free, 1.0 - sum(ends))
            if lo[free] - 1e-12 <= q[free] <= hi[free] + 1e-12:
                results.append(q)
    return np.unique(np.round(results, 14), axis=0)


def poly_terms(s: Setting) -> Terms:
    """Exact worst case over the probability polytopes: convex in either law, so at vertices."""
    mu = nominal_and_radii(s["xi"])[0] * nominal_and_radii(s["gamma"])[0]
    vx, vg = s["xi"][0], s["gamma"][0]
    worst = np.full(4, -np.inf)
    for q, p in product(vertices(s["xi"]), vertices(s["gamma"])):
        a1, a2, c1, c2 = vx @ q, vx**2 @ q, vg @ p, vg**2 @ p
        worst = np.maximum(worst, [a2 * c2 - 2 * mu * a1 * c1 + mu**2, abs(a1 * c1 - mu), a2 * c2, a2])
    return Terms(float(mu), *map(float, worst))


def cubature_points(x: Array, P: Array) -> Array:
    """x +- sqrt(n) S e_j with S the lower Cholesky factor of P; shape (..., 2n, n)."""
    S = float(np.sqrt(x.shape[-1])) * np.linalg.cholesky(P).mT
    return np.asarray(x[..., None, :] + np.concatenate([S, -S], -2))


def predict_cubature(x: Array, Xi: Array, s: Setting) -> tuple[Array, Array]:
    """Algorithm 1, Steps 2-3."""
    chi = f(cubature_points(x, Xi), s)
    m = chi.mean(-2)
    D = chi - m[..., None, :]
    return m, D.mT @ D / D.shape[-2] + s["R"]


def predict_extended(x: Array, Xi: Array, s: Setting) -> tuple[Array, Array]:
    """f(x), J Xi J' + R: the linearised prediction."""
    J = jacobian(x, s)
    return f(x, s), J @ Xi @ J.mT + s["R"]


def predict_exact(x: Array, Xi: Array, s: Setting) -> tuple[Array, Array]:
    """Gaussian moments of the quadratic f: f + 1/2 tr(H_i Xi), J Xi J' + 1/2 tr(H_i Xi H_j Xi) + R."""
    H, (m, P) = hessians(s), predict_extended(x, Xi, s)
    HX = np.einsum("iab,...bc->...iac", H, Xi)
    return m + 0.5 * np.einsum("...iaa->...i", HX), P + 0.5 * np.einsum("...iab,...jba->...ij", HX, HX)


class Innovation(NamedTuple):
    """What an update sees: prior P, Y = E[yy'], Pyy and Pxy of the innovation."""

    P: Array
    Y: Array
    Pyy: Array
    Pxy: Array


def measure(x: Array, P: Array, C: Array, s: Setting) -> tuple[Array, Innovation]:
    """yhat and moments, all from points redrawn at (x, P); printed Pxy mixes in the propagated ones."""
    chi = cubature_points(x, P)
    y = chi @ C.mT
    yhat = y.mean(-2)
    D, E = chi - x[..., None, :], y - yhat[..., None, :]
    Pyy = E.mT @ E / E.shape[-2] + s["Q"]
    return yhat, Innovation(P, Pyy + yhat[..., :, None] * yhat[..., None, :], Pyy, D.mT @ E / E.shape[-2])


def _tr(A: Array) -> Array:
    return np.asarray(np.trace(A, axis1=-2, axis2=-1))


def _correct(x: Array, K: Array, ybar: Array, yhat: Array, gain: Scalar) -> Array:
    return np.asarray(x + np.einsum("...ij,...j->...i", K, ybar - gain * yhat))


def relay_noise(X2: Scalar, s: Setting) -> Array:
    """Covariance of alpha sqrt(Er) xi m + n with E xi^2 = X2."""
    return np.asarray(s["alpha"] ** 2 * s["Er"] * X2 * s["Qm"] + s["Qn"])


def omega(v: Innovation, b1: Scalar, b2: Scalar, t: Terms, s: Setting) -> Array:
    """(30), with Y in the terms of the law and Pyy in the (1 + beta2) term."""
    b1, b2 = np.asarray(b1)[..., None, None], np.asarray(b2)[..., None, None]
    cross = t.d**2 * (1 / b1 + 1 / b2) if t.d > 0 else 0.0
    law = (t.V + cross) * v.Y + (1 + b2) * t.mu**2 * v.Pyy
    return np.asarray(amplitude(s) ** 2 * law + relay_noise(t.X2, s))


def theorem2(v: Innovation, b1: Scalar, b2: Scalar, t: Terms, s: Setting) -> tuple[Array, Array]:
    """Gain (29) and minimum bound (31)."""
    g = amplitude(s) * t.mu
    K = g * v.Pxy @ np.linalg.inv(omega(v, b1, b2, t, s))
    return K, (1 + np.asarray(b1)[..., None, None]) * v.P - g * K @ v.Pxy.mT


def theorem1(K: Array, v: Innovation, b1: Scalar, b2: Scalar, t: Terms, s: Setting) -> Array:
    """Bound (10) at any gain K."""
    A = amplitude(s) * t.mu * v.Pxy @ K.mT
    return (1 + np.asarray(b1)[..., None, None]) * v.P + K @ omega(v, b1, b2, t, s) @ K.mT - A - A.mT


def optimal_betas(v: Innovation, t: Terms, s: Setting) -> tuple[Array, Array]:
    """argmin tr Xi over (beta1, beta2) > 0: alternate Theorem 2 and its minimisers (jointly convex)."""
    b = np.ones((2, *v.P.shape[:-2]))
    for _ in range(500 if t.d > 0 else 0):
        K, old = theorem2(v, b[0], b[1], t, s)[0], b
        y = t.d * np.sqrt(_tr(K @ v.Y @ K.mT))
        b = np.stack([amplitude(s) * y / np.sqrt(_tr(v.P)), y / (abs(t.mu) * np.sqrt(_tr(K @ v.Pyy @ K.mT)))])
        if np.max(np.abs(b / old - 1)) < 1e-10:
            break
    return (b[0], b[1]) if t.d > 0 else (0 * b[0], 0 * b[1])


Update = Callable[[Array, Array, Array, Array, Setting], tuple[Array, Array]]  # x, P, C, ybar -> xhat, Xi


def bounded(terms: Terms, optimise: bool) -> Update:
    """Theorem 2 update with the given terms; beta of the setting, or optimal for each run, node and step."""

    def update(x: Array, P: Array, C: Array, ybar: Array, s: Setting) -> tuple[Array, Array]:
        yhat, v = measure(x, P, C, s)
        b1, b2 = optimal_betas(v, terms, s) if optimise else s["beta"]
        K, Xi = theorem2(v, b1, b2, terms, s)
        return _correct(x, K, ybar, yhat, amplitude(s) * terms.mu), Xi

    return update


def orthogonal_step(v: Innovation, b: Scalar, t: Terms, s: Setting) -> tuple[Array, Array]:
    """K, Xi if E[e yhat'] = 0: Omega = c^2 ((M2 + d^2/b) Pyy + V yhat yhat') + noise."""
    c, b = amplitude(s), np.asarray(b)[..., None, None]
    W = (t.M2 + (t.d**2 / b if t.d > 0 else 0.0)) * v.Pyy + t.V * (v.Y - v.Pyy)
    K = c * t.mu * v.Pxy @ np.linalg.inv(c**2 * W + relay_noise(t.X2, s))
    return K, v.P + b * v.Pxy @ np.linalg.inv(v.Pyy) @ v.Pxy.mT - c * t.mu * K @ v.Pxy.mT


def optimal_beta(v: Innovation, t: Terms, s: Setting) -> Array:
    """argmin tr Xi of the orthogonal bound: iterate b = c d sqrt(tr K Pyy K' / tr Pxy Pyy^-1 Pxy')."""
    G = _tr(v.Pxy @ np.linalg.inv(v.Pyy) @ v.Pxy.mT)
    b = np.ones(v.P.shape[:-2])
    for _ in range(500 if t.d > 0 else 0):
        K, old = orthogonal_step(v, b, t, s)[0], b
        b = amplitude(s) * t.d * np.sqrt(_tr(K @ v.Pyy @ K.mT) / G)
        if np.max(np.abs(b / old - 1)) < 1e-10:
            break
    return b if t.d > 0 else 0 * b


def orthogonal(terms: Terms) -> Update:
    """The bound that uses E[e yhat'] = 0, with its one scalar optimal for each run, node and step."""

    def update(x: Array, P: Array, C: Array, ybar: Array, s: Setting) -> tuple[Array, Array]:
        yhat, v = measure(x, P, C, s)
        K, Xi = orthogonal_step(v, optimal_beta(v, terms, s), terms, s)
        return _correct(x, K, ybar, yhat, amplitude(s) * terms.mu), Xi

    return update


def known_gains(xi: Array, gamma: Array) -> Update:
    """Textbook update when xi and gamma (...) are known: the genie."""

    def update(x: Array, P: Array, C: Array, ybar: Array, s: Setting) -> tuple[Array, Array]:
        yhat, v = measure(x, P, C, s)
        g, xi2 = (amplitude(s) * xi * gamma)[..., None, None], xi[..., None, None] ** 2
        K = g * v.Pxy @ np.linalg.inv(g**2 * v.Pyy + relay_noise(xi2, s))
        return _correct(x, K, ybar, yhat, g[..., 0]), P - g * K @ v.Pxy.mT

    return update


def naive(x: Array, P: Array, C: Array, ybar: Array, s: Setting) -> tuple[Array, Array]:
    """Textbook update that takes the mean gains for the true ones."""
    mean = [np.asarray(nominal_and_radii(s[k])[0]) for k in ("xi", "gamma")]
    return known_gains(*mean)(x, P, C, ybar, s)


def open_loop(x: Array, P: Array, C: Array, ybar: Array, s: Setting) -> tuple[Array, Array]:
    """K = 0."""
    return x, P


def central(x: Array, P: Array, ybar: Array, update: Update, s: Setting) -> tuple[Array, Array]:
    """Sequential central update: the posterior of node i is the prior of node i + 1; ybar (..., M, m)."""
    for i in range(ybar.shape[-2]):
        x, P = update(x, P, s["C"][i], ybar[..., i, :], s)
    return x, P
