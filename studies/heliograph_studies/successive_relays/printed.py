"""The paper's recursion in its own letters, as corrected or with one misprint at a time, to see what each would do.

Everything at k - 1 unless marked; even k: relay 1 receives and relay 2 transmits, odd k the other way round.
"""

from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import fail
from heliograph_studies.successive_relays.setting import Setting

MISPRINTS = ("none", "lemma_1", "theorem_1", "lemma_7", "lemma_6_sign", "lemma_6_last")


class Recursion(NamedTuple):
    """Gains of the receiving relay and of the remote filter, (N, n, 1), and traces claimed for k = 0 .. N."""

    relay_gain: np.ndarray
    remote_gain: np.ndarray
    relay_trace: np.ndarray  # (N + 1, 2)
    remote_trace: np.ndarray  # (N + 1,)


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
    Gam, Psi, n = setting.transition, np.array([setting.sensing]), len(setting.transition)
    SS = np.outer(setting.process_input, setting.process_input)
    Q, R = setting.process * SS, setting.sensor_input**2 * setting.sensor_noise * np.eye(1)
    Q1 = setting.sensor_noise * SS if misprint == "lemma_1" else Q
    G = setting.noise * np.eye(1)  # and O
    P = C = setting.initial_covariance
    X, Xx, Pm = ([P, P] for _ in range(3))
    Pi = P + np.outer(setting.initial_mean, setting.initial_mean)
    K_all, L_all, relay, remote = [], [], [[np.trace(P)] * 2], [np.trace(P)]
    v, m_3 = setting.spread, setting.means[2]
    for k in range(1, horizon + 1):
        i, j = (0, 1) if k % 2 == 0 else (1, 0)
        m, d = setting.means[i], setting.means[3 + j]
        Cij = C if i == 0 else C.T
        Gb = m * Psi @ Gam + m_3 * Psi
        al = (v + m**2) * (Psi @ Q @ Psi.T + R) + G + v * Psi @ (Pi + Gam @ Pi @ Gam.T) @ Psi.T
        al = al + (v + m_3**2) * Psi @ X[j] @ Psi.T - v * Psi @ _twice(Xx[j]) @ Psi.T
        al = al - _twice(m_3 * Gb @ Cij @ Psi.T)
        wrong = X[i] if misprint == "theorem_1" else Cij
        K = (Gam @ (X[i] @ Gb.T - m_3 * wrong @ Psi.T) + m * Q @ Psi.T) @ np.linalg.inv(Gb @ X[i] @ Gb.T + al)
        square = v**2 if misprint == "lemma_7" else d**2
        Re = v * Pi - square * _twice(Pm[j]) + (v + d**2) * X[j] - v * _twice(Xx[j])
        Ok = d**2 * Psi @ P @ Psi.T + Psi @ Re @ Psi.T + G
        L = d * Gam @ (P - Pm[j]) @ Psi.T @ np.linalg.inv(Ok)
        A, B, KP, LP = Gam - K @ Gb, Gam - d * L @ Psi, K @ Psi, L @ Psi
        P_next = B @ P @ B.T + LP @ Re @ LP.T + _twice(d * Gam @ Pm[j] @ LP.T) + Q + L @ G @ L.T
        first = Gam - LP if misprint == "lemma_6_sign" else B  # delta_i + delta_j = 1 for its mean d
        last = X[i] if misprint == "lemma_6_last" else Cij.T
        Pi_next = first @ Pm[i] @ A.T + m_3 * B @ Pm[j] @ KP.T + m_3 * d * LP @ X[j] @ KP.T
        Pm_i = Pi_next + Q @ (np.eye(n) - m * KP.T) + d * LP @ last @ A.T
        Pm_j = B @ Pm[j] @ Gam.T + Q + d * LP @ X[j] @ Gam.T
        X_i = A @ X[i] @ A.T + _twice(m_3 * Gam @ Cij @ KP.T - m * KP @ Q) + Q + K @ al @ K.T
        C_next = A @ Cij @ Gam.T + m_3 * KP @ X[j] @ Gam.T - m * KP @ Q + Q
        Xx_i = Gam @ Xx[i] @ A.T + m_3 * Gam @ Xx[j] @ KP.T - m * Q @ KP.T + Q
        X_j, Xx_j = Gam @ X[j] @ Gam.T + Q, Gam @ Xx[j] @ Gam.T + Q
        X, Xx, Pm = (list(pair) if i == 0 else list(pair[::-1]) for pair in ((X_i, X_j), (Xx_i, Xx_j), (Pm_i, Pm_j)))
        C, P, Pi = (C_next if i == 0 else C_next.T), P_next, Gam @ Pi @ Gam.T + Q1
        K_all.append(K)
        L_all.append(L)
        relay.append([np.trace(x) for x in X])
        remote.append(np.trace(P))
    return Recursion(np.array(K_all), np.array(L_all), np.array(relay), np.array(remote))


def by_filter(result: Recursion) -> dict[str, np.ndarray]:
    """The gains as the library takes them: relay 2 listens at odd k, relay 1 at even k."""
    odd = (np.arange(1, len(result.relay_gain) + 1) % 2 == 1)[:, None, None]
    zero = np.zeros_like(result.relay_gain)
    return {
        "relay_1": np.where(odd, zero, result.relay_gain),
        "relay_2": np.where(odd, result.relay_gain, zero),
        "receiver": result.remote_gain,
    }


def _twice(a: np.ndarray) -> np.ndarray:
    """a + a'."""
    result: np.ndarray = a + a.T
    return result
