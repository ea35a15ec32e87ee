"""Water filling: a fast start for powers of which each path has one, by the condition of the optimum.

Where a path has one free hop it carries the information j = p / (a p + b), concave in its power p, and the error is a
convex function of the powers. At the optimum w_i dj_i/dp_i is the same for all that send, w_i = -d error / d j_i. With
the weights w fixed that is
    p_i = [y sqrt(w_i b_i) - b_i]^+ / a_i
with a water level y that the budget sets, exactly, since the powers are piecewise linear in it. The way from p to those
powers leads down, for the linearised error is concave in p; how far to go the slopes at both ends say.
"""

from collections.abc import Callable

import numpy as np

from heliograph.numerics.types import Float
from heliograph.planning.multihop_paths.path_problem import ErrorSlopes
from heliograph.planning.multihop_paths.power_split_over_hops import SplitPaths
from heliograph.planning.power_budget import PowerLimits, Powers

CLOSED_GAP = 1e-14  # gap, of the error, at which the powers are the best but for rounding
MOST_ITERATIONS = 500
PATIENCE = 20  # iterations in a row that do not close the gap further
MOST_TRIES = 12  # points on the way to other powers
LEAST_SLOPE = 1e-9  # least a, of s kappa: below, a path that power makes free of noise is a little more than linear


def water_filling(
    limits: PowerLimits,
    slopes_at: Callable[[Powers], ErrorSlopes],
    whole: SplitPaths,
    start: Powers,
) -> Powers:
    """Return the powers (time, free) of the least error within limits, where each path has one free hop.

    A free hop is a transmitter whose power may be chosen. Each iteration linearises the error in the information j of
    the paths, finds the powers that minimise that (water filling: all transmitters fill to one level), and moves
    towards them to a point of less error. It ends when the gap to a lower bound of the error closes, or has not shrunk
    for PATIENCE iterations.

    Args:
        limits: the largest powers: of each transmitter at each time and on average, and of all together.
        slopes_at: function of powers p that returns the error, w = -d error / d j of each free hop's path, and
            d error / d p.
        whole: the path of each free hop, as a function of that hop's power: j = 1 / (full (1 + alpha / p) - signal).
        start: powers at which to begin (time, free).
    """
    # At the power p of its free hop, a path has j = p / (a p + b), with a = full - signal and b = full alpha.
    a = np.maximum(whole.full - whole.signal, LEAST_SLOPE * whole.full)
    alpha = whole.alpha[..., 0]  # of the path's only free hop
    b = whole.full * alpha
    # `best` are the powers with the least gap so far. A gap of CLOSED_GAP (1e-14) of the error is only rounding.
    best = p = start
    least_gap = np.inf
    idle = 0  # iterations in a row without a smaller gap
    slopes = slopes_at(p)
    for _ in range(MOST_ITERATIONS):
        # The gap of Frank and Wolfe: how far the error's tangent at p falls within the limits. No powers gain more.
        least_on_tangent = limits.find_best_powers(-slopes.gradient)
        gap = float(np.sum(slopes.gradient * (p - least_on_tangent)))
        idle = 0 if gap < (1 - CLOSED_GAP) * least_gap else idle + 1
        if gap < least_gap:
            least_gap, best = gap, p
        if gap <= CLOSED_GAP * abs(slopes.error) or idle > PATIENCE:
            break
        # The powers that minimise -sum w j with the weights w = -d error / d j, and the best point on the way to them.
        filled = _fill_to_limits(limits, slopes.weights, a, b)
        p, slopes = _search_line(slopes_at, p, slopes, filled - p)
    return best


def _search_line(
    slopes_at: Callable[[Powers], ErrorSlopes], p: Powers, slopes: ErrorSlopes, way: Powers
) -> tuple[Powers, ErrorSlopes]:
    """Return a point of less error on the way from p to p + way, and its slopes.

    It is the end of the way if the error is less there and its slope small. Else shorter ways are tried, up to where a
    parabola with the slopes at both ends has its minimum. If none is accepted, rounding hides the descent: the result
    is half of `way`, which brings p closer to the minimum still.

    Args:
        slopes_at: function of powers that returns the error and its slopes.
        p: powers at which the way begins (time, free).
        slopes: the slopes there.
        way: change of the powers to the end of the way (time, free).
    """
    slope = float(np.sum(slopes.gradient * way))
    length = 1.0
    for _ in range(MOST_TRIES if slope < 0 else 0):
        tried = slopes_at(p + length * way)
        end_slope = float(np.sum(tried.gradient * way))
        if end_slope <= -0.5 * slope and tried.error <= slopes.error:
            return p + length * way, tried
        # The minimum of a parabola with these slopes at its ends, as a share of the way between 0.1 and 0.9.
        share = slope / (slope - end_slope) if end_slope != slope else 0.0  # equal only by rounding
        length *= min(max(share, 0.1), 0.9)
    return p + way / 2, slopes_at(p + way / 2)


