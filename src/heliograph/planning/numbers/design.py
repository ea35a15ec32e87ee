"""Designs of networks that are functions of free numbers."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from heliograph.numerics.check import check_count, check_seed, fail, scalar
from heliograph.numerics.types import Float
from heliograph.planning.budget import PowerLimits, check_budget, make_power_limits, make_unlimited
from heliograph.planning.network_of_design import repeat_network
from heliograph.planning.numbers.problem import Build, NumberProblem, read_free_numbers
from heliograph.planning.problem import Certificate, DesignProblem, PowerDesign
from heliograph.planning.quadratic_programme import ACTIVE, Limits, Problem, Programme, Vector, search


class Conditions(NamedTuple):
    """Lagrange's conditions at a point: the value, what they leave of it, and a watt's worth.

    residual: the part of the value by which a linear model still sees it fall within the limits, over a step of the
    numbers' own size. worth: the error that one more watt takes away at each step of each transmitter.
    """

    value: float
    residual: float
    worth: Float[np.ndarray, "time hops"]


def design_numbers(task: DesignProblem, build: Build) -> PowerDesign:
    """Return the design of a network that is a function of free numbers: the best of several descents.

    Raises:
        ValueError: no start from which a budget or a target error is met, a network that does not fit the error.
    """
    starts, seed = check_count("starts", task.starts), check_seed("seed", task.seed)
    problem = NumberProblem(*read_free_numbers(build, task.free), task.criterion)
    target = None if task.target_error is None else float(scalar("target error", task.target_error, 0.0))
    if target == 0:
        raise fail("target error", "a number above zero", "0")
    # What cannot be is refused before any descent.
    before = problem.at(problem.numbers.start)
    problem.check_ends()
    limits = _make_limit_rows(_limit_powers(problem, task.budget), target)
    draws = np.random.default_rng(seed)
    begin = [problem.numbers.start, *(problem.numbers.drawn(draws) for _ in range(starts - 1))]
    descent = problem.descent_problem()
    best = search(descent, limits, begin)
    if best is None:
        raise _explain_unmet(descent, limits, begin)
    # The design, and what Lagrange's conditions say of it.
    now, conditions = problem.at(best), check_lagrange_conditions(descent, limits, best)
    network, error = problem.network(best), problem.criterion.exact(now.covariances)
    value, unit = (error, "error") if target is None else (conditions.value, "power")
    return PowerDesign(
        problem=task,
        powers=dict(zip(problem.names, now.powers.T, strict=True)),
        error=error,
        certificate=Certificate(False, value, float("-inf"), conditions.residual, starts, unit),
        present=problem.criterion.exact(before.covariances),
        covariance=now.covariances,
        sensitivity=dict(zip(problem.names, (-conditions.worth.sum(axis=0)).tolist(), strict=True)),
        price=float(np.max(conditions.worth, initial=0.0) * limits.steps),
        numbers=problem.numbers.named(best),
        realised=repeat_network(network) if task.criterion.period > 1 else network,
    )


def _limit_powers(problem: NumberProblem, budget: object) -> PowerLimits:
    """Return the limits of the transmitters' powers that a budget sets; none without a budget."""
    steps, hops = problem.error.steps, len(problem.names)
    if budget is None:
        return make_unlimited(steps, hops)
    limits = make_power_limits(check_budget(budget), problem.names, np.ones(hops, dtype=bool), np.zeros((steps, hops)))
    if min(np.min(limits.peak, initial=np.inf), np.min(limits.mean, initial=np.inf), limits.total) <= 0:
        raise fail("budget", "limits above zero where numbers are free", "zero")
    return limits


def _make_limit_rows(allowed: PowerLimits, target: float | None) -> Limits:
    """Return the finite limits of a budget as rows of all powers; peaks too, since powers are no free numbers here."""
    rows, most = allowed.rows()
    peak = allowed.peak.ravel()
    finite = np.isfinite(peak)
    peaks = (np.eye(peak.size) / np.where(finite, peak, 1.0)[:, None])[finite]
    return Limits(np.concatenate([peaks, rows]), np.concatenate([np.ones(len(peaks)), most]), target, len(allowed.peak))


def _explain_unmet(problem: Problem, limits: Limits, begin: list[Vector]) -> ValueError:
    """Error that says what is least where limits cannot be met: the error within them, or the power sent anyway."""
    starts, sharpest = len(begin), problem.sharpnesses[-1]
    if limits.target is not None:
        best = search(problem, limits._replace(target=None), begin)
        if best is not None:
            error = Programme(problem, limits._replace(target=None), sharpest, best).size
            return fail(
                "target error", f"at least {error:.6g}, the least found from {starts} starts", f"{limits.target:.6g}"
            )
    free = Limits(limits.rows[:0], limits.most[:0], np.inf, limits.steps)
    best = search(problem, free, begin)
    power = np.inf if best is None else Programme(problem, free, sharpest, best).size
    expected = f"one that is met from some of {starts} starts (a total power of {power:.6g} is the least found)"
    return fail("budget", expected, "none that is")


def check_lagrange_conditions(problem: Problem, limits: Limits, x: Vector) -> Conditions:
    """Return the multipliers of the limits that leave least of the gradient, what they leave, and a watt's worth."""
    programme, z = Programme(problem, limits, problem.sharpnesses[-1], x), x / problem.unit
    value, gradient = programme.value(z)
    reached = programme.room(z) < ACTIVE
    # Normals of the limits that are reached: of powers and target, and of the numbers' ends.
    sides = np.eye(len(z))
    low, high = x <= problem.low + ACTIVE * problem.unit, x >= problem.high - ACTIVE * problem.unit
    normals = [*programme.room_slope(z)[reached], *sides[low], *-sides[high]]
    multipliers, left = np.zeros(len(reached)), float(np.linalg.norm(gradient))
    if normals:
        solution, left = nnls(np.array(normals).T, gradient)
        multipliers[reached] = solution[: int(reached.sum())]
    # A watt's worth, from the multipliers of the limits of power.
    worth = limits.rows.T @ multipliers[: len(limits.most)] * programme.size
    if limits.target is not None:
        of_error = multipliers[-1] * programme.size / limits.target  # the power that one less of the error costs
        worth = (worth + 1 / limits.steps) / of_error if of_error > 0 else np.zeros_like(worth)
    return Conditions(value * programme.size, left / max(value, 1e-300), worth.reshape(limits.steps, -1))
