"""Constant velocity seen through noise with outliers, drawn by NumPy: columns of the robust updates' table."""

import numpy as np


def simulated(column: str, runs: int, steps: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Truth (runs, steps, 4) and measurements (runs, steps, 2), NaN where nothing arrived.

    dt 0.1, Q = 0.1 I, x_0 = (0, 0, 1, 1) with P = I. student: R = 10 I, one t scale (nu 2.01) a step; mixture: the mean
    doubled with probability 0.05, R = 10 I; clean: R = I; outliers: 5 % of variance 100, each component apart; bursts:
    losses of a Gilbert-Elliott chain (0.05, 0.1) too; relay: the plant times 0.95, a Rayleigh gain of mean 1 for both
    components, plain noise 0.5.
    """
    rng = np.random.default_rng(seed)
    a = (0.95 if column == "relay" else 1.0) * (np.eye(4) + 0.1 * np.eye(4, k=2))
    x, lost = np.array([0, 0, 1.0, 1.0]) + rng.standard_normal((runs, 4)), np.zeros(runs, bool)
    truth, rows = [], []
    for _ in range(steps):
        x = x @ a.T + np.sqrt(0.1) * rng.standard_normal((runs, 4))
        y, v = x[:, :2], rng.standard_normal((runs, 2))
        out = rng.random((runs, 2)) < 0.05
        if column == "student":
            z = y + np.sqrt(10 / (rng.chisquare(2.01, (runs, 1)) / 2.01)) * v
        elif column == "mixture":
            z = np.where(out[:, :1], 2 * y, y) + np.sqrt(10) * v
        elif column == "clean":
            z = y + v
        else:
            z = y + np.where(out, 10, 1) * v
        if column == "relay":
            gain = rng.rayleigh(np.sqrt(2 / np.pi), (runs, 1))
            z = gain * z + np.sqrt(0.5) * rng.standard_normal((runs, 2))
        if column == "bursts":
            u = rng.random(runs)
            lost = np.where(lost, u >= 0.1, u < 0.05)
            z = np.where(lost[:, None], np.nan, z)
        truth.append(x)
        rows.append(z)
    return np.stack(truth, 1), np.stack(rows, 1)
