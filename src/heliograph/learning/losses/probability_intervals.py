"""Probabilities with their 95 % intervals: by Wilson from counts, by the profile of a likelihood elsewhere."""

from collections.abc import Callable
from functools import cache

import numpy as np
from scipy.optimize import brentq, minimize
from scipy.special import expit, logit

from heliograph.numerics.counted_shares import Share as Share

FALL = 1.920729  # of the log-likelihood to the ends of a 95 % interval: half the 95 % point of chi-square(1)
# The same where the maximum is at 0 or 1, as of an event that never came in n trials: (1 - p)^n = 5 %, n p ~ log 20.
FALL_AT_END = 2.995732
END = 14.0  # logits beyond are 0 and 1: shares of 8e-7

Slope = Callable[[np.ndarray], tuple[float, np.ndarray]]  # value and gradient of a log-likelihood of logits


def maximise_shares(function: Slope, starts: list[np.ndarray], precision: float = 1e-13) -> tuple[np.ndarray, float]:
    """Return the best point (logits, within END) of searches from several starts, and the value there.

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
    is_zero, is_one = top[i] < 4 - END, top[i] > END - 4
    level = value - (FALL_AT_END if is_zero or is_one else FALL)
    low = 0.0 if is_zero else _find_crossing(function, top, level, i, -1)
    high = 1.0 if is_one else _find_crossing(function, top, level, i, 1)
    estimate = float(expit(top[i]))
    if is_zero or is_one:
        estimate = 0.0 if is_zero else 1.0
    return Share(estimate, low, high)


def _find_crossing(function: Slope, top: np.ndarray, level: float, i: int, side: int) -> float:
    """Return the share at which the profile of logit i crosses a level on one side; 0 or 1 where it does not."""
    others, near = np.delete(np.arange(len(top)), i), top.copy()

    @cache  # an end of a bracket keeps its value: from another start a search may end elsewhere
    def height_above_level(x: float) -> float:
        """Return how far the profile is above the level where logit i is x and all others are the best."""

        def with_x(free: np.ndarray) -> tuple[float, np.ndarray]:
            """Return value and slope by the free logits, those of `others`, where logit i is x."""
            whole = np.zeros(len(top))
            whole[i], whole[others] = x, free
            value, slope = function(whole)
            return value, slope[others]

        free, best = maximise_shares(with_x, [near[others]], 1e-9)
        if best > level:
            near[others] = free
        return best - level

    # A bracket by doubled steps from the top, then Brent's method.
    inside, step = float(top[i]), 0.25
    if height_above_level(inside) <= 0:
        return float(expit(inside))
    if height_above_level(side * END) >= 0:
        return 0.0 if side < 0 else 1.0
    while height_above_level(outside := float(np.clip(inside + side * step, -END, END))) > 0:
        inside, step = outside, 2 * step
    return float(expit(brentq(height_above_level, inside, outside, xtol=1e-3)))


def logits(*shares: float) -> np.ndarray:
    """Return the logits of shares inside (0, 1)."""
    return np.asarray(logit(np.array(shares)))
