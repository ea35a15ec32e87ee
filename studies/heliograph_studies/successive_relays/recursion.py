"""The paper's recursion for the covariances and gains of two relays and a remote filter, in its letters.

Gamma moves the state, Psi senses it; e_i is the error of relay i, e that of the remote filter. At each step relay i
receives and relay j transmits.
"""

from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import fail
from heliograph_studies.successive_relays.setting import Setting

MISPRINTS = ("none", "lemma_1", "theorem_1", "lemma_7", "lemma_6_sign", "lemma_6_last")
Pair = list[np.ndarray]  # of relays 1 and 2


class Recursion(NamedTuple):
    """Gains of the receiving relay and of the remote filter, (N, n, 1), and traces claimed for k = 0 .. N."""

    relay_gain: np.ndarray
    remote_gain: np.ndarray
    relay_trace: np.ndarray  # (N + 1, 2)
    remote_trace: np.ndarray  # (N + 1,)


class Example(NamedTuple):
    """The example's matrices, and what of it a misprint changes: Q1, in place of Q in the state's own moments."""

    Gam: np.ndarray
    Psi: np.ndarray
    Q: np.ndarray
    Q1: np.ndarray
    R: np.ndarray
    G: np.ndarray  # and O
    v: float  # variance of every gain
    m_3: float  # mean gain between the relays
    misprint: str


class Moments(NamedTuple):
    """Second moments at k: E e e', Pi = E x x', C = E e_1 e_2', and by relay X_i = E e_i e_i', E x e_i', E e e_i'."""

    P: np.ndarray
    Pi: np.ndarray
    C: np.ndarray
    X: Pair
    Xx: Pair
    Pm: Pair


class RelayUpdate(NamedTuple):
    """Update of the relay that receives: its link's mean gain m, its gain K, and what its innovation is made of."""

    m: float
    Gb: np.ndarray  # the innovation's part by e_i
    al: np.ndarray  # and the covariance of the rest
    K: np.ndarray


class RemoteUpdate(NamedTuple):
    """Update of the remote filter: its link's mean gain d, its gain L, and Re of its innovation's covariance."""

    d: float
    Re: np.ndarray
    L: np.ndarray


def recursion(misprint: str, horizon: int, setting: Setting) -> Recursion:
    """Lemmas 1 to 7 and Theorems 1 and 2 on the example.

    Misprints: lemma_1, Pi from V in (13); theorem_1, Xi_i for Xi_ij in the gain (30); lemma_7, the variance squared for
    the mean squared before P_i + P_i'; lemma_6_sign, delta for deltabar in (24); lemma_6_last, Xi_i' for Xi_ij' there.

    Raises:
        ValueError: an unknown misprint.
    Source: (13), (14), (18), (21), (24), (26), (29), (31).
    """
    if misprint not in MISPRINTS:
        raise fail("misprint", f"one of {list(MISPRINTS)}", repr(misprint))
    example, P = _make_example(misprint, setting), setting.initial_covariance
    Pi = P + np.outer(setting.initial_mean, setting.initial_mean)
    now = Moments(P, Pi, P, [P, P], [P, P], [P, P])
    K_all, L_all, relay, remote = [], [], [[np.trace(P)] * 2], [np.trace(P)]
    for k in range(1, horizon + 1):
        i, j = (0, 1) if k % 2 == 0 else (1, 0)
        received = _update_relay(example, now, i, setting.means[i])
        heard = _update_remote(example, now, j, setting.means[3 + j])
        now = _move(example, now, i, received, heard)
        K_all.append(received.K)
        L_all.append(heard.L)
        relay.append([np.trace(x) for x in now.X])
        remote.append(np.trace(now.P))
    return Recursion(np.array(K_all), np.array(L_all), np.array(relay), np.array(remote))


def _make_example(misprint: str, setting: Setting) -> Example:
    """Return the example with a misprint."""
    SS = np.outer(setting.process_input, setting.process_input)
    Q, R = setting.process * SS, setting.sensor_input**2 * setting.sensor_noise * np.eye(1)
    Q1 = setting.sensor_noise * SS if misprint == "lemma_1" else Q
    Gam, Psi, G = setting.transition, np.array([setting.sensing]), setting.noise * np.eye(1)
    return Example(Gam, Psi, Q, Q1, R, G, setting.spread, setting.means[2], misprint)


