"""The exact posterior of a scalar plant behind send-on-delta: densities of (x, r) on a grid, r the sender's reference.

Between values that came: an atom (r is the last value) with a density in x, and a density f(x, r). Silence:

    f(x, r) <- f(x, r) P(|y - r| <= delta | x) + l N(r; x, R) int_{|r - r'| > delta} f(x, r') dr'

for each mode of the link, whose loss is l. Smooth integrands: the trapezoid rule on a grid of .4 deviations of the
noise is exact to 1e-12; what is cut off at delta costs 1e-4 of a deviation (halving the grid showed so).
"""

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr


class Scalar(NamedTuple):
    """x+ = a x + N(0, q), y = x + N(0, r), x_0 ~ N(0, p)."""

    a: float
    q: float
    r: float
    p: float


class Link(NamedTuple):
    """Modes: transition (M, M), initial law (M,) and the loss in each (M,)."""

    transition: np.ndarray
    initial: np.ndarray
    loss: np.ndarray


def forgetful(loss: float) -> Link:
    """A link that loses each transmission with one probability."""
    return Link(np.ones((1, 1)), np.ones(1), np.array([loss]))


def posterior(plant: Scalar, link: Link, delta: float, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean and variance after each step of z (steps,), NaN where nothing came; the log likelihood of all."""
    a, q, r, p = plant
    cells = int(np.ceil(delta / (0.4 * np.sqrt(r)) - 0.5))
    h = delta / (cells + 0.5)  # so that delta is at the edge of a cell
    reach = 5.5 * np.sqrt(max(p, q / (1 - a * a)))
    x = np.arange(-int(reach / h), int(reach / h) + 1) * h
    move = _normal(x[:, None] - a * x[None], q) * h
    noise = _normal(x[:, None] - x[None], r) * h  # N(r; x, R), (x, r), of a cell
    quiet = ndtr((x[None] + delta - x[:, None]) / np.sqrt(r)) - ndtr((x[None] - delta - x[:, None]) / np.sqrt(r))
    modes, begun, last, total, lost = len(link.loss), False, 0.0, 0.0, False
    atom, f = link.initial[:, None] * _normal(x, p) * h, np.zeros((modes, len(x), len(x)))
    means, variances = [], []
    for k, value in enumerate(z):
        atom, lost = atom @ move.T, lost and bool(link.loss.any())
        f = np.matmul(move, f) if lost else f  # zero after a value, and where nothing is ever lost
        if k and modes > 1:
            atom, f = link.transition.T @ atom, np.tensordot(link.transition, f, (0, 0)) if lost else f
        loss = link.loss[:, None]
        free = 1 - _share(x, last, delta, h) if begun else np.ones(len(x))  # of each cell of r, what an event leaves
        if np.isnan(value):
            beyond = atom[:, :, None] * free
            gone = loss[:, :, None] * noise * (_beyond(f, cells) + beyond if lost else beyond)
            stay = ndtr((last + delta - x) / np.sqrt(r)) - ndtr((last - delta - x) / np.sqrt(r)) if begun else 0.0
            atom, f, lost = atom * stay, f * quiet + gone if lost else gone, True
        else:
            event = float(abs(value - last) > delta or not begun)
            sent = event * atom + f @ (1 - _share(x, value, delta, h))
            atom, f, last, lost = (1 - loss) * sent * _normal(value - x, r), np.zeros_like(f), value, False
        begun = True
        weight = atom.sum() + f.sum()
        total += np.log(weight)
        atom, f = atom / weight, f / weight
        density = atom.sum(axis=0) + f.sum(axis=(0, 2))
        means.append(density @ x)
        variances.append(density @ x**2 - means[-1] ** 2)
    return np.array(means), np.array(variances), total


def _normal(e: np.ndarray, variance: float) -> np.ndarray:
    return np.exp(-(e**2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)


def _share(x: np.ndarray, centre: float, delta: float, h: float) -> np.ndarray:
    """Of each cell of the grid the share within delta of a point."""
    return np.clip((delta + h / 2 - np.abs(x - centre)) / h, 0.0, 1.0)


def _beyond(f: np.ndarray, cells: int) -> np.ndarray:
    """Sums over r' of f(x, r') with |r - r'| > delta, for each r."""
    n = f.shape[-1]
    edges = np.zeros((*f.shape[:-1], n + 1))
    np.cumsum(f, axis=-1, out=edges[..., 1:])
    low, high = np.clip(np.arange(n) - cells, 0, n), np.clip(np.arange(n) + cells + 1, 0, n)
    return edges[..., -1:] - np.take(edges, high, axis=-1) + np.take(edges, low, axis=-1)
