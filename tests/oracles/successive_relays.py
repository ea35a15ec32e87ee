"""Filter-and-forward successive relays: the printed recursion, corrected, in NumPy and the paper's notation.

Source: Tan, Shen, Li, Liu, IEEE/CAA J. Autom. Sinica 11(5), 2024, Lemmas 1 to 7, Theorems 1 and 2.
Corrections: Lemma 1 uses W, not V; (30) and the proof of Theorem 1 use Xi_ij, as in (29); Lemma 7 multiplies
P_i + P_i' by the squared mean, as in (28); (24) uses deltabar_i + deltabar_j and Xi_ij'; Algorithm 1 computes
the gains first.

Even k: relay 1 (index 0) receives and relay 2 transmits; odd k: the other way round. Channels gamma_1 ..
gamma_5 are indices 0 .. 4. Gam, Sigma, W at index k - 1 lead from x_{k-1} to x_k; everything else at index k
acts at step k, and its entry 0 is never used.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm

Array = NDArray[np.float64]


class Problem(NamedTuple):
    Gam: Array  # (N, n, n)
    Sigma: Array  # (N, n, p)
    W: Array  # (N, p, p)
    Psi: Array  # (N + 1, m, n)
    Theta: Array  # (N + 1, m, q)
    V: Array  # (N + 1, q, q)
    G: Array  # (N + 1, 2, m, m)
    O: Array  # (N + 1, 2, m, m)
    mean: Array  # (N + 1, 5), E gamma
    var: Array  # (N + 1, 5), E (gamma - E gamma)^2
    xbar0: Array  # (n,)
    P0: Array  # (n, n)


class Solution(NamedTuple):
    K: Array  # (N + 1, n, m), gain of the relay that receives at k; entry 0 is zero
    L: Array  # (N + 1, n, m)
    Pi: Array  # (N + 1, n, n)
    Xi: Array  # (N + 1, 2, n, n)
    Xi_12: Array  # (N + 1, n, n)
    Xi_x: Array  # (N + 1, 2, n, n), E x e_i'
    P_i: Array  # (N + 1, 2, n, n), E e e_i'
    P: Array  # (N + 1, n, n)
    M_K: Array  # (N + 1, m, m), innovation moment of the receiving relay
    M_L: Array  # (N + 1, m, m), innovation moment of the remote filter


def turns(k: int) -> tuple[int, int]:
    """The relay that receives and the relay that transmits at step k, equation (7)."""
    return (0, 1) if k % 2 == 0 else (1, 0)


def solve(p: Problem, gains: tuple[Array, Array] | None = None) -> Solution:
    """Gains of Theorems 1 and 2, or the given (K, L), and every covariance at k = 0 .. N."""
    N, n, m = p.Gam.shape[0], p.Gam.shape[1], p.Psi.shape[1]
    K, L = np.zeros((N + 1, n, m)), np.zeros((N + 1, n, m))
    M_K, M_L = np.zeros((N + 1, m, m)), np.zeros((N + 1, m, m))
    Pi, P, C = (np.zeros((N + 1, n, n)) for _ in range(3))  # C = Xi_12
    X, Xx, Pm = (np.zeros((N + 1, 2, n, n)) for _ in range(3))  # Xi_i, Xi_xi, P_i
    Pi[0], P[0], C[0] = p.P0 + np.outer(p.xbar0, p.xbar0), p.P0, p.P0
    X[0] = Xx[0] = Pm[0] = p.P0
    for k in range(1, N + 1):
        i, j = turns(k)
        Gam, Psi, Q = p.Gam[k - 1], p.Psi[k], p.Sigma[k - 1] @ p.W[k - 1] @ p.Sigma[k - 1].T
        R = p.Theta[k] @ p.V[k] @ p.Theta[k].T
        m_i, m_3, d = p.mean[k, i], p.mean[k, 2], p.mean[k, 3 + j]
        v_i, v_3, v_d = p.var[k, i], p.var[k, 2], p.var[k, 3 + j]
        X_i, X_j, Xx_i, Xx_j, P_i, P_j = (a[k - 1, r] for a in (X, Xx, Pm) for r in (i, j))
        C_ij = C[k - 1] if i == 0 else C[k - 1].T
        Gb = m_i * Psi @ Gam + m_3 * Psi

        # aleph, below (14), and the relay gain (29)
        al = (v_i + m_i**2) * (Psi @ Q @ Psi.T + R) + p.G[k, i]
        al += Psi @ (v_3 * Pi[k - 1] + v_i * Gam @ Pi[k - 1] @ Gam.T + (v_3 + m_3**2) * X_j) @ Psi.T
        al -= twice(m_3 * Gb @ C_ij @ Psi.T) + v_3 * Psi @ twice(Xx_j) @ Psi.T
        M_K[k] = Gb @ X_i @ Gb.T + al
        cross = Gam @ (X_i @ Gb.T - m_3 * C_ij @ Psi.T) + m_i * Q @ Psi.T
        K[k] = cross @ np.linalg.inv(M_K[k]) if gains is None else gains[0][k]

        # R, below (26), and the remote gain (31)
        Re = v_d * Pi[k - 1] - d**2 * twice(P_j) + (v_d + d**2) * X_j - v_d * twice(Xx_j)
        M_L[k] = d**2 * Psi @ P[k - 1] @ Psi.T + Psi @ Re @ Psi.T + p.O[k, j]
        L[k] = d * Gam @ (P[k - 1] - P_j) @ Psi.T @ np.linalg.inv(M_L[k]) if gains is None else gains[1][k]

        A, B = Gam - K[k] @ Gb, Gam - d * L[k] @ Psi
        KP, LP = K[k] @ Psi, L[k] @ Psi
        Pi[k] = Gam @ Pi[k - 1] @ Gam.T + Q  # (13)
        X[k, i] = A @ X_i @ A.T + twice(m_3 * Gam @ C_ij @ KP.T - m_i * KP @ Q) + Q + K[k] @ al @ K[k].T  # (14)
        X[k, j] = Gam @ X_j @ Gam.T + Q
        C_next = A @ C_ij @ Gam.T + m_3 * KP @ X_j @ Gam.T - m_i * KP @ Q + Q  # (18)
        C[k] = C_next if i == 0 else C_next.T
        Xx[k, i] = Gam @ Xx_i @ A.T + m_3 * Gam @ Xx_j @ KP.T - m_i * Q @ KP.T + Q  # (21)
        Xx[k, j] = Gam @ Xx_j @ Gam.T + Q
        Pm[k, i] = B @ P_i @ A.T + m_3 * B @ P_j @ KP.T + m_3 * d * LP @ X_j @ KP.T  # (24)
        Pm[k, i] += Q @ (np.eye(n) - m_i * KP.T) + d * LP @ C_ij.T @ A.T
        Pm[k, j] = B @ P_j @ Gam.T + Q + d * LP @ X_j @ Gam.T
        P[k] = B @ P[k - 1] @ B.T + LP @ Re @ LP.T + twice(d * Gam @ P_j @ LP.T) + Q + L[k] @ p.O[k, j] @ L[k].T  # (26)
    return Solution(K, L, Pi, X, C, Xx, Pm, P, M_K, M_L)


def twice(a: Array) -> Array:
    """a + a'."""
    return a + a.T


