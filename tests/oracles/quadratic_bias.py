"""Quadratic filter for a biased plant over an amplify-and-forward relay, in the paper's own notation.

Everything is the full Kronecker form of Wang, Wang, Liu, Dong and Liu, "Quadratic filtering for linear
stochastic systems with dynamical bias under amplify-and-forward relays: dealing with non-Gaussian noises",
with Lemma 4 corrected.  S_r of the paper is the matrix I + K_rr.  Every noise is a finite list of atoms, so
each moment is exact.  The filter starts from the mean of X_0; the first measurement used is z_1, as in (14).
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Atoms(NamedTuple):
    """A law of finite support: points (N, r) and their probabilities (N,)."""

    points: Array
    chance: Array

    def moments(self) -> tuple[Array, Array, Array]:
        """E uu', E u(u(x)u)', E (u(x)u)(u(x)u)'."""
        u, p = self.points, self.chance
        u2 = (u[:, :, None] * u[:, None, :]).reshape(len(u), -1)
        return (u.T * p) @ u, (u.T * p) @ u2, (u2.T * p) @ u2

    def power(self, k: int) -> float:
        """E u^{k/2} of a scalar power, (8)."""
        return float(self.chance @ self.points[:, 0] ** (k / 2))


def two_point(a: float, b: float, chance_of_a: float) -> Atoms:
    return Atoms(np.array([[a], [b]]), np.array([chance_of_a, 1 - chance_of_a]))


def independent(*laws: Atoms) -> Atoms:
    """The joint law of independent vectors, stacked."""
    picks = list(product(*(range(len(law.chance)) for law in laws)))
    points = [np.concatenate([law.points[i] for law, i in zip(laws, pick, strict=True)]) for pick in picks]
    chance = [float(np.prod([law.chance[i] for law, i in zip(laws, pick, strict=True)])) for pick in picks]
    return Atoms(np.array(points), np.array(chance))


def gaussian_like(variance: float) -> Atoms:
    """Three points with the moments of N(0, variance) up to order 5: all that order 2 reads."""
    r = np.sqrt(3 * variance)
    return Atoms(np.array([[-r], [0.0], [r]]), np.array([1 / 6, 2 / 3, 1 / 6]))


@dataclass(frozen=True)
class System:
    """(1)-(7); the letters are the paper's."""

    A: Callable[[int], Array]
    E: Callable[[int], Array]
    B: Array
    F: Array
    C: Array
    D: Array
    Phi: Array
    Psi: Array
    theta: float
    l: Atoms
    m: Atoms
    x0: Atoms
    eps0: Atoms
    w: Atoms
    xi: Atoms
    v: Atoms
    varpi: Atoms
    sigma: Atoms


def paper_example() -> System:
    """Section 4; 'l_t = 1.2' in its list of powers is m_t = 1.2."""
    return System(
        A=lambda t: np.array([[0.6, 0.5], [-0.1 * np.sin(0.2 * t), 0.8]]),
        E=lambda t: np.array([[0.1, 0.0], [0.03 * np.cos(0.2 * t), 0.15]]),
        B=np.array([[0.05], [0.1]]), F=np.array([[0.1, 0.0], [0.1, 0.2]]),
        C=np.array([[0.2, 0.18]]), D=np.array([[0.01]]), Phi=np.eye(1), Psi=np.eye(1), theta=3.0,
        l=Atoms(np.array([[1.0], [1.5], [2.0]]), np.array([0.1, 0.3, 0.6])),
        m=Atoms(np.array([[1.0], [1.1], [1.2]]), np.array([0.2, 0.4, 0.4])),
        x0=independent(gaussian_like(0.01), gaussian_like(0.01)),
        eps0=independent(two_point(-0.8, 1.2, 0.6), two_point(-0.75, 0.25, 0.25)),
        w=two_point(-1.0, 1.0, 0.5),
        xi=independent(two_point(-1.5, 0.5, 0.25), two_point(-0.75, 0.5, 0.4)),
        v=two_point(0.7, -1.3, 0.65), varpi=two_point(-1.8, 0.2, 0.1), sigma=two_point(-0.7, 0.3, 0.3),
    )  # fmt: skip


