"""Theorem 1's inequality checked by counting: E V(next) over the eight outcomes of three losses."""

from itertools import product
from typing import NamedTuple

import numpy as np

from heliograph.h_infinity.certificate import theorem_matrix
from heliograph_studies.h_infinity_fusion.setting import Setting

WIDTHS = (2, 2, 2, 2, 1, 1, 1, 3)  # x, e, f, f~, h, h~, v, rho
POINTS = 50  # for each node


class Trial(NamedTuple):
    """Gains, weights of this step and the next, and multipliers, all random; (18) is an identity in them."""

    gain: np.ndarray
    weight: np.ndarray
    following: np.ndarray
    multipliers: np.ndarray


def enumeration_gap(setting: Setting, node: int, seed: int = 0) -> float:
    """Largest difference between eta' Phi eta and the same from (1) to (6), relative to the size of its terms."""
    system, random, worst, level = setting.system(node), np.random.default_rng(seed), 0.0, setting.levels[node]
    for _ in range(POINTS):
        weights = np.zeros((2, 4, 4))
        for block in (slice(0, 2), slice(2, 4)):
            root = random.normal(size=(2, 2, 2))
            weights[:, block, block] = root @ np.swapaxes(root, 1, 2)
        trial = Trial(random.normal(size=(2, 2)), weights[0], weights[1], random.uniform(size=2))
        eta = random.normal(size=sum(WIDTHS))
        phi = theorem_matrix(system, 0, *trial[:3], np.repeat(trial.multipliers, 2), level)
        counted, size = _counted(setting, node, trial, np.split(eta, np.cumsum(WIDTHS)[:-1]))
        worst = max(worst, abs(float(eta @ phi @ eta) - counted) / size)
    return worst


def _counted(setting: Setting, node: int, trial: Trial, parts: list[np.ndarray]) -> tuple[float, float]:
    """E V(next) - V + |M e|^2 - gamma^2 (|v|^2 + |rho|^2) + sum lambda (...) from the equations, and its size."""
    x, e, f, df, h, dh, v, rho = parts
    lam, a, b, expected = trial.multipliers, setting.growth, setting.output_growth(node), 0.0
    for outcome in product((0, 1), repeat=3):
        chance = float(np.prod([p if b else 1 - p for p, b in zip(setting.arrival, outcome, strict=True)]))
        driven = setting.B @ v
        after = np.concatenate(
            [f + driven, df + driven - trial.gain @ _innovation(setting, node, outcome, h, dh, v, rho)]
        )
        expected += chance * float(after @ trial.following @ after)
    xi, missed = np.concatenate([x, e]), setting.M @ e
    terms = [
        expected, -xi @ trial.weight @ xi, missed @ missed, -(setting.levels[node] ** 2) * (v @ v + rho @ rho),
        lam[0] * (a**2 * xi @ xi - f @ f - df @ df), lam[1] * (b**2 * xi @ xi - h @ h - dh @ dh),
    ]  # fmt: skip
    return float(sum(terms)), float(sum(map(abs, terms)))


def _innovation(
    setting: Setting, node: int, outcome: tuple[int, ...], h: np.ndarray, dh: np.ndarray, v: np.ndarray, rho: np.ndarray
) -> np.ndarray:
    """Received less expected, (3) to (6), for one outcome of the losses."""
    (b1, b2, b3), (p1, p2, p3), e = outcome, setting.arrival, np.sqrt(setting.powers)
    y, n = h + setting.feedthrough[node] * v, np.array(setting.noise_gain) * rho
    r = e[1] * b2 * (e[0] * b1 * y + n[0]) + n[1]
    direct = e[2] * b3 * y + n[2]
    result: np.ndarray = np.concatenate([r - e[0] * e[1] * p1 * p2 * (h - dh), direct - e[2] * p3 * (h - dh)])
    return result
