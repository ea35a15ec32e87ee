"""Fusion of estimates whose errors depend on each other in an unknown way, in the notation of the cubature paper."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import LinearConstraint, minimize

Array = NDArray[np.float64]


def intersect(x: Array, Xi: Array, w: Array) -> tuple[Array, Array]:
    """(8) corrected: P = (sum w Xi^-1)^-1, xhat = P sum w Xi^-1 x; x (..., M, n)."""
    J = w[..., None, None] * np.linalg.inv(Xi)
    P = np.linalg.inv(J.sum(-3))
    return np.einsum("...ij,...kjl,...kl->...i", P, J, x), P


def trace_weights(Xi: Array) -> Array:
    """(34) by SLSQP, one problem at a time: slow reference, scaled so that its tolerance is relative."""
    scale = np.min(np.trace(Xi, axis1=-2, axis2=-1), -1)[..., None, None, None]
    J, w = np.linalg.inv(Xi / scale), np.empty(Xi.shape[:-2])
    for index in np.ndindex(Xi.shape[:-3]):
        w[index] = _simplex_minimum(J[index])
    return w


def _simplex_minimum(J: Array) -> Array:
    def cost(v: Array) -> tuple[float, Array]:  # d tr P / dw_k = -tr P J_k P
        P = np.linalg.inv(np.einsum("k,kij->ij", v, J))
        return float(np.trace(P)), np.asarray(-np.einsum("ij,kjl,li->k", P, J, P))

    w, box = np.full(len(J), 1 / len(J)), [(0.0, 1.0)] * len(J)
    total = LinearConstraint(np.ones((1, len(J))), 1.0, 1.0)
    return np.asarray(minimize(cost, w, (), "SLSQP", True, bounds=box, constraints=total, tol=1e-15).x)


def inverse_intersection(a: Array, A: Array, b: Array, B: Array, w: float) -> tuple[Array, Array]:
    """Inverse covariance intersection of two: P^-1 = A^-1 + B^-1 - G with G = (wA + (1-w)B)^-1."""
    Ai, Bi, G = np.linalg.inv(A), np.linalg.inv(B), np.linalg.inv(w * A + (1 - w) * B)
    P = np.linalg.inv(Ai + Bi - G)
    z = np.einsum("...ij,...j->...i", Ai - w * G, a) + np.einsum("...ij,...j->...i", Bi - (1 - w) * G, b)
    return np.einsum("...ij,...j->...i", P, z), P
