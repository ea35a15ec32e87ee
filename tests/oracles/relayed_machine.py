"""Oracle: the induction machine behind relays of the cubature-fusion paper, in its notation.

Plant x+ = f(x)+w (R), y_i = C_i x+v (Q); node i receives ybar = c xi gamma y + alpha sqrt(Er) xi m + n with
c = alpha sqrt(El Er). Leading axes are free: x (..., n).
Source: Li, Wang, Hu, Dong, Liu, "Cubature Kalman Fusion Filtering Under Amplify-and-Forward Relays with
Randomly Varying Channel Parameters", (1)-(6), section IV.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Setting = dict[str, Any]
Law = tuple[Array, Array, Array]  # values, nominal probabilities, radii of the probabilities

_ROWS = [(-4.448, 1.11), (-4.428, 1.21), (-4.435, 1.05), (-4.441, 1.14)]  # (b7, b8) ... (b13, b14)
_X0 = np.array([0.25, -0.55, -0.4, 0.2, 0.15])
_I2, _I5 = np.eye(2), np.eye(5)


def _law(values: list[float], p: list[float], radius: float) -> Law:
    return np.array(values), np.array(p), np.full(len(p), radius)


PRINTED: Setting = {
    "b1": -0.186, "b2": -1.778, "b3": 6.125, "b4": -6.234, "b5": 0.081, "b6": 4.643,
    "h": 0.1, "k1": 2.0, "k2": 0.1, "k3": 0.55, "T": 40,
    "C": np.array([[[p, 0, q, 0, 0], [0, p, 0, q, 0]] for p, q in _ROWS]),
    "R": 1e-6 * _I5, "Q": 0.25 * _I2, "Qm": 0.2 * _I2, "Qn": 0.1 * _I2, "P0": 1e-4 * _I5, "Xi0": 1.25 * _I5,
    "alpha": 0.25, "El": 0.05, "Er": 0.05, "beta": (1e-6, 1e-4), "xbar0": _X0,
    "xi": _law([0.1, 0.5, 1], [0.2, 0.3, 0.5], 0.01), "gamma": _law([0.1, 0.5, 1], [0.4, 0.3, 0.3], 0.01),
    "xhat0": np.array([[0.22, -0.45, -0.54, 0.23, 0.22], [0.21, -0.38, -0.54, 0.32, 0.19],
                       [0.42, -0.55, -0.51, 0.31, 0.21], [0.09, -0.62, -0.52, 0.33, 0.21]]),
}  # fmt: skip
# x5 stays bounded (k3 = 0), the voltage keeps exciting (k2 = 2), the channel is strong: measurements matter.
STRONG: Setting = {
    **PRINTED, "k2": 2.0, "k3": 0.0, "T": 100, "R": 1e-5 * _I5, "Q": 1e-3 * _I2, "Qm": 1e-3 * _I2,
    "Qn": 1e-3 * _I2, "alpha": 2.0, "El": 1.0, "Er": 1.0, "beta": (1e-3, 1e-2),
    "xi": _law([0.8, 0.9, 1], [0.2, 0.3, 0.5], 0.02), "gamma": _law([0.7, 0.85, 1], [0.3, 0.3, 0.4], 0.02),
    "P0": 0.02 * _I5, "Xi0": 0.02 * _I5, "xhat0": np.tile(_X0, (4, 1)),
}  # fmt: skip


def f(x: Array, s: Setting) -> Array:
    """Induction machine, one Euler step."""
    x1, x2, x3, x4, x5 = np.moveaxis(x, -1, 0)
    d1 = s["b1"] * x1 + s["k1"] * x2 + s["b2"] * x3 + s["k2"]
    d2 = -s["k1"] * x1 + s["b1"] * x2 + s["b2"] * x4
    d3 = s["b3"] * x1 + s["b4"] * x3 + (s["k1"] - x5) * x4
    d4 = s["b3"] * x2 - (s["k1"] - x5) * x3 + s["b4"] * x4
    d5 = s["b5"] * (x1 * x4 - x2 * x3) + s["b6"] * s["k3"]
    return np.asarray(x + s["h"] * np.stack([d1, d2, d3, d4, d5], -1))


def hessians(s: Setting) -> Array:
    """H[i] = d2 f_i / dx dx', constant because f is quadratic; shape (5, 5, 5)."""
    H = np.zeros((5, 5, 5))
    for i, j, k, value in [(2, 3, 4, -1.0), (3, 2, 4, 1.0), (4, 0, 3, s["b5"]), (4, 1, 2, -s["b5"])]:
        H[i, j, k] = H[i, k, j] = s["h"] * value
    return H


def jacobian(x: Array, s: Setting) -> Array:
    """df/dx = A + (H_i x)', where A = df/dx at zero."""
    b1, b2, b3, b4, k1 = (s[k] for k in ("b1", "b2", "b3", "b4", "k1"))
    A = np.array([[b1, k1, b2, 0, 0], [-k1, b1, 0, b2, 0], [b3, 0, b4, k1, 0], [0, b3, -k1, b4, 0], [0] * 5])
    return np.asarray(np.eye(5) + s["h"] * A + np.einsum("ijk,...k->...ij", hessians(s), x))


def simulate(s: Setting, runs: int, rng: np.random.Generator, laws: tuple[Array, Array]) -> dict[str, Array]:
    """x (run, T+1, n); ybar (run, T, M, m), xi and gamma (run, T, M) at 1..T under the true laws given."""
    M, m, n = s["C"].shape
    x = np.empty((runs, s["T"] + 1, n))
    x[:, 0] = rng.multivariate_normal(s["xbar0"], s["P0"], runs)
    for k in range(s["T"]):
        x[:, k + 1] = f(x[:, k], s) + rng.multivariate_normal(np.zeros(n), s["R"], runs)
    shape = (runs, s["T"], M)
    xi, gamma = (rng.choice(s[k][0], shape, p=q) for k, q in zip(("xi", "gamma"), laws, strict=True))
    v, m, n = (rng.multivariate_normal(np.zeros(m), s[k], shape) for k in ("Q", "Qm", "Qn"))
    z = np.sqrt(s["El"]) * gamma[..., None] * (np.einsum("iab,rtb->rtia", s["C"], x[:, 1:]) + v) + m
    return {"x": x, "ybar": s["alpha"] * np.sqrt(s["Er"]) * xi[..., None] * z + n, "xi": xi, "gamma": gamma}
