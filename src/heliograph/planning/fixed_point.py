"""The best powers of paths of one hop without a solver: water filling, with weights from the adjoint.

At the best powers w_i dj_i/dp_i is the same for all transmitters that send. With the weights w held that is
  p_i = [y sqrt(w_i b_i) - b_i]^+ / a_i,
with a water level y that the budget sets, exactly, since the powers are piecewise linear in it. The way from p to those
powers leads down, for the linearised cost is concave in p; how far to go the slopes at both ends say.
"""

import numpy as np
from scipy.optimize import brentq

from heliograph.numerics.check import InputError, fail, instance, scalar
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.allocation import Allocation, LeastPower
from heliograph.planning.budget import Allowed, Budget
from heliograph.planning.criterion import Error
from heliograph.planning.one_hop import OneHop, Point, inside, one_hop
from heliograph.planning.paths import Paths, Powers

CLOSED = 1e-14  # gap, of the error, at which the powers are the best but for rounding
STEPS = 500
PATIENCE, TRIES = 20, 12  # iterations that close the gap no further; points on the way
STEEPEST = 1e-9  # least a, of s kappa: below, a path that power makes free of noise is a little more than linear
PLENTY = 1e12  # of a hop's noise: more changes nothing that is printed
WIDER = 2.0  # of log power, from one guess to the next
ROUNDING = 1e-12  # of covariances, relative, by which a bound stays below what is computed


def water_filling(
    paths: Paths, budget: Budget | ArrayLike, error: Error | None = None, states: tuple[str, ...] | None = None
) -> Allocation:
    """The best powers of paths of one hop, steady, over a period or a horizon, by the fixed point; no solver is needed.

    The error is a trace or a weighted one. `states` names those that the error's weight speaks of.

    Raises:
        ValueError: paths of several hops, the worst direction (`semidefinite_powers` takes it), a budget without limit.
    """
    if isinstance(error, Error) and error.worst:
        raise fail("error of water filling", "a trace", "the worst direction, which semidefinite_powers takes")
    return fill(one_hop(paths, budget, error, states))[2]


def fill(problem: OneHop, start: Powers | None = None) -> tuple[Powers, Point, Allocation]:
    """Iterate from even powers, or from a start, until the gap closes or nothing goes down any more."""
    room = problem.allowed
    p = room.even(np.ones(room.peak.shape, dtype=bool)) if start is None else start
    if not np.all(np.isfinite(p)):
        raise fail("budget", "one that limits every transmitter", "no limit for some")
    here = problem.at(p)
    best, idle = Allocation(p, here.value, problem.bound(here, p), "water filling"), 0
    kept = p, here
    for _ in range(STEPS):
        if best.gap <= CLOSED * abs(best.error) or idle > PATIENCE:
            break
        p, here = _along(problem, p, here, _water(problem, here) - p)
        bound = problem.bound(here, p)
        idle = 0 if here.value - bound < (1 - CLOSED) * best.gap else idle + 1
        if here.value - bound < best.gap:
            best, kept = Allocation(p, here.value, bound, "water filling"), (p, here)
    return *kept, best._replace(bound=best.bound - ROUNDING * abs(best.error))


def _along(problem: OneHop, p: Powers, here: Point, ahead: Powers) -> tuple[Powers, Point]:
    """A point lower on the way: its end, or where the slopes at both ends say that the lowest lies.

    Where rounding hides the way down, half of it, by which the gap still shrinks.
    """
    slope = float(np.sum(here.gradient * ahead))
    length = 1.0
    for _ in range(TRIES if slope < 0 else 0):
        there = problem.at(p + length * ahead)
        rise = float(np.sum(there.gradient * ahead))
        if rise <= -0.5 * slope and there.value <= here.value:
            return p + length * ahead, there
        length *= min(max(slope / (slope - rise), 0.1), 0.9)
    return p + ahead / 2, problem.at(p + ahead / 2)


def _water(problem: OneHop, here: Point) -> Powers:
    """Powers at the level that the budget sets, under the weights of a point."""
    full = problem.paths.second * problem.paths.kappa
    a = np.maximum(full - problem.paths.signal, STEEPEST * full)
    b = full * problem.paths.alpha
    rise, dry = np.sqrt(np.maximum(here.worth, 0.0) * b) / a, b / a
    room = problem.allowed
    steps = len(dry)
    level = np.array([
        _level(rise[:, i], dry[:, i], room.peak[:, i], np.full(steps, np.inf), room.each[i] * steps)
        for i in range(dry.shape[1])
    ])  # fmt: skip
    highest = np.broadcast_to(level, dry.shape)
    y = _level(rise.ravel(), dry.ravel(), room.peak.ravel(), highest.ravel(), room.total * steps)
    return inside(_at_level(np.minimum(y, highest), rise, dry, room.peak), room)


def _at_level(
    y: Float[np.ndarray, "..."],
    rise: Float[np.ndarray, "..."],
    dry: Float[np.ndarray, "..."],
    peak: Float[np.ndarray, "..."],
) -> Float[np.ndarray, "..."]:
    """Powers min([y rise - dry]^+, peak); what nobody listens to stays dry at any level."""
    with np.errstate(invalid="ignore"):
        wet = np.where(rise > 0, y * rise - dry, 0.0)
    return np.clip(wet, 0.0, peak)


