"""Designs of networks that are functions of free numbers."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from heliograph.numerics.check import check_count, check_seed, fail, scalar
from heliograph.numerics.types import Float
from heliograph.planning.design_problem import Certificate, DesignProblem, PowerDesign
from heliograph.planning.free_numbers.problem import Build, FreeNumberProblem, read_free_numbers
from heliograph.planning.network_from_design import repeat_network
from heliograph.planning.power_budget import PowerLimits, make_budget, make_power_limits, make_unlimited
from heliograph.planning.sequential_quadratic_programming import (
    ACTIVE_ROOM,
    DescentProblem,
    PowerAndErrorLimits,
    ScaledProgramme,
    Vector,
    search_from_starts,
)


class LagrangeConditions(NamedTuple):
    """Lagrange's conditions at a point: the value, what they leave of it, and a watt's worth.

    Args:
        value: what is minimised, the error, or the mean power where an error is the target.
        residual: the part of the value by which a linear model still sees it fall within the limits, over a step of the
            numbers' own size; 0 at a minimum.
        worth: the error that one more watt takes away at each step of each transmitter, where its own limits rise too
            (time, hops).
        price: that of a watt more of the total, or of one transmitter where no total limits.
    """

    value: float
    residual: float
    worth: Float[np.ndarray, "time hops"]
    price: float


def design_numbers(task: DesignProblem, build: Build) -> PowerDesign:
    """Return the design of a network that is a function of free numbers: the best of several descents.

    The free numbers, such as gains or powers, are chosen so that the filters' error is least under limits of power, or
    that the power is least with which a target error is met. The problem is not convex, so there are several starts.

    Args:
        task: the free numbers with their domains, the error (`criterion`), the budget of powers, and the target error,
            starts and seed.
        build: makes the network, from the free numbers as keyword arguments.

    Returns:
        The numbers found, the powers of each transmitter, the error, and what Lagrange's conditions say of it.

    Raises:
        ValueError: no start from which a budget or a target error is met, a network that does not fit the error.
    """
    starts, seed = check_count("starts", task.starts), check_seed("seed", task.seed)
    problem = FreeNumberProblem(*read_free_numbers(build, task.free), task.criterion)
    target = None if task.target_error is None else float(scalar("target error", task.target_error, 0.0))
    if target == 0:
        raise fail("target error", "a number above zero", "0")
    # Numbers of which no network can be made are refused before any descent: at the start, and near their ends.
    present = problem.solve_at(problem.numbers.start)
    problem.check_ends()
    # The best of descents from the start, and from points that are drawn.
    allowed = _limit_all_powers(problem, task.budget)
    limits = _make_limit_rows(allowed, target)
    draws = np.random.default_rng(seed)
    points = [problem.numbers.start, *(problem.numbers.draw_start(draws) for _ in range(starts - 1))]
    descent = problem.descent_problem()
    best = search_from_starts(descent, limits, points)
    if best is None:
        raise _make_unmet_limits_error(descent, limits, points)
    # The design, and what Lagrange's conditions say of it. The problem is not convex: there is no lower bound. With a
    # target what was minimised is the power, else the error.
    has_total = bool(np.isfinite(allowed.total))
    found, conditions = problem.solve_at(best), evaluate_lagrange_conditions(descent, limits, best, has_total)
    network = problem.network(best)
    error = problem.criterion.compute_exact_error(found.covariances)
    value, unit = (error, "error") if target is None else (conditions.value, "power")
    certificate = Certificate(
        convex=False, value=value, bound=float("-inf"), stationarity=conditions.residual, starts=starts, unit=unit
    )
    return PowerDesign(
        problem=task,
        powers=dict(zip(problem.names, found.powers.T, strict=True)),
        error=error,
        certificate=certificate,
        present=problem.criterion.compute_exact_error(present.covariances),
        covariance=found.covariances,
        sensitivity=dict(zip(problem.names, (-conditions.worth.sum(axis=0)).tolist(), strict=True)),
        price=conditions.price,
        numbers=problem.numbers.split_by_name(best),
        realised=repeat_network(network) if task.criterion.period > 1 else network,
    )


def _limit_all_powers(problem: FreeNumberProblem, budget: object) -> PowerLimits:
    """Return the limits that a budget sets to the powers of all transmitters (steps, hops), or none without budget.

    Args:
        problem: the network as a function of free numbers; names its transmitters.
        budget: the budget, a number for the total power, or None.
    """
    steps, hops = problem.error.steps, len(problem.names)
    if budget is None:
        return make_unlimited(steps, hops)
    # All hops may change their powers, and none sends a fixed one.
    all_are_free = np.ones(hops, dtype=bool)
    no_fixed_powers = np.zeros((steps, hops))
    limits = make_power_limits(make_budget(budget), problem.names, all_are_free, no_fixed_powers)
    if min(np.min(limits.peak, initial=np.inf), np.min(limits.mean, initial=np.inf), limits.total) <= 0:
        raise fail("budget", "limits above zero where numbers are free", "zero")
    return limits


def _make_limit_rows(allowed: PowerLimits, target: float | None) -> PowerAndErrorLimits:
    """Return the finite limits of a budget as rows @ powers.ravel() <= most, and the target error (None without one).

    Peaks are limits like others here, since powers are not the free numbers. A row of a peak is one power divided by
    its peak, so that its limit is 1.

    Args:
        allowed: limits of the powers, infinite where there is none.
        target: the target error, or None.
    """
    rows, most = allowed.make_limit_rows()
    peaks = allowed.peak.ravel()
    is_limited = np.isfinite(peaks)
    row_of_each_peak = np.eye(peaks.size) / np.where(is_limited, peaks, 1.0)[:, None]
    peak_rows = row_of_each_peak[is_limited]
    return PowerAndErrorLimits(
        rows=np.concatenate([peak_rows, rows]),
        most=np.concatenate([np.ones(len(peak_rows)), most]),
        target=target,
        steps=len(allowed.peak),
    )


def _make_unmet_limits_error(problem: DescentProblem, limits: PowerAndErrorLimits, begin: list[Vector]) -> ValueError:
    """Return the error for limits that no start meets: it names the least error within them, or the least power.

    A programme's `size` is the minimised number at its start, here at the best
    point that a search found.

    Args:
        problem: the function of the free numbers that is minimised.
        limits: the limits that no start meets.
        begin: the starts that were tried.
    """
    starts, sharpest = len(begin), problem.sharpnesses[-1]
    # If the limits of power can be met, the target error cannot: find the least error within them.
    if limits.target is not None:
        no_target = limits._replace(target=None)
        best = search_from_starts(problem, no_target, begin)
        if best is not None:
            # Without a target a programme minimises the error, so its value at a start is an error.
            error = ScaledProgramme(problem, no_target, sharpest, best).size
            return fail(
                "target error", f"at least {error:.6g}, the least found from {starts} starts", f"{limits.target:.6g}"
            )
    # Else the limits of power cannot be met: find the least total power. With a target a programme minimises the power,
    # and an infinite target is met by all points.
    no_limit = PowerAndErrorLimits(rows=limits.rows[:0], most=limits.most[:0], target=np.inf, steps=limits.steps)
    best = search_from_starts(problem, no_limit, begin)
    power = np.inf if best is None else ScaledProgramme(problem, no_limit, sharpest, best).size
    expected = f"one that is met from some of {starts} starts (a total power of {power:.6g} is the least found)"
    return fail("budget", expected, "none that is")


def _find_multipliers(programme: ScaledProgramme, problem: DescentProblem, x: Vector) -> tuple[Vector, float]:
    """Return the multipliers m >= 0 of the limits (limits,), 0 where one is not reached, and |gradient - normals' m|.

    The normals are those of the limits that are reached, of powers (the target error last) and of the ends of the
    numbers' ranges. At a minimum they make up the whole gradient, and nothing is left of it.

    Args:
        programme: the objective and the limits, as functions of z = x / unit.
        problem: the ranges and units of the numbers.
        x: values of the free numbers.
    """
    z = x / problem.unit
    gradient = programme.objective(z).slope
    reached = programme.limit_room(z) < ACTIVE_ROOM
    axes = np.eye(len(z))
    at_low = x <= problem.low + ACTIVE_ROOM * problem.unit
    at_high = x >= problem.high - ACTIVE_ROOM * problem.unit
    normals = [*programme.limit_room_slope(z)[reached], *axes[at_low], *-axes[at_high]]
    multipliers = np.zeros(len(reached))
    if not normals:
        return multipliers, float(np.linalg.norm(gradient))
    solution, residual = nnls(np.array(normals).T, gradient)  # least squares with m >= 0
    multipliers[reached] = solution[: int(reached.sum())]
    return multipliers, residual


def evaluate_lagrange_conditions(
    problem: DescentProblem, limits: PowerAndErrorLimits, x: Vector, has_total: bool
) -> LagrangeConditions:
    """Return Lagrange's conditions at the point x: how far the gradient is from a sum of the reached limits' normals.

    The multipliers m >= 0 minimise |gradient - normals' m|; in a minimum nothing of the gradient is left. They say what
    a watt more is worth.

    Args:
        problem: the function of the free numbers that is minimised, their ranges and units.
        limits: upper limits of powers, and the target error where there is one (then the power is minimised).
        x: values of the free numbers.
        has_total: whether the last of the limits of powers is that of the total.
    """
    # The programme counts numbers in their units, z = x / unit, and values in that at x, `programme.size`.
    programme = ScaledProgramme(problem, limits, problem.sharpnesses[-1], x)
    z = x / problem.unit
    value = programme.objective(z).value
    multipliers, residual = _find_multipliers(programme, problem, x)
    # The worth of a watt of each transmitter at each step, from the multipliers of the limits of power; of the total's
    # alone that of a watt more of the total. A watt at every step, sent at one step, is worth `steps` times as much.
    worths = limits.rows * multipliers[: len(limits.most), None] * programme.size  # (limits, time and hops)
    worth = worths.sum(axis=0)
    price = np.max(worths[-1] if has_total else worth, initial=0.0) * limits.steps
    if limits.target is not None:
        # With a target the value is the mean power. A watt at one step costs 1 / steps of it, and what limits add
        # (`worth`). Divided by the target's multiplier, power per error, that is the error that the watt takes away.
        power_per_error = multipliers[-1] * programme.size / limits.target
        worth = (worth + 1 / limits.steps) / power_per_error if power_per_error > 0 else np.zeros_like(worth)
        price = 1 / power_per_error if power_per_error > 0 else 0.0
    return LagrangeConditions(
        value=value * programme.size,
        residual=residual / max(value, 1e-300),
        worth=worth.reshape(limits.steps, -1),
        price=float(price),
    )
