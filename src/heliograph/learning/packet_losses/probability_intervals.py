"""Probabilities with their 95 % intervals: by Wilson from counts, by the profile of a likelihood elsewhere."""

from collections.abc import Callable
from functools import cache

import numpy as np
from scipy.optimize import brentq, minimize
from scipy.special import expit, logit

from heliograph.numerics.confidence_intervals import Share as Share

FALL = 1.920729  # of the log-likelihood to the ends of a 95 % interval: half the 95 % point of chi-square(1)
# The same where the maximum is at 0 or 1, as of an event that never came in n trials: (1 - p)^n = 5 %, n p ~ log 20.
FALL_AT_END = 2.995732
FURTHEST_LOGIT = 14.0  # logits beyond are 0 and 1: shares of 8e-7
FIRST_STEP = 0.25  # of a logit, from the maximum towards an end of an interval
LOGIT_ACCURACY = 1e-3  # of an end
PROFILE_ACCURACY = 1e-9  # relative, of a log-likelihood on a profile

LogLikelihood = Callable[[np.ndarray], tuple[float, np.ndarray]]  # logits (p,) -> its value and gradient (p,)


def maximise_over_shares(
    function: LogLikelihood, starts: list[np.ndarray], precision: float = 1e-13
) -> tuple[np.ndarray, float]:
    """Return the highest point of a function of logits (p,), and its value there, by searches from several starts.

    A logit is log(p / (1 - p)) of a share p. The search is bounded to logits between -FURTHEST_LOGIT and
    FURTHEST_LOGIT.

    Args:
        function: returns the value and the gradient at logits (p,).
        starts: points at which searches begin, (p,) each.
        precision: relative change of the value at which a search ends.
    """

    def negative(x: np.ndarray) -> tuple[float, np.ndarray]:
        """Return minus the function and minus its gradient, since SciPy minimises."""
        value, gradient = function(x)
        return -value, -gradient

    # Logits beyond FURTHEST_LOGIT are shares of 0 and 1, as far as data tell.
    bounds = [(-FURTHEST_LOGIT, FURTHEST_LOGIT)] * len(starts[0])
    results = [
        minimize(negative, x, jac=True, bounds=bounds, options={"ftol": precision, "gtol": 1e-7}) for x in starts
    ]
    best = min(results, key=lambda result: float(result.fun))
    return np.asarray(best.x), -float(best.fun)


def estimate_shares(function: LogLikelihood, top: np.ndarray, value: float, intervals: bool) -> list[Share]:
    """Return the shares (probabilities) at the maximum of a log-likelihood, with 95 % intervals by its profile.

    The profile of a share is the log-likelihood with this share held, maximised over the others. Its interval ends
    where the profile has fallen by FALL (1.92, for 95 %). The ends are NaN unless `intervals` is True. A share at 0 or
    at 1 is itself one end of its interval; the other end is where the profile has fallen by FALL_AT_END (3.00).

    Args:
        function: log-likelihood of the logits of the shares, with its gradient.
        top: the logits at its maximum (p,).
        value: the log-likelihood there.
        intervals: whether to compute the intervals.
    """
    if not intervals:
        return [Share(float(p), float("nan"), float("nan")) for p in expit(top)]
    return [_find_profile_interval(function, top, value, i) for i in range(len(top))]


def _find_profile_interval(function: LogLikelihood, top: np.ndarray, value: float, i: int) -> Share:
    """Return share i at the maximum of a log-likelihood, with its 95 % interval.

    The interval is where the profile of the share has fallen by less than FALL. A share at 0 or 1 is one end of its
    interval; at the other end the profile has fallen by FALL_AT_END. FURTHEST_LOGIT is 14, where the search is bounded.

    Args:
        function: log-likelihood of the logits of all shares, with its gradient.
        top: the logits at its maximum (p,).
        value: the log-likelihood there.
        i: index of the share.
    """
    # A logit near the bounds of the search means a share of 0 or 1, as far as the data tell.
    is_zero = top[i] < 4 - FURTHEST_LOGIT
    is_one = top[i] > FURTHEST_LOGIT - 4
    level = value - (FALL_AT_END if is_zero or is_one else FALL)
    low = 0.0 if is_zero else _find_profile_crossing(function, top, level, i, side=-1)
    high = 1.0 if is_one else _find_profile_crossing(function, top, level, i, side=1)
    estimate = float(expit(top[i]))
    if is_zero or is_one:
        estimate = 0.0 if is_zero else 1.0
    return Share(estimate, low, high)