def _level(
    rise: Float[np.ndarray, "k"],
    dry: Float[np.ndarray, "k"],
    peak: Float[np.ndarray, "k"],
    highest: Float[np.ndarray, "k"],
    total: float,
) -> float:
    """The level y at which the powers sum to the total; infinite where they never do."""
    live = rise > 0
    rise, dry, peak, highest = rise[live], dry[live], peak[live], highest[live]
    if not rise.size or not np.isfinite(total):
        return np.inf
    turns = np.concatenate([dry / rise, (dry + peak) / rise, highest])
    turns = np.unique(turns[np.isfinite(turns)])
    sums = _at_level(np.minimum(turns[:, None], highest), rise, dry, peak).sum(axis=1)
    if total < sums[-1]:
        return float(np.interp(total, sums, turns))
    still = (highest > turns[-1]) & (rise * turns[-1] - dry < peak)
    return float(turns[-1] + (total - sums[-1]) / rise[still].sum()) if still.any() else np.inf


def least_power(
    paths: Paths,
    wanted: ArrayLike,
    budget: Budget | None = None,
    error: Error | None = None,
    states: tuple[str, ...] | None = None,
) -> LeastPower:
    """The smallest total power, in the mean over time, with which paths of one hop reach a wanted error.

    The error is a trace or a weighted one. `budget` holds what each transmitter may send at most.

    Raises:
        ValueError: an error that no power reaches, with the one that unlimited power leaves; paths of several hops; the
            worst direction (`semidefinite_least_power` takes it).
    """
    if isinstance(error, Error) and error.worst:
        raise fail("error of least power", "a trace", "the worst direction, which semidefinite_least_power takes")
    return cheapest(swapped(paths, budget, error, states), float(scalar("wanted error", wanted, 0.0)))


def swapped(paths: Paths, budget: Budget | None, error: Error | None, states: tuple[str, ...] | None) -> OneHop:
    """The problem without a limit of the total, which is to be small.

    Raises:
        ValueError: a budget with a total.
    """
    if budget is not None and instance("budget", budget, Budget, "a Budget").total is not None:
        raise fail("budget of least power", "limits of single transmitters, since the total is to be small", "a total")
    problem = one_hop(paths, Budget(1.0) if budget is None else budget, error, states)
    return _with_total(problem, np.inf)


def cheapest(problem: OneHop, wanted: float) -> LeastPower:
    """Least power for a wanted linear cost: the budget whose best cost it is, by a root.

    Raises:
        ValueError: a cost that no power reaches.
    """
    limit = unlimited(problem)[2].bound
    if limit >= wanted:
        raise unreachable(limit, wanted)
    silent = np.zeros_like(problem.allowed.peak)
    if problem.at(silent).value <= wanted:
        return LeastPower(silent, problem.at(silent).value, 0.0, 0.0)

    def missing(log: float) -> float:
        return fill(_with_total(problem, float(np.exp(log))))[2].error - wanted

    low = high = float(np.log(np.max(problem.paths.alpha)))
    end = high + np.log(PLENTY)
    while missing(high) > 0:
        low, high = high, high + WIDER
        if high > end:
            raise unreachable(limit, wanted)
    while missing(low) <= 0:
        low -= WIDER
    total = float(np.exp(brentq(missing, low, high, xtol=1e-14, rtol=1e-14)))
    p, here, found = fill(_with_total(problem, total))
    mean = float(p.sum(axis=1).mean())
    return LeastPower(p, found.error, mean, min(_needed(problem.allowed, p, here, wanted) * (1 - ROUNDING), mean))


def unlimited(problem: OneHop) -> tuple[Powers, Point, Allocation]:
    """The best of all powers that limits of single transmitters allow, whatever the total."""
    peak = np.minimum(problem.allowed.peak, PLENTY * problem.paths.alpha)
    return fill(problem._replace(allowed=problem.allowed._replace(peak=peak, total=np.inf)))


def unreachable(limit: float, wanted: float) -> InputError:
    """An error that no power reaches."""
    return fail("wanted error", f"one above {limit:.6g}, which unlimited power leaves", f"{wanted:.6g}")


def _with_total(problem: OneHop, total: float) -> OneHop:
    return problem._replace(allowed=problem.allowed._replace(total=total))


def _needed(allowed: Allowed, p: Powers, here: Point, wanted: float) -> float:
    """Mean power without which the tangent at p stays above what is wanted: those who help most first, by a sort.

    f(q) <= wanted takes -f'(p).q >= f(p) - wanted - f'(p).p, and to gain so much takes at least this power.
    """
    needed = here.value - wanted - float(np.sum(here.gradient * p))
    gain, left, spent = -here.gradient, allowed.each * len(p), 0.0
    for flat in np.argsort(-gain, axis=None, kind="stable"):
        k, i = np.unravel_index(flat, gain.shape)
        if needed <= 0 or gain[k, i] <= 0:
            break
        one = min(float(allowed.peak[k, i]), float(left[i]), needed / float(gain[k, i]))
        spent, left[i], needed = spent + one, left[i] - one, needed - one * float(gain[k, i])
    return spent / len(p)
