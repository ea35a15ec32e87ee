"""The share of steps in which send-on-delta sends, by the law of the state and the value sent last on a grid."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.sparse.linalg import ArpackError, LinearOperator, eigs
from scipy.special import ndtr

from heliograph.numerics.check import fail

MOST_CELLS_EACH_SIDE = 200  # of half a grid: a step of its law is 64 million products
MOST_PRODUCTS = 2e10  # of all iterations for a law of cells: seconds
PRODUCTS_OF_ITERATION = 20  # times the cube of the number of cells: of one iteration for their law
DEVIATIONS_EACH_SIDE = 5.5  # deviations of what is measured over which the grid reaches on either side
MOST_CELLS_COUNTED = 1e9  # that are counted: more are refused anyway


class ScalarSystem(NamedTuple):
    """Linear plant and sensor of one number each: x+ = a x + N(0, q), y = c x + N(0, r)."""

    a: float
    q: float
    c: float
    r: float

    @property
    def kalman_variance(self) -> float:
        """Error variance of the sender's Kalman filter in the long run.

        The model is x+ = a x + w with Var w = q, and z / c = x + v with Var v = r. The variance before a measurement is
        the positive root of prior^2 + b prior - q r = 0 with b = r (1 - a^2) - q; after it, it is prior r / (prior +
        r).
        """
        a, q, r = self.a, self.q, self.r / self.c**2
        b = r * (1 - a * a) - q
        prior = (-b + np.sqrt(b * b + 4 * q * r)) / 2
        return float(prior * r / (prior + r))


class RateOnGrid(NamedTuple):
    """Share of steps in which a message is sent, computed on a grid of cells, and the length of a cell."""

    rate: float
    cell: float


class _CellGrid(NamedTuple):
    """Grid of cells for a number, with a cell around 0.

    Args:
        each_side: number of further cells on either side of it.
        of_delta: number of cells on either side of a cell that are no further than delta from it.
        length: length of a cell.
    """

    each_side: int
    of_delta: int
    length: float


def _choose_cells(system: ScalarSystem, delta: float, share: float) -> _CellGrid:
    """Return the grid of cells of equal length h on which the joint law of state and value sent last is computed.

    h is at most `share` of the standard deviation of either noise. The sender sends when the measurement is more than
    delta from the value sent last, so that delta is made the edge of a cell: (k + 1/2) h for a whole number k.

    Args:
        system: plant and sensor, with c = 1.
        delta: a value is sent if it is further than this from the value sent last.
        share: largest length of a cell, as a share of the deviation of either noise.

    Raises:
        ValueError: more cells than can be computed.
    """
    a, q, r = system.a, system.q, system.r
    # The number k of cells; MOST_CELLS_COUNTED keeps it finite, since so many are refused below.
    cells_of_delta = int(np.ceil(min(delta / (share * np.sqrt(min(q, r))), MOST_CELLS_COUNTED) - 0.5))
    h = delta / (cells_of_delta + 0.5)
    # The grid reaches DEVIATIONS_EACH_SIDE standard deviations of the measurement, sqrt(q / (1 - a^2) + r), to either
    # side of 0.
    measured = np.sqrt(q / (1 - a * a) + r)
    cells_each_side = int(np.ceil(min(DEVIATIONS_EACH_SIDE * measured / h, MOST_CELLS_COUNTED)))
    if cells_each_side > MOST_CELLS_EACH_SIDE:
        raise fail(
            "plant, sensor and delta",
            f"a measurement whose deviation is at most {MOST_CELLS_EACH_SIDE / DEVIATIONS_EACH_SIDE:.3g} cells of "
            f"the grid (of at most {share:g} of the deviation of either noise, and of 2 delta)",
            f"{measured / h:.3g} cells of {h:.3g}",
        )
    return _CellGrid(each_side=cells_each_side, of_delta=cells_of_delta, length=h)


def compute_rate_on_grid(system: ScalarSystem, delta: float, share: float) -> RateOnGrid:
    """Return the share of steps with a message of send-on-delta, by a grid of cells, and the cells' length.

    x+ = a x + w (variance q) is measured as z = x + v (variance r) and sent where |z - last sent| > delta. So
    (x, last sent) is a Markov chain. Its law is held as f[i, j] = P(x in cell i, last sent in cell j), on cells no
    longer than `share` of the lesser noise's deviation. It is the same of (-x, -last sent), so that only the rows of
    x >= 0 are computed.

    Args:
        system: plant and sensor, with c = 1.
        delta: a value is sent if it is further than this from the last value sent.
        share: largest length of a cell, as a share of the lesser noise's deviation.
    """
    a, q, r = system.a, system.q, system.r
    cells = _choose_cells(system, delta, share)
    # Probabilities of a cell given the middle of another: T[new, old] of x after a step, noise[x, z] of z given x.
    x = np.arange(-cells.each_side, cells.each_side + 1) * cells.length
    size, upper = len(x), x[cells.each_side :]  # of x >= 0
    T = _compute_cell_probabilities(x, a * x, np.sqrt(q)).T[cells.each_side :]
    noise = _compute_cell_probabilities(x, upper, np.sqrt(r))
    # silence[i, j] = P(no message) of x in cell i, with the value of cell j sent last.
    silence = ndtr((x + delta - upper[:, None]) / np.sqrt(r)) - ndtr((x - delta - upper[:, None]) / np.sqrt(r))

    def move_law(half: np.ndarray) -> np.ndarray:
        """Return the rows of x >= 0 after x moves, from those before.

        `T` has the probabilities [new, old] of cells of x after a step.
        """
        below = half[:0:-1, ::-1]  # of x < 0: the same with both signs turned
        return np.asarray(T @ np.concatenate([below, half]))

    def step_law(vector: np.ndarray) -> np.ndarray:
        """Return the law's rows of x >= 0 after a step, from those before it, as a vector.

        First x moves (`move_law`), then it is sent or not. Without a message (probability `silence`) the value sent
        last stays. With one it is the measured value x + v, whose probabilities given x are `noise`. `cells.of_delta`
        is the number of cells within delta.
        """
        f = move_law(vector.reshape(-1, size))
        return np.asarray(f * silence + _compute_law_after_message(f, noise, cells.of_delta)).ravel()

    # The stationary law f, searched from the law of the state and a value that was just sent.
    deviation = np.sqrt(q / (1 - a * a))
    start = _compute_cell_probabilities(x, np.zeros(1), deviation).T[cells.each_side :] * noise
    f = _find_stationary_law(step_law, start, delta)
    sent = _compute_law_after_message(move_law(f), noise, cells.of_delta)
    times = np.where(upper > 0, 2.0, 1.0)  # of each row, which is one of two but for that of x = 0
    return RateOnGrid(rate=float(times @ sent.sum(axis=1) / (times @ f.sum(axis=1))), cell=cells.length)


def _find_stationary_law(step_law: Callable[[np.ndarray], np.ndarray], start: np.ndarray, delta: float) -> np.ndarray:
    """Return the law of a Markov chain that a step leaves as it is, in the shape of `start` (rows, cells).

    It is the eigenvector of a step for its largest eigenvalue, 1, by Arnoldi's iterations, scaled to sum 1. Their
    number is limited so that they take seconds.

    Args:
        step_law: function of a law as a vector that returns the law after a step.
        start: law with which the iterations begin.
        delta: the sender's threshold, for messages.
    """
    operator = LinearOperator((start.size, start.size), matvec=step_law, dtype=np.float64)
    most_iterations = int(MOST_PRODUCTS / start.shape[1] ** 3 / PRODUCTS_OF_ITERATION) + 2
    try:
        _, vectors = eigs(operator, 1, v0=start.ravel(), maxiter=most_iterations, tol=1e-9)
    except ArpackError as why:
        raise fail("delta", "one whose rate of messages converges within seconds", f"{delta:g}") from why
    return np.asarray(np.real(vectors[:, 0] / vectors.sum()).reshape(start.shape))


def _compute_law_after_message(f: np.ndarray, noise: np.ndarray, cells_of_delta: int) -> np.ndarray:
    """Return the law after a message, of the part of f that sends one: the value sent last is now the measured one.

    Args:
        f: [i, j] = P(x in cell i, last sent in cell j), before the message.
        noise: [i, z] = P(measured in cell z | x in cell i).
        cells_of_delta: number of cells on either side of a cell that are no further than delta from it.
    """
    # The first `count` cells have cells more than delta above them, and the last `count` have such cells below.
    size = f.shape[1]
    count = max(size - cells_of_delta - 1, 0)
    mass_up_to = np.cumsum(f, axis=1)  # [i, j] = P(x in cell i, last sent in cell j or below)
    # [i, z] = P(x in cell i, last sent more than delta from cell z), first above z and then below.
    mass_beyond_delta = np.zeros_like(f)
    mass_above = mass_up_to[:, -1:] - mass_up_to[:, size - count - 1 : -1]
    mass_beyond_delta[:, :count] = mass_above
    mass_beyond_delta[:, size - count :] += mass_up_to[:, :count]
    return np.asarray(mass_beyond_delta * noise)


def _compute_cell_probabilities(x: np.ndarray, means: np.ndarray, deviation: float) -> np.ndarray:
    """Return the probabilities [i, j] that a Gaussian with mean means[i] falls into the cell around x[j].

    Cells end halfway between neighbours. The outermost cells reach to infinity.
    """
    edges = np.concatenate([[-np.inf], (x[1:] + x[:-1]) / 2, [np.inf]])
    return np.diff(ndtr((edges - means[:, None]) / deviation), axis=1)