def _find_profile_crossing(function: LogLikelihood, top: np.ndarray, level: float, i: int, side: int) -> float:
    """Return the share i at which its profile crosses a level, below (side -1) or above (1) the share of the maximum.

    The profile at a logit is the log-likelihood, largest over all other logits. The crossing is an end of a confidence
    interval of the share, a probability 1 / (1 + exp(-logit)). 0 or 1 is returned where the profile stays above the
    level up to the end of the domain, -FURTHEST_LOGIT or FURTHEST_LOGIT, on that side. FIRST_STEP is 0.25 of a logit;
    LOGIT_ACCURACY and PROFILE_ACCURACY are those of the crossing and of each profile.

    Args:
        function: log-likelihood of the logits and its gradient.
        top: the logits of the maximum (p,).
        level: log-likelihood to which the profile falls.
        i: index of the share.
        side: -1 to search below the maximum, 1 to search above it.
    """
    others = np.delete(np.arange(len(top)), i)  # indices of the other logits
    start_of_others = top[others]  # the other logits at the last point above the level: the next search begins there

    @cache  # from another start a search may end elsewhere, so that an end of a bracket has to keep its value
    def height_above_level(logit: float) -> float:
        """Return how far the profile is above `level` when logit number i is held at `logit`.

        The profile is the log-likelihood `function`, maximised over the other logits. The search begins at
        `start_of_others`, which is the last result above the level. `others` are the indices of the other logits.
        """
        nonlocal start_of_others
        function_of_others = _fix_logit(function, i, logit, others)
        best_others, profile = maximise_over_shares(function_of_others, [start_of_others], PROFILE_ACCURACY)
        if profile > level:
            start_of_others = best_others
        return profile - level

    # The maximum itself, if it is below by rounding; an end of the domain, if the profile is above the level there.
    inside, step = float(top[i]), FIRST_STEP
    if height_above_level(inside) <= 0:
        return float(expit(inside))
    if height_above_level(side * FURTHEST_LOGIT) >= 0:
        return 0.0 if side < 0 else 1.0
    # A bracket by doubled steps from the maximum, then Brent's method.
    while height_above_level(outside := float(np.clip(inside + side * step, -FURTHEST_LOGIT, FURTHEST_LOGIT))) > 0:
        inside, step = outside, 2 * step
    return float(expit(brentq(height_above_level, inside, outside, xtol=LOGIT_ACCURACY)))


def _fix_logit(function: LogLikelihood, i: int, fixed: float, others: np.ndarray) -> LogLikelihood:
    """Return the log-likelihood as a function of the logits with indices `others`, with logit i held at `fixed`.

    A profile is the maximum of this function: the log-likelihood, largest over the other logits.

    Args:
        function: log-likelihood of all logits (p,), with its gradient.
        i: index of the logit that is held.
        fixed: its value.
        others: indices of the other logits (p - 1,).
    """

    def function_of_others(free: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the log-likelihood with logit i held and the others at `free`, and its gradient by the others.

        `function` is the log-likelihood of all logits, and `fixed` the value of logit i.
        """
        x = np.zeros(len(free) + 1)
        x[i], x[others] = fixed, free
        value, gradient = function(x)
        return value, gradient[others]

    return function_of_others


def logits(*shares: float) -> np.ndarray:
    """Return the logits log(p / (1 - p)) of shares inside (0, 1), as an array."""
    return np.asarray(logit(np.array(shares)))
