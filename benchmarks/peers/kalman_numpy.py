"""NumPy: all runs in one stack of matrices, with np.linalg.solve for the gains."""

import numpy as np
from timed import Arrays, Contender, fastest, serve

WIDTHS = (250, 1_000)


def filtered(p: Arrays, runs: slice) -> tuple[np.ndarray, np.ndarray]:
    gains, z = p["gains"][runs], p["z"][runs]
    a, q, r = p["A"], p["Q"], p["R"]
    x = np.repeat(p["mean"][None, :, None], len(z), axis=0)
    spread = np.repeat(p["covariance"][None], len(z), axis=0)
    means = np.empty((*z.shape[:2], len(a)))
    for k in range(z.shape[1]):
        x = a @ x
        spread = a @ spread @ a.T + q
        h = gains[:, k, :, None] * p["C"]
        cross = h @ spread
        gain = np.linalg.solve(cross @ h.swapaxes(1, 2) + r, cross).swapaxes(1, 2)
        x = x + gain @ (z[:, k, :, None] - h @ x)
        spread = spread - gain @ cross
        means[:, k] = x[..., 0]
    return means, spread


def prepare(p: Arrays) -> Contender:
    runs = len(p["z"])

    def blocks(width: int) -> list[tuple[np.ndarray, np.ndarray]]:
        return [filtered(p, slice(i, i + width)) for i in range(0, runs, width)]

    widths = [w for w in WIDTHS if w < runs] + [runs]
    name, work = fastest({f"{w:,} runs in a stack": lambda w=w: blocks(w) for w in widths})
    return Contender(work, lambda result: np.concatenate([means for means, _ in result]), name)


if __name__ == "__main__":
    serve(prepare, ("numpy",))