TABLE_1 = {  # E (.)^2, E (.)^3, E (.)^4, as printed
    "w": (1.0, 0.0, 1.0), "v": (0.9100, -0.5460, 1.1557),
    "eps1": (0.9600, 0.3840, 1.0752), "eps2": (0.1875, -0.0938, 0.0820),
    "xi1": (0.7500, -0.7500, 1.3125), "xi2": (0.3750, -0.0938, 0.1641),
    "varpi": (0.3600, -0.5760, 1.0512), "sigma": (0.2100, -0.0840, 0.0777),
}  # fmt: skip


def S(r: int) -> Array:
    """I + K_rr: the matrix with S_r (u (x) v) = u (x) v + v (x) u."""
    K = np.eye(r * r).reshape(r, r, r, r).transpose(1, 0, 2, 3).reshape(r * r, r * r)
    return np.asarray(np.eye(r * r) + K)


def Sym(M: Array) -> Array:
    return M + M.T


def vec(M: Array) -> Array:
    return M.reshape(-1)


class Lifted(NamedTuple):
    """(13) at one time t, for the measurement as printed and as repaired."""

    A: Array
    M: Array
    R_W: Array
    C: Array
    N: Array
    R_V: Array
    C_c: Array
    N_c: Array
    R_Vc: Array


def augmented(system: System, t: int) -> tuple[Array, Array, Atoms]:
    """(10): A and B of X = [x; eps], and the law of W = [w; xi]."""
    A, E, F, B = system.A(t), system.E(t), system.F, system.B
    n, n_eps = E.shape
    Av = np.block([[A, E], [np.zeros((n_eps, n)), F]])
    Bv = np.block([[B, np.zeros((n, n_eps))], [np.zeros((n_eps, B.shape[1])), np.eye(n_eps)]])
    return Av, Bv, independent(system.w, system.xi)


def process_noise(system: System, t: int, Sigma: Array) -> tuple[Array, Array, Array]:
    """A_t, M_t and R_W of (11), (13), (28): Sigma is E XX' at t."""
    Av, Bv, W = augmented(system, t)
    w2, w3, w4 = W.moments()
    Bv2, Av2, d = np.kron(Bv, Bv), np.kron(Av, Av), len(Av)
    R11 = Bv @ w2 @ Bv.T
    R12 = Bv @ w3 @ Bv2.T
    R22 = S(d) @ np.kron(Av @ Sigma @ Av.T, R11) @ S(d).T + Bv2 @ (w4 - np.outer(vec(w2), vec(w2))) @ Bv2.T
    A = np.block([[Av, np.zeros((d, d * d))], [np.zeros((d * d, d)), Av2]])
    return A, np.concatenate([np.zeros(d), Bv2 @ vec(w2)]), np.block([[R11, R12], [R12.T, R22]])


def chi(system: System) -> tuple[float, ...]:
    """mu, chi_1 .. chi_7 (as printed under (29), correct)."""
    l, m = [system.l.power(k) for k in range(5)], [system.m.power(k) for k in range(5)]
    mu = m[1] * l[1]
    return (
        mu,
        m[2] * l[2] - mu**2,
        m[3] * l[3] - 3 * mu * m[2] * l[2] + 2 * mu**3,
        m[4] * l[4] - 4 * mu * m[3] * l[3] + 6 * mu**2 * m[2] * l[2] - 3 * mu**4,
        m[4] * l[4] - 2 * mu * m[3] * l[3] + m[2] * l[2] * mu**2,
        m[4] * l[2] - 2 * mu * l[1] * m[3] + m[2] * mu**2,
        mu * (m[3] * l[3] - mu * m[2] * l[2]),
        mu * (m[3] * l[1] - mu * m[2]),
    )


