"""The best linear estimate of a whole trajectory by brute force: every x and every z stacked in one covariance."""

from dataclasses import dataclass

import numpy as np


@dataclass
class Step:
    """x+ = A x + shift + w, y = C x+ + v, z = G y + n; G is one of `gains` with `chances`, n has mean `offset`."""

    a: np.ndarray
    shift: np.ndarray
    q: np.ndarray
    c: np.ndarray
    noise_mean: np.ndarray
    r: np.ndarray
    gains: np.ndarray
    chances: np.ndarray
    offset: np.ndarray
    n: np.ndarray


@dataclass
class Stacked:
    """Means and covariances of all states x_1 ... x_T and all measurements, with what they have in common."""

    x: np.ndarray
    xx: np.ndarray
    z: np.ndarray
    xz: np.ndarray
    zz: np.ndarray


def stacked(mean, covariance, steps) -> Stacked:
    """Joint moments of a trajectory, from those of its start."""
    n, time = len(mean), len(steps)
    joint = np.zeros((time + 1, time + 1, n, n))
    joint[0, 0], means = covariance, [np.asarray(mean)]
    for k, s in enumerate(steps):
        for j in range(k + 1):
            joint[k + 1, j] = s.a @ joint[k, j]
            joint[j, k + 1] = joint[k + 1, j].T
        joint[k + 1, k + 1] = s.a @ joint[k, k] @ s.a.T + s.q
        means.append(s.a @ means[-1] + s.shift)
    joint, means = joint[1:, 1:], np.array(means[1:])
    gain = [np.einsum("a,aij->ij", s.chances, s.gains) for s in steps]
    h = [g @ s.c for g, s in zip(gain, steps, strict=True)]
    y = [s.c @ m + s.noise_mean for s, m in zip(steps, means, strict=True)]
    received = np.concatenate([g @ item + s.offset for g, item, s in zip(gain, y, steps, strict=True)])
    xz = [[joint[i, j] @ h[j].T for j in range(time)] for i in range(time)]
    zz = [[h[i] @ joint[i, j] @ h[j].T for j in range(time)] for i in range(time)]
    for k, s in enumerate(steps):
        second = s.c @ joint[k, k] @ s.c.T + s.r + np.outer(y[k], y[k])
        items = np.einsum("a,aij,jl,aml->im", s.chances, s.gains, second, s.gains)
        zz[k][k] = items + s.n - np.outer(gain[k] @ y[k], gain[k] @ y[k])
    xx = joint.transpose(0, 2, 1, 3).reshape(time * n, time * n)
    return Stacked(means, xx, received, np.block(xz), np.block(zz))


def estimate(s: Stacked, z: np.ndarray, given: int):
    """Means and covariances of all states given what is there (not NaN) of the first `given` measurements."""
    time, n = s.x.shape
    flat = z.reshape(-1)
    used = np.flatnonzero(~np.isnan(flat) & (np.arange(flat.size) < given * z.shape[1]))
    unit = np.sqrt(np.diag(s.zz)[used])
    inverse = np.linalg.pinv(s.zz[np.ix_(used, used)] / np.outer(unit, unit), rcond=1e-13, hermitian=True)
    gain = s.xz[:, used] / unit @ inverse / unit
    mean = s.x.reshape(-1) + gain @ (flat[used] - s.z[used])
    whole = s.xx - gain @ s.xz[:, used].T
    blocks = whole.reshape(time, n, time, n)[np.arange(time), :, np.arange(time)]
    return mean.reshape(time, n), blocks