def step(
    p: Problem, K: Array, L: Array, k: int, state: tuple[Array, ...], noise: tuple[Array, ...], gamma: Array
) -> tuple[Array, ...]:
    """Equations (1), (3), (4), (6), (9) as they run, from (x, theta_1, theta_2, xhat) at k - 1 to k.

    noise = (w, v, xi, tau); vectors are rows of (runs, .) arrays, gamma is (runs, 5).
    """
    i, j = turns(k)
    x, th, xh, (w, v, xi, tau) = state[0], state[1:3], state[3], noise
    Gam, Psi, g = p.Gam[k - 1], p.Psi[k], gamma[..., None]
    x_next = x @ Gam.T + w @ p.Sigma[k - 1].T
    y = x_next @ Psi.T + v @ p.Theta[k].T
    y_i = g[:, i] * y + g[:, 2] * (th[j] @ Psi.T) + xi
    z = g[:, 3 + j] * (th[j] @ Psi.T) + tau
    th_next = [t @ Gam.T for t in th]
    th_next[i] = th_next[i] + (y_i - p.mean[k, i] * th_next[i] @ Psi.T - p.mean[k, 2] * th[i] @ Psi.T) @ K[k].T
    xh_next = xh @ Gam.T + (z - p.mean[k, 3 + j] * xh @ Psi.T) @ L[k].T
    return x_next, th_next[0], th_next[1], xh_next