def lemma_4(system: System, Upsilon: Array, H: Array) -> tuple[Array, ...]:
    """phi_v and R_V (corrected), then phi and R_V of the repair, where E[V | X] = 0."""
    th, (s, d) = system.theta, H.shape
    mu, c1, c2, c3, c4, c5, c6, c7 = chi(system)
    l, m = [system.l.power(k) for k in range(5)], [system.m.power(k) for k in range(5)]
    G, H2 = system.Psi @ system.Phi @ system.D, np.kron(H, H)
    G2, P2 = np.kron(G, G), np.kron(system.Psi, system.Psi)
    (v2, v3, v4), (o2, o3, o4), (Sg, s3, s4) = (u.moments() for u in (system.v, system.varpi, system.sigma))
    Hx, Gv, Po = H @ Upsilon[:d, :d] @ H.T, G @ v2 @ G.T, system.Psi @ o2 @ system.Psi.T
    q3, q4 = H @ Upsilon[:d, d:] @ H2.T, H2 @ Upsilon[d:, d:] @ H2.T
    g3, g4, o3, o4 = G @ v3 @ G2.T, G2 @ v4 @ G2.T, system.Psi @ o3 @ P2.T, P2 @ o4 @ P2.T
    hx, gv, po = vec(Hx), vec(Gv), vec(Po)

    local = th**2 * m[2] * l[2] * Gv + th**2 * m[2] * Po + Sg
    R11 = th**2 * c1 * Hx + local
    R12 = th**3 * (mu * c1 * q3 @ S(s).T + c2 * q3 + m[3] * l[3] * g3 + m[3] * o3) + s3
    phi = th**2 * c1 * hx + vec(local)
    pairs = (
        (th**4 * c4, Hx, Gv), (th**4 * c5, Hx, Po), (th**2 * c1, Hx, Sg),
        (th**4 * m[4] * l[2], Gv, Po), (th**2 * m[2] * l[2], Gv, Sg), (th**2 * m[2], Po, Sg),
    )  # fmt: skip
    Q = th**4 * (c3 * q4 + m[4] * l[4] * g4 + m[4] * o4) + s4
    for c, a, b in pairs:
        Q = Q + S(s) @ (c * np.kron(a, b)) @ S(s).T + Sym(c * np.outer(vec(a), vec(b)))
    cross = np.kron(Hx, c6 * Gv + c7 * Po) @ S(s).T
    T = th**4 * (mu * c2 * q4 + c6 * np.outer(hx, gv) + c7 * np.outer(hx, po) + cross)
    spread = th**4 * mu**2 * c1 * q4 + th**2 * mu**2 * np.kron(Hx, local)
    R22 = S(s) @ spread @ S(s).T + Q - np.outer(phi, phi) + Sym(S(s) @ T)

    R_V = np.block([[R11, R12], [R12.T, R22]])
    R_Vc = np.block([[R11, R12], [R12.T, R22 - th**4 * c1**2 * (q4 - np.outer(hx, hx))]])
    return phi, R_V, vec(local), R_Vc


def measurement(system: System, Upsilon: Array) -> tuple[Array, ...]:
    """C, N, R_V of (13), then those of the repair: E[z (x) z | X] has m2 l2, not mu^2, on (HX) (x) (HX)."""
    n, d, s = system.C.shape[1], len(system.F) + system.C.shape[1], len(system.C)
    th, mu, H = system.theta, chi(system)[0], system.Psi @ system.Phi @ system.C @ np.eye(n, d)
    phi, R_V, phi_c, R_Vc = lemma_4(system, Upsilon, H)
    C = np.block([[th * mu * H, np.zeros((s, d * d))], [np.zeros((s * s, d)), th**2 * mu**2 * np.kron(H, H)]])
    C_c = C.copy()
    C_c[s:, d:] = th**2 * system.m.power(2) * system.l.power(2) * np.kron(H, H)
    zero = np.zeros(s)
    return C, np.concatenate([zero, phi]), R_V, C_c, np.concatenate([zero, phi_c]), R_Vc


def initial(system: System) -> tuple[Array, Array]:
    """Mean of X_0 = [X; X (x) X] and its second moment Upsilon_0."""
    second, third, fourth = independent(system.x0, system.eps0).moments()
    mean = np.concatenate([np.zeros(len(second)), vec(second)])
    return mean, np.block([[second, third], [third.T, fourth]])


