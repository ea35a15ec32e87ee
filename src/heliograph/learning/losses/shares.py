"""Probabilities with their 95 % intervals: by Wilson from counts, by the profile of a likelihood elsewhere."""

from collections.abc import Callable
from functools import cache

import numpy as np
from scipy.optimize import brentq, minimize
from scipy.special import expit, logit

from heliograph.numerics.shares import Share as Share

FALL = 1.920729  # of the log-likelihood to the ends of a 95 % interval: half the 95 % point of chi-square(1)
FALL_AT_END = (
    2.995732  # where the maximum lies at 0 or 1, as of events that never came: n of them fail with 5 %, log 20
)
END = 14.0  # logits beyond are 0 and 1: shares of 8e-7

Slope = Callable[[np.ndarray], tuple[float, np.ndarray]]  # value and gradient of a log-likelihood of logits


def maximise_shares(function: Slope, starts: list[np.ndarray], precision: float = 1e-13) -> tuple[np.ndarray, float]:
    """Maximise from several starts (logits); return the best point and the value there. Logits stay within END.

    precision: the relative change of the value at which a search ends.
    """

    def loss(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = function(x)
        return -value, -slope

    bounds = [(-END, END)] * len(starts[0])
    results = [minimize(loss, x, jac=True, bounds=bounds, options={"ftol": precision, "gtol": 1e-7}) for x in starts]
    best = min(results, key=lambda end: float(end.fun))
    return np.asarray(best.x), -float(best.fun)


def estimate_shares(function: Slope, top: np.ndarray, value: float, intervals: bool) -> list[Share]:
    """Return shares at the maximum, each with the interval where the profile of the likelihood falls by FALL.

    A share at 0 is "0, below the high end", one at 1 "1, above the low end"; then FALL_AT_END counts.
    """
    if not intervals:
        return [Share(float(p), float("nan"), float("nan")) for p in expit(top)]
    return [_find_profile_interval(function, top, value, i) for i in range(len(top))]


def _find_profile_interval(function: Slope, top: np.ndarray, value: float, i: int) -> Share:
    """Return the share at logit i of the maximum, with the interval where its profile falls by FALL."""
    ends = {side: top[i] * side > END - 4 for side in (-1, 1)}
    fall = FALL_AT_END if any(ends.values()) else FALL
    low, high = (
        (0.0 if side < 0 else 1.0) if ends[side] else _find_crossing(function, top, value - fall, i, side)
        for side in (-1, 1)
    )
    estimate = next((0.0 if side < 0 else 1.0 for side in (-1, 1) if ends[side]), float(expit(top[i])))
    return Share(estimate, low, high)


def _find_crossing(function: Slope, top: np.ndarray, level: float, i: int, side: int) -> float:
    """Return the crossing of the level by the profile of logit i on one side; 0 or 1 where it does not cross."""
    others, near = np.delete(np.arange(len(top)), i), top.copy()

    # How far the profile is above the level, where logit i is x and all others are the best.
    @cache  # an end of a bracket keeps its value: from another start a search may end elsewhere
    def above(x: float) -> float:
        def held(free: np.ndarray) -> tuple[float, np.ndarray]:
            whole = np.zeros(len(top))
            whole[i], whole[others] = x, free
            value, slope = function(whole)
            return value, slope[others]

        free, best = maximise_shares(held, [near[others]], 1e-9)
        if best > level:
            near[others] = free
        return best - level

    # A bracket by doubled steps from the top, then Brent's method.
    inside, step = float(top[i]), 0.25
    if above(inside) <= 0:
        return float(expit(inside))
    if above(side * END) >= 0:
        return 0.0 if side < 0 else 1.0
    while above(outside := float(np.clip(inside + side * step, -END, END))) > 0:
        inside, step = outside, 2 * step
    return float(expit(brentq(above, inside, outside, xtol=1e-3)))


def logits(*shares: float) -> np.ndarray:
    """Return the logits of shares inside (0, 1)."""
    return np.asarray(logit(np.array(shares)))