def noise_covariances(p: Problem, k: int) -> tuple[Array, ...]:
    """Covariances of (w, v, xi, tau) at step k."""
    i, j = turns(k)
    return p.W[k - 1], p.V[k], p.G[k, i], p.O[k, j]


def augmented_moments(p: Problem, K: Array, L: Array) -> Array:
    """E eta eta' at k = 0 .. N, eta = (x, theta_1, theta_2, xhat), (N + 1, 4n, 4n), by brute force.

    The step is eta+ = sum_c g_c F_c (eta, noise) with matrices F read off `step` itself, column by column.
    """
    n = p.Gam.shape[1]
    start = np.kron(np.ones((4, 4)), np.outer(p.xbar0, p.xbar0))
    start[:n, :n] += p.P0
    moments = [start]
    for k in range(1, p.Gam.shape[0] + 1):
        covariances = noise_covariances(p, k)
        sizes = [n] * 4 + [len(c) for c in covariances]
        columns = np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1], axis=1)

        F, *others = (
            np.hstack(step(p, K, L, k, tuple(columns[:4]), tuple(columns[4:]), np.tile(gamma, (sum(sizes), 1)))).T
            for gamma in (p.mean[k], *(p.mean[k] + np.eye(5)))
        )
        change = [other - F for other in others]
        S = block_diag(moments[-1], *covariances)
        moments.append(F @ S @ F.T + sum(v * D @ S @ D.T for v, D in zip(p.var[k], change, strict=True)))
    return np.array(moments)


def error_moments(eta: Array, n: int) -> Array:
    """The moments of (x, e_1, e_2, e) from those of (x, theta_1, theta_2, xhat)."""
    T = np.eye(4 * n)
    for block in range(1, 4):
        T[block * n : (block + 1) * n, :n] = np.eye(n)
        T[block * n : (block + 1) * n, block * n : (block + 1) * n] = -np.eye(n)
    return T @ eta @ T.T


def monte_carlo(p: Problem, K: Array, L: Array, runs: int, seed: int, two_point: bool = False) -> tuple[Array, Array]:
    """Sampled traces of (Xi_1, Xi_2, P) and their standard errors, each (N + 1, 3)."""
    rng, n = np.random.default_rng(seed), p.Gam.shape[1]
    start = np.tile(p.xbar0, (runs, 1))
    state: tuple[Array, ...] = (
        start + rng.standard_normal((runs, n)) @ np.linalg.cholesky(p.P0).T,
        start,
        start,
        start,
    )
    samples = []
    for k in range(p.Gam.shape[0] + 1):
        if k > 0:
            noise = tuple(
                rng.standard_normal((runs, len(c))) @ np.linalg.cholesky(c).T for c in noise_covariances(p, k)
            )
            unit = rng.choice([-1.0, 1.0], (runs, 5)) if two_point else rng.standard_normal((runs, 5))
            state = step(p, K, L, k, state, noise, p.mean[k] + np.sqrt(p.var[k]) * unit)
        squares = np.stack([((state[0] - s) ** 2).sum(1) for s in state[1:]], axis=1)
        samples.append((squares.mean(0), squares.std(0) / np.sqrt(runs)))
    means, errors = zip(*samples, strict=True)
    return np.array(means), np.array(errors)