def lifted(system: System, horizon: int) -> tuple[list[Lifted], list[Array], list[Array]]:
    """(13) for t = 0..horizon, with the means and the second moments (21) of the lifted state."""
    mean, Upsilon = initial(system)
    d, steps, means, seconds = len(system.F) + system.C.shape[1], [], [], []
    for t in range(horizon + 1):
        A, M, R_W = process_noise(system, t, Upsilon[:d, :d])
        steps.append(Lifted(A, M, R_W, *measurement(system, Upsilon)))
        means.append(mean)
        seconds.append(Upsilon)
        Upsilon = A @ Upsilon @ A.T + np.outer(M, M) + R_W + Sym(np.outer(A @ mean, M))
        mean = A @ mean + M
    return steps, means, seconds


class Run(NamedTuple):
    """Filtering covariances for t = 0..horizon: what the recursion claims and what holds; the gains J_t."""

    claimed: Array
    true: Array
    gains: list[Array]


def quadratic(system: System, horizon: int, repaired: bool) -> Run:
    """Theorems 1 and 2: as printed (claimed is (36)), or with the measurement repaired (claimed = true)."""
    steps, means, seconds = lifted(system, horizon)
    # covariances: claimed of the error; of X; of X with the error; of the error
    P = X = Xe = e = seconds[0] - np.outer(means[0], means[0])
    claimed, true, gains = [P], [e], []
    for t in range(1, horizon + 1):
        A, R_W, now = steps[t - 1].A, steps[t - 1].R_W, steps[t]
        C, R = (now.C_c, now.R_Vc) if repaired else (now.C, now.R_V)
        P, X, Xe, e = (A @ M @ A.T + R_W for M in (P, X, Xe, e))
        J = P @ C.T @ np.linalg.pinv(C @ P @ C.T + R, rcond=1e-12, hermitian=True)
        P = P - J @ (C @ P @ C.T + R) @ J.T
        # e+ = (I - JC) e - J (C_c - C)(X - EX) - J V_c: V_c alone is uncorrelated with X and with e
        I_JC, JD = np.eye(len(P)) - J @ C, J @ (now.C_c - C)
        e = I_JC @ e @ I_JC.T + JD @ X @ JD.T - Sym(JD @ Xe @ I_JC.T) + J @ now.R_Vc @ J.T
        Xe = Xe @ I_JC.T - X @ JD.T
        claimed.append(P)
        true.append(e)
        gains.append(J)
    return Run(np.array(claimed), np.array(true), gains)


def linear(system: System, horizon: int) -> Run:
    """The filter of z alone (Figs 3-6): the first blocks of (13) and of Lemma 4, which are exact."""
    steps, _, seconds = lifted(system, horizon)
    d, s = len(system.F) + system.C.shape[1], len(system.C)
    P = seconds[0][:d, :d]
    covariances, gains = [P], []
    for t in range(1, horizon + 1):
        A, R_W = steps[t - 1].A[:d, :d], steps[t - 1].R_W[:d, :d]
        C, R = steps[t].C[:s, :d], steps[t].R_V[:s, :s]
        P = A @ P @ A.T + R_W
        J = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        P = P - J @ C @ P
        covariances.append(P)
        gains.append(J)
    return Run(np.array(covariances), np.array(covariances), gains)


def estimates(system: System, run: Run, z: Array, repaired: bool) -> Array:
    """(14) for z_1..z_T (T, s): estimates of [X; X (x) X], t = 0..T (T+1, d + d^2)."""
    steps, means, _ = lifted(system, len(z))
    X, out = means[0], [means[0]]
    for t, (zt, J) in enumerate(zip(z, run.gains, strict=False), start=1):
        C, N = (steps[t].C_c, steps[t].N_c) if repaired else (steps[t].C, steps[t].N)
        X = steps[t - 1].A @ X + steps[t - 1].M
        X = X + J @ (np.concatenate([zt, np.kron(zt, zt)]) - C @ X - N)
        out.append(X)
    return np.array(out)
