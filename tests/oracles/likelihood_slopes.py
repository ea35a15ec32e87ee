"""Derivatives of the log-density of three rows of a linear system in scales of its covariances, by fractions."""

from fractions import Fraction
from functools import reduce

import numpy as np

MOTION, READING = np.array([[0.75, 0.25], [-0.125, 0.5]]), np.array([[1.0, 0.5], [0.0, 1.0]])
SHAPES = np.array([[[1.0, 0.5], [0.5, 1.0]], [[1.0, -0.25], [-0.25, 0.5]], [[1.0, 0.5], [0.5, 0.75]]])  # of P_0, Q, R
ROWS = np.array([[1.25, -0.5], [0.375, 2.0], [-1.5, 0.25]])


def differentiate_exactly(scales, reading=READING, rows=ROWS):
    """Return the derivatives in the scales of P_0, Q and R of the log-density of all rows together, by fractions.

    z = G (x_0, w_1, w_2, w_3) + v has the covariance S = G diag(P_0, Q, Q, Q) G' + diag(R, R, R), and the log-density
    the derivative (w' S' w - tr(S^-1 S')) / 2 with w = S^-1 z.
    """
    F, H, shapes, z = (np.vectorize(Fraction)(a) for a in (MOTION, reading, SHAPES, rows.ravel()))
    steps, none = range(len(rows)), np.zeros(H.shape, dtype=int)
    power = [reduce(np.dot, [F] * i, np.eye(2, dtype=int)) for i in range(len(rows) + 1)]
    G = np.block([[H @ power[t + 1]] + [H @ power[t - j] if j <= t else none for j in steps] for t in steps])
    at_start, at_steps = np.diag([1, 0, 0, 0]), np.diag([0, 1, 1, 1])
    parts = [G @ np.kron(where, shape) @ G.T for where, shape in zip((at_start, at_steps), shapes, strict=False)]
    parts.append(np.kron(np.diag([1, 1, 1]), shapes[2][: len(H), : len(H)]))
    inverse = invert(sum(Fraction(scale) * part for scale, part in zip(scales, parts, strict=True)))
    w = inverse @ z
    return [float((w @ part @ w - np.sum(inverse * part)) / 2) for part in parts]


def invert(S):
    """Return the inverse of a positive definite matrix of fractions, by elimination."""
    n = len(S)
    rows = np.concatenate([S, np.eye(n, dtype=int)], axis=1)
    for i in range(n):
        rows[i] = rows[i] / rows[i, i]
        for j in set(range(n)) - {i}:
            rows[j] = rows[j] - rows[j, i] * rows[i]
    return rows[:, n:]
