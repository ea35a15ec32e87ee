"""The modified Riccati equation in floating-point arithmetic, in the form in which it is printed and in Joseph's."""

from typing import NamedTuple

import numpy as np

from heliograph_studies.intermittent_observations.setting import NOISE, Example


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
    """V+ = A V A' + Q - arrival K S K', K = A V C' S^-1, against the sum of squares of the same K."""
    a, c, q = example.transition, example.output, example.process * np.eye(example.states)
    r = NOISE * np.eye(len(c))
    printed = joseph = q
    found = []
    for _ in range(steps):
        innovation, cross = c @ printed @ c.T + r, a @ printed @ c.T
        printed = a @ printed @ a.T + q - arrival * cross @ np.linalg.inv(innovation) @ cross.T
        gain = a @ joseph @ c.T @ np.linalg.inv(c @ joseph @ c.T + r)
        loop = a - gain @ c
        squares = loop @ joseph @ loop.T + gain @ r @ gain.T
        joseph = (1 - arrival) * a @ joseph @ a.T + arrival * squares + q
        skew = [float(np.abs(v - v.T).max()) for v in (printed, joseph)]
        found.append((np.trace(printed), np.trace(joseph), *skew))
    return Iterated(*np.array(found).T)