def circuit(inductance: float = 5.0) -> Array:
    """Gamma = expm((A + B K) q); the printed 0.5 H does not give the printed matrix, 5 H does."""
    R_1, R_2, C_1, C_2, q = 4.0, 2.0, 1.2, 1.2, 0.6
    A = np.array(
        [
            [-1 / (R_2 * C_1), 1 / (R_2 * C_1), 0],
            [1 / (R_2 * C_2), -1 / (R_2 * C_2), -1 / C_2],
            [0, 1 / inductance, 0],
        ]
    )
    feedback = np.outer([1 / (R_1 * C_1), 0, 0], [-1.5, 1.638, 1.810])
    return np.asarray(expm((A + feedback) * q))


PRINTED_GAMMA = np.array([[0.6858, 0.3364, 0.0935], [0.1790, 0.7960, -0.4229], [0.0120, 0.1069, 0.9732]])


def constant(
    horizon: int,
    Gam: Array,
    Sigma: Array,
    W: Array,
    Psi: Array,
    Theta: Array,
    V: Array,
    G: Array,
    O: Array,
    mean: Array,
    var: Array,
    xbar0: Array,
    P0: Array,
) -> Problem:
    """A time-invariant problem repeated over the horizon."""

    def over(steps: int, a: Array) -> Array:
        return np.tile(a, (steps,) + (1,) * np.ndim(a))

    Gam, Sigma, W = (over(horizon, a) for a in (Gam, Sigma, W))
    Psi, Theta, V, G, O, mean, var = (over(horizon + 1, a) for a in (Psi, Theta, V, G, O, mean, var))
    return Problem(Gam, Sigma, W, Psi, Theta, V, G, O, mean, var, xbar0, P0)


def section_iv(horizon: int, Gam: Array = PRINTED_GAMMA) -> Problem:
    """The example of Section IV, with the printed Gamma (four decimals) unless given otherwise."""
    small = np.array([[4e-6]])
    return constant(
        horizon,
        Gam=Gam,
        Sigma=np.array([[0.6], [0.5], [0.3]]),
        W=small,
        Psi=np.array([[2.0, 1.8, 2.5]]),
        Theta=np.array([[0.6]]),
        V=small,
        G=np.stack([small, small]),
        O=np.stack([small, small]),
        mean=np.array([0.9, 0.92, 0.9, 0.9, 0.92]),
        var=np.full(5, 0.01),
        xbar0=np.array([0.3, 0.2, -0.2]),
        P0=np.diag([0.05, 0.02, 0.03]),
    )


def random_problem(seed: int, horizon: int = 30, n: int = 3, p: int = 2, m: int = 2, q: int = 3) -> Problem:
    """A time-varying problem of moderate numbers, every matrix full."""
    rng = np.random.default_rng(seed)

    def positive(count: tuple[int, ...], size: int) -> Array:
        a = rng.standard_normal((*count, size, size))
        return a @ np.swapaxes(a, -1, -2) + 0.1 * np.eye(size)

    N = horizon
    return Problem(
        rng.uniform(-1, 1, (N, n, n)) / np.sqrt(n),
        rng.standard_normal((N, n, p)),
        positive((N,), p),
        rng.standard_normal((N + 1, m, n)),
        rng.standard_normal((N + 1, m, q)),
        positive((N + 1,), q),
        positive((N + 1, 2), m),
        positive((N + 1, 2), m),
        rng.uniform(-1, 1, (N + 1, 5)),
        rng.uniform(0.05, 0.5, (N + 1, 5)),
        rng.standard_normal(n),
        positive((), n),
    )
