"""What the growth constant a = 0.7 is worth: searched for pairs that break it, where state and estimates go."""

from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph_studies.h_infinity_fusion import setting
from heliograph_studies.h_infinity_fusion.example import RECURSIVE, Outcome

MARGIN = 0.1  # of the box's width, added on each side
RANGE = 2.0  # |x_j| <= 2: the range over which the paper's figures run


@dataclass(frozen=True)
class Growth:
    """Findings about a = 0.7: at each step in the box visited there, and at the last step over the whole range.

    size: whether |f(x)| <= 0.7 |x| there. secant (time,): the largest |f(x) - f(xhat)| / |x - xhat| that happened.
    """

    visited: list[hg.h_infinity.GrowthFinding]
    whole: hg.h_infinity.GrowthFinding
    size: hg.h_infinity.GrowthFinding
    secant: np.ndarray

    @property
    def slopes(self) -> np.ndarray:
        """Largest slope at each step, (time,)."""
        return np.array([finding.slope for finding in self.visited])


def growth(outcome: Outcome) -> Growth:
    """Search around the truth and the paper's filters' estimates of these runs."""
    estimates, truth, visited = outcome.estimates(RECURSIVE), outcome.truth, []
    for s in range(setting.STEPS):
        points = np.concatenate([estimates[:, :, s].reshape(-1, 2), truth[s : s + 1]])
        low, high = points.min(axis=0), points.max(axis=0)
        pad = MARGIN * (high - low)
        visited.append(
            hg.h_infinity.check_growth(setting.dynamics(s), setting.GROWTH, low - pad, high + pad, f"f at s = {s}")
        )
    side, last = np.full(2, RANGE), setting.STEPS - 1
    f = setting.dynamics(last)
    whole = hg.h_infinity.check_growth(f, setting.GROWTH, -side, side, f"f at s = {last}")
    size = hg.h_infinity.check_size(f, setting.GROWTH, -side, side, f"|f| at s = {last}")
    return Growth(visited, whole, size, _secant(truth, estimates))


def _secant(truth: np.ndarray, estimates: np.ndarray) -> np.ndarray:
    s = np.arange(len(truth))

    def f(x: np.ndarray) -> np.ndarray:
        return 0.7 * np.stack([x[..., 0] * np.cos(0.1 * x[..., 1]), x[..., 1] * np.sin(s * x[..., 0])], axis=-1)

    moved = np.linalg.norm(f(truth) - f(estimates), axis=-1)
    result: np.ndarray = (moved / np.linalg.norm(truth - estimates, axis=-1)).max(axis=(0, 1))
    return result
