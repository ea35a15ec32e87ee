"""The posterior behind send-on-delta by particles of (x, reference, mode, steps since sent), scalar y."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri


class Problem(NamedTuple):
    """x+ = A x + N(0, Q), y = h(x) + N(0, r), x_0 ~ N(0, P); a link of modes with a loss in each."""

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
    x = random.normal(size=(count, n)) @ np.linalg.cholesky(problem.p).T
    factor, deviation = np.linalg.cholesky(problem.q), np.sqrt(problem.r)
    mode = np.searchsorted(np.cumsum(problem.initial)[:-1], random.random(count))
    reference, age = np.zeros(count), np.zeros(count, dtype=int)
    means, covariances = [], []
    for k, value in enumerate(z):
        x = x @ problem.a.T + random.normal(size=(count, n)) @ factor.T
        if k:
            rows = np.cumsum(problem.transition, axis=1)[mode][:, :-1]
            mode = np.sum(random.random((count, 1)) > rows, axis=1)
        age, y = age + 1, problem.h(x)
        loss = problem.loss[mode]
        due = np.full(count, k == 0) if problem.heartbeat is None else (k == 0) | (age >= problem.heartbeat)
        low = ndtr((reference - problem.delta - y) / deviation)
        high = ndtr((y - reference - problem.delta) / deviation)
        if np.isnan(value):
            quiet = np.where(due, 0.0, 1 - low - high)
            gone = loss * np.where(due, 1.0, low + high)
            weight = quiet + gone
            lost = random.random(count) * weight > quiet
            # What was lost: y outside of the interval, or anywhere where it was due.
            share = random.random(count)
            below = share * (low + high) < low
            place = np.where(below, share * (low + high), 1 - (share * (low + high) - low))
            sent = y + deviation * ndtri(np.clip(np.where(due, share, place), 1e-300, 1 - 1e-16))
            reference, age = np.where(lost, sent, reference), np.where(lost, 0, age)
        else:
            allowed = due | (np.abs(value - reference) > problem.delta * (1 - 1e-9))
            weight = (1 - loss) * np.exp(-((value - y) ** 2) / (2 * problem.r)) * allowed
            reference, age = np.full(count, value), np.zeros(count, dtype=int)
        weight = weight / weight.sum()
        mean = weight @ x
        apart = x - mean
        means.append(mean)
        covariances.append((weight[:, None] * apart).T @ apart)
        chosen = np.searchsorted(np.cumsum(weight)[:-1], (random.random() + np.arange(count)) / count)
        x, mode, reference, age = x[chosen], mode[chosen], reference[chosen], age[chosen]
    return np.array(means), np.array(covariances)