def _update_relay(example: Example, now: Moments, i: int, m: float) -> RelayUpdate:
    """Return the gain (30) of relay i, which hears the sensor and relay j, and its innovation's covariance."""
    Gam, Psi, Q, _, R, G, v, m_3, misprint = example
    j, Cij = 1 - i, _cross(now, i)
    Gb = m * Psi @ Gam + m_3 * Psi
    al = (v + m**2) * (Psi @ Q @ Psi.T + R) + G + v * Psi @ (now.Pi + Gam @ now.Pi @ Gam.T) @ Psi.T
    al = al + (v + m_3**2) * Psi @ now.X[j] @ Psi.T - v * Psi @ _twice(now.Xx[j]) @ Psi.T
    al = al - _twice(m_3 * Gb @ Cij @ Psi.T)
    wrong = now.X[i] if misprint == "theorem_1" else Cij
    K = (Gam @ (now.X[i] @ Gb.T - m_3 * wrong @ Psi.T) + m * Q @ Psi.T) @ np.linalg.inv(Gb @ now.X[i] @ Gb.T + al)
    return RelayUpdate(m, Gb, al, K)


def _update_remote(example: Example, now: Moments, j: int, d: float) -> RemoteUpdate:
    """Return the gain (31) of the remote filter, which hears relay j."""
    Gam, Psi, v = example.Gam, example.Psi, example.v
    square = v**2 if example.misprint == "lemma_7" else d**2
    Re = v * now.Pi - square * _twice(now.Pm[j]) + (v + d**2) * now.X[j] - v * _twice(now.Xx[j])
    Ok = d**2 * Psi @ now.P @ Psi.T + Psi @ Re @ Psi.T + example.G
    L = d * Gam @ (now.P - now.Pm[j]) @ Psi.T @ np.linalg.inv(Ok)
    return RemoteUpdate(d, Re, L)


def _move(example: Example, now: Moments, i: int, received: RelayUpdate, heard: RemoteUpdate) -> Moments:
    """Return the covariances of all errors, and of errors with the state, after a step in which relay i receives."""
    Gam, Psi, Q, Q1, _, G, _, m_3, misprint = example
    (P, Pi, _, X, Xx, Pm), j, Cij = now, 1 - i, _cross(now, i)
    (m, Gb, al, K), (d, Re, L) = received, heard
    A, B, KP, LP = Gam - K @ Gb, Gam - d * L @ Psi, K @ Psi, L @ Psi
    # The remote filter's error, alone and with each relay's.
    P_next = B @ P @ B.T + LP @ Re @ LP.T + _twice(d * Gam @ Pm[j] @ LP.T) + Q + L @ G @ L.T
    first = Gam - LP if misprint == "lemma_6_sign" else B  # delta_i + delta_j = 1 for its mean d
    last = X[i] if misprint == "lemma_6_last" else Cij.T
    Pm_i = first @ Pm[i] @ A.T + m_3 * B @ Pm[j] @ KP.T + m_3 * d * LP @ X[j] @ KP.T
    Pm_i = Pm_i + Q @ (np.eye(len(Gam)) - m * KP.T) + d * LP @ last @ A.T
    Pm_j = B @ Pm[j] @ Gam.T + Q + d * LP @ X[j] @ Gam.T
    # The relays' errors, alone, with each other and with the state: relay j has nothing new.
    X_i = A @ X[i] @ A.T + _twice(m_3 * Gam @ Cij @ KP.T - m * KP @ Q) + Q + K @ al @ K.T
    C_next = A @ Cij @ Gam.T + m_3 * KP @ X[j] @ Gam.T - m * KP @ Q + Q
    Xx_i = Gam @ Xx[i] @ A.T + m_3 * Gam @ Xx[j] @ KP.T - m * Q @ KP.T + Q
    X_j, Xx_j = Gam @ X[j] @ Gam.T + Q, Gam @ Xx[j] @ Gam.T + Q
    X, Xx, Pm = (list(pair) if i == 0 else list(pair[::-1]) for pair in ((X_i, X_j), (Xx_i, Xx_j), (Pm_i, Pm_j)))
    return Moments(P_next, Gam @ Pi @ Gam.T + Q1, C_next if i == 0 else C_next.T, X, Xx, Pm)


def _cross(now: Moments, i: int) -> np.ndarray:
    """Return E e_i e_j' of relay i and the other one."""
    return now.C if i == 0 else now.C.T


def _twice(a: np.ndarray) -> np.ndarray:
    """Return a + a'."""
    result: np.ndarray = a + a.T
    return result
