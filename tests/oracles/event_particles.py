"""The posterior behind send-on-delta by particles of (x, reference, mode, steps since sent), scalar y."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri


class Problem(NamedTuple):
    """x+ = A x + N(0, Q), y = h(x) + N(0, r), x_0 ~ N(0, P), x (n, particles); a link of modes with a loss in each."""

    a: np.ndarray
    q: np.ndarray
    h: Callable[[np.ndarray], np.ndarray]
    r: float
    p: np.ndarray
    delta: float
    transition: np.ndarray
    initial: np.ndarray
    loss: np.ndarray
    heartbeat: int | None = None


def particle_moments(problem: Problem, z: np.ndarray, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Means (steps, n) and covariances (steps, n, n) after each step of z (steps,), NaN where nothing came."""
    random, n = np.random.default_rng(seed), len(problem.a)
    x = np.linalg.cholesky(problem.p) @ random.standard_normal((n, count))
    factor, deviation = np.linalg.cholesky(problem.q), np.sqrt(problem.r)
    mode = np.searchsorted(np.cumsum(problem.initial)[:-1], random.random(count))
    reference, age = np.zeros(count), np.zeros(count, dtype=int)
    means, covariances = [], []
    for k, value in enumerate(z):
        x = problem.a @ x + factor @ random.standard_normal((n, count))
        if k and len(problem.initial) > 1:
            rows = np.cumsum(problem.transition, axis=1)[mode][:, :-1]
            mode = np.sum(random.random((count, 1)) > rows, axis=1)
        age, y = age + 1, problem.h(x)
        loss = problem.loss[mode] if len(problem.initial) > 1 else problem.loss[0]
        due = np.full(count, k == 0) if problem.heartbeat is None else (k == 0) | (age >= problem.heartbeat)
        if np.isnan(value):
            low = ndtr((reference - problem.delta - y) / deviation)
            high = ndtr((y - reference - problem.delta) / deviation)
            quiet = np.where(due, 0.0, 1 - low - high)
            weight = quiet + loss * np.where(due, 1.0, low + high)
            # What was lost: y outside of the interval, or anywhere where it was due.
            lost = np.flatnonzero(random.random(count) * weight > quiet)
            low, high, share = low[lost], high[lost], random.random(len(lost))
            within, below = share * (low + high), share * (low + high) < low
            where = np.where(due[lost], share, np.where(below, within, 1 - (within - low)))
            reference[lost] = y[lost] + deviation * ndtri(np.clip(where, 1e-300, 1 - 1e-16))
            age[lost] = 0
        else:
            allowed = due | (np.abs(value - reference) > problem.delta * (1 - 1e-9))
            weight = (1 - loss) * np.exp(-((value - y) ** 2) / (2 * problem.r)) * allowed
            reference, age = np.full(count, value), np.zeros(count, dtype=int)
        weight = weight / weight.sum()
        mean = x @ weight
        apart = x - mean[:, None]
        means.append(mean)
        covariances.append(weight * apart @ apart.T)
        # Systematic resampling: copies of each, from whole numbers between ends of shares of the unit interval.
        ends = np.ceil(np.cumsum(weight) * count - random.random()).astype(int)
        ends[-1] = count
        chosen = np.repeat(np.arange(count), np.diff(ends, prepend=0))
        x, mode, reference, age = (np.take(values, chosen, axis=-1) for values in (x, mode, reference, age))
    return np.array(means), np.array(covariances)
