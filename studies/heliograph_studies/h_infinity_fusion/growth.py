"""What the growth constant a = 0.7 is worth: pairs that break it where state and estimates go, and what rests on it."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph_studies.h_infinity_fusion.example import RECURSIVE, Runs
from heliograph_studies.h_infinity_fusion.setting import Setting, dynamics
from heliograph_studies.h_infinity_fusion.worst_disturbance import World, Worst, worst_disturbance

MARGIN = 0.1  # of the box's width, added on each side
ENERGIES = (5e4, 1e5, 2e5)  # starts of some 60, where the cosine of f changes its sign
SEARCH_DRAWS, JUDGE_DRAWS = 4, 2_000
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


def growth(outcome: Runs) -> Growth:
    """Search around the truth and the paper's filters' estimates of these runs."""
    setting, estimates, truth, visited = outcome.setting, outcome.estimates(RECURSIVE), outcome.truth, []
    for s in range(setting.steps):
        points = np.concatenate([estimates[:, :, s].reshape(-1, 2), truth[s : s + 1]])
        low, high = points.min(axis=0), points.max(axis=0)
        pad = MARGIN * (high - low)
        visited.append(hg.h_infinity.check_growth(dynamics(s), setting.growth, low - pad, high + pad, f"f at s = {s}"))
    side, last = np.full(2, RANGE), setting.steps - 1
    f = dynamics(last)
    whole = hg.h_infinity.check_growth(f, setting.growth, -side, side, f"f at s = {last}")
    size = hg.h_infinity.check_growth(f, setting.growth, -side, side, f"|f| at s = {last}", differences=False)
    return Growth(visited, whole, size, _secant(truth, estimates))


def _secant(truth: np.ndarray, estimates: np.ndarray) -> np.ndarray:
    s = np.arange(len(truth))

    def f(x: np.ndarray) -> np.ndarray:
        return 0.7 * np.stack([x[..., 0] * np.cos(0.1 * x[..., 1]), x[..., 1] * np.sin(s * x[..., 0])], axis=-1)

    moved = np.linalg.norm(f(truth) - f(estimates), axis=-1)
    result: np.ndarray = (moved / np.linalg.norm(truth - estimates, axis=-1)).max(axis=(0, 1))
    return result


def violation(setting: Setting, node: int, design: hg.h_infinity.HInfinityDesign) -> Worst:
    """The worst disturbance found for a node's filter; where its level is above the design's, the theorem is broken."""
    believed, sensor = setting.plant(False), setting.sensor(node, 0.0)
    item = hg.filters.h_infinity_filter(believed, sensor, setting.system(node), design)
    judges = setting.draws(SEARCH_DRAWS, 1), setting.draws(JUDGE_DRAWS, 2)
    return worst_disturbance(item, world(setting, node), *judges, ENERGIES, starts=16)


def world(setting: Setting, node: int) -> World:
    """The example for a search for the worst disturbance."""
    sensing = setting.sensing[node]
    return World(
        lambda x, k: dynamics(k)(x),
        lambda x: sensing * jnp.sum(x, keepdims=True),
        setting.B,
        np.array([[setting.feedthrough[node]]]),
        setting.M,
        setting.weight * np.eye(4),
        setting.inputs(),
    )