def _fill_to_limits(limits: PowerLimits, weights: Powers, a: Powers, b: Powers) -> Powers:
    """Return the powers p that minimise -sum w j within the limits (time, free), with j = p / (a p + b).

    They are [y sqrt(w b) - b]^+ / a (water filling). The level y is as high as the limits allow; y^-2 is the multiplier
    of the power. Here p = [y rise - ground]^+ with rise = sqrt(w b) / a and ground = b / a. j is the information of a
    path, and w (`weights`) is -d error / d j.
    """
    rise = np.sqrt(np.maximum(weights, 0.0) * b) / a
    ground = b / a
    steps, transmitters = ground.shape
    # Find the level at which each transmitter reaches its mean, and then the level of the total.
    no_limit = np.full(steps, np.inf)
    levels_of_means = [
        _find_level(rise[:, i], ground[:, i], limits.peak[:, i], no_limit, limits.mean[i] * steps)
        for i in range(transmitters)
    ]
    highest = np.broadcast_to(levels_of_means, ground.shape)
    level = _find_level(rise.ravel(), ground.ravel(), limits.peak.ravel(), highest.ravel(), limits.total * steps)
    # A transmitter's level is at most the one at which it reaches its mean.
    return limits.clip_powers(_fill_to_level(np.minimum(level, highest), rise, ground, limits.peak))


def _fill_to_level(
    level: Float[np.ndarray, "*k"],
    rise: Float[np.ndarray, "*k"],
    ground: Float[np.ndarray, "*k"],
    peak: Float[np.ndarray, "*k"],
) -> Float[np.ndarray, "*k"]:
    """Return the powers min([level rise - ground]^+, peak), in the arguments' shape; they are 0 if rise is 0.

    Powers fill like water: each place is filled above its `ground`, faster with a larger `rise`, up to its `peak`.
    """
    with np.errstate(invalid="ignore"):
        wet = np.where(rise > 0, level * rise - ground, 0.0)
    return np.clip(wet, 0.0, peak)


def _find_level(
    rise: Float[np.ndarray, "k"],
    ground: Float[np.ndarray, "k"],
    peak: Float[np.ndarray, "k"],
    highest: Float[np.ndarray, "k"],
    total: float,
) -> float:
    """Return the water level y at which k powers sum to the total; infinity where they do not reach it at any level.

    A power is min([min(y, highest) rise - ground]^+, peak): it is 0 up to the level ground / rise, then grows by
    `rise` for each unit of the level, until it has reached `peak` or the level `highest`.

    Args:
        rise: growth of each power with the level (k,), 0 for a power that stays 0.
        ground: rise times the level at which each power begins (k,).
        peak: largest value of each power (k,), may be infinite.
        highest: level above which each power stays (k,), may be infinite.
        total: the sum that is wanted.
    """
    grows = rise > 0
    rise = rise[grows]
    ground = ground[grows]
    peak = peak[grows]
    highest = highest[grows]
    if not rise.size or not np.isfinite(total):
        return np.inf
    # The sum is piecewise linear in the level: it bends where a power begins to grow, or stops.
    bends = np.concatenate([ground / rise, (ground + peak) / rise, highest])
    bends = np.unique(bends[np.isfinite(bends)])
    sums = _fill_to_level(np.minimum(bends[:, None], highest), rise, ground, peak).sum(axis=1)  # at each bend
    if total < sums[-1]:
        return float(np.interp(total, sums, bends))
    # Above the last bend only powers without an end grow, each by its `rise`.
    is_endless = (highest > bends[-1]) & (rise * bends[-1] - ground < peak)
    return float(bends[-1] + (total - sums[-1]) / rise[is_endless].sum()) if is_endless.any() else np.inf
