"""E P of the filter that knows of losses: by quadrature, from runs, over all patterns; and its Riccati equation."""

from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from heliograph_studies import Sampled, sampled
from heliograph_studies.intermittent_observations.setting import Example

DEGREE, LOSSES, SQUARINGS = 40, 400, 8  # of the polynomials; in a row; of the map from arrival to arrival


def mean_error(example: Example, fail: float, recover: float) -> float:
    """E P before z after long, of a scalar plant whose arrivals fail and whose losses end with these probabilities.

    After an arrival P = x lies between q and a^2 r / c^2 + q; l losses make it g^l(x), g(x) = a^2 x + q. So the law of
    x from arrival to arrival is that of a smooth random map h(g^l(x)), here on Chebyshev polynomials, and E P the
    mean of x + g(x) + ... + g^l(x) over that of l + 1.
    """
    a, c, q, r = (float(np.squeeze(v)) for v in (example.transition, example.output, example.process, example.noise))
    # g^l(x) = a^(2 l) x + q (a^(2 l) - 1) / (a^2 - 1), and the law of l.
    lasts = np.arange(LOSSES)
    after = np.where(lasts == 0, 1.0, fail * (1 - recover) ** np.maximum(lasts - 1.0, 0.0))  # P(l >= lasts)
    growth = (a * a) ** lasts.astype(float)
    added = q * (growth - 1) / (a * a - 1)
    # Chebyshev nodes over where P lies after an arrival.
    low, high = q, a * a * r / c**2 + q
    nodes = np.cos(np.pi * (np.arange(DEGREE) + 0.5) / DEGREE)
    before = (low + (high - low) * (nodes + 1) / 2)[:, None] * growth + added
    # h(g^l(x)): P after the next arrival, and the map of polynomials that its law is.
    following = a * a * before * r / (c * c * before + r) + q
    values = chebyshev.chebvander(2 * (following - low) / (high - low) - 1, DEGREE - 1)
    mean_values = np.einsum("l,xld->xd", after - np.append(after[1:], 0.0), values)
    onward = np.linalg.solve(chebyshev.chebvander(nodes, DEGREE - 1), mean_values)
    # The map after long: its fixed law; then the mean over the losses that follow.
    for _ in range(SQUARINGS):
        onward = onward @ onward
    mean = low + (high - low) * (onward[0, 1] + 1) / 2  # of any polynomial, in its constant coefficient after long
    return float((mean * after @ growth + after @ added) / after.sum())


def from_runs(example: Example, fail: float, recover: float, filtered: np.ndarray, arrived: np.ndarray) -> Sampled:
    """tr E P before z from the filter's covariances after z (run, time, n, n) in the steps that had one (run, time).

    What losses do is known: with D the part of E P before an arrival, L before a loss, w the share of losses and h(P)
    what follows an arrival, L = fail E[h 1] + (1 - recover) (A L A' + w Q) and D = (1 - fail) E[h 1] + recover (A L A'
    + w Q). So only E[h 1] is simulated, which losses do not inflate; P itself may have no variance.
    """
    a, q = example.transition, example.process * np.eye(example.states)
    following = np.where(arrived[..., None, None], a @ filtered @ a.T + q, 0.0)
    square, lost = np.kron(a, a), fail / (fail + recover)
    n = example.states

    def total(received: np.ndarray) -> np.ndarray:
        right = fail * received + (1 - recover) * lost * q
        before_loss = np.linalg.solve(np.eye(n * n) - (1 - recover) * square, right.reshape(-1, n * n, 1))
        before_loss = before_loss.reshape(-1, n, n)
        following_loss = a @ before_loss @ a.T + lost * q
        return np.asarray(np.trace(before_loss + (1 - fail) * received + recover * following_loss, axis1=1, axis2=2))

    result = total(following.mean(axis=1))  # linear in what was received, so that each run gives one value
    return sampled(result)


def over_patterns(example: Example, arrival: float, steps: int) -> np.ndarray:
    """tr E P after 0 ... steps steps from P = Q, over all 2^steps patterns of independent losses."""
    a, c, q = example.transition, example.output, example.process * np.eye(example.states)
    r, p, weight, results = example.noise * np.eye(len(c)), q[None], np.ones(1), [float(np.trace(q))]
    for _ in range(steps):
        gain = a @ p @ c.T @ np.linalg.inv(c @ p @ c.T + r)
        loop = a - gain @ c
        received = loop @ p @ loop.swapaxes(1, 2) + gain @ r @ gain.swapaxes(1, 2) + q
        p = np.concatenate([a @ p @ a.T + q, received])
        weight = np.concatenate([(1 - arrival) * weight, arrival * weight])
        results.append(float(np.einsum("p,pii->", weight, p)))
    return np.array(results)


class Iterated(NamedTuple):
    """tr V and the largest |V - V'| of each step, by the two forms."""

    subtracted: np.ndarray
    joseph: np.ndarray
    skew: np.ndarray
    joseph_skew: np.ndarray

    @property
    def skew_growth(self) -> float:
        """Factor a step by which the subtracted form's skew part grows, from the middle on."""
        middle = len(self.skew) // 2
        return float((self.skew[-1] / self.skew[middle]) ** (1 / (len(self.skew) - 1 - middle)))


def iterate(example: Example, arrival: float, steps: int) -> Iterated:
    """The modified Riccati equation as printed and in Joseph's form: V+ = A V A' + Q - arrival K S K'."""
    a, c, q = example.transition, example.output, example.process * np.eye(example.states)
    r = example.noise * np.eye(len(c))
    printed = joseph = q
    results = []
    for _ in range(steps):
        innovation, cross = c @ printed @ c.T + r, a @ printed @ c.T
        printed = a @ printed @ a.T + q - arrival * cross @ np.linalg.inv(innovation) @ cross.T
        gain = a @ joseph @ c.T @ np.linalg.inv(c @ joseph @ c.T + r)
        loop = a - gain @ c
        squares = loop @ joseph @ loop.T + gain @ r @ gain.T
        joseph = (1 - arrival) * a @ joseph @ a.T + arrival * squares + q
        skew = [float(np.abs(v - v.T).max()) for v in (printed, joseph)]
        results.append((np.trace(printed), np.trace(joseph), *skew))
    return Iterated(*np.array(results).T)
