"""Designs of networks that are functions of free numbers."""

import numpy as np

from heliograph.numerics.check import fail, scalar
from heliograph.numerics.types import ArrayLike
from heliograph.planning.budget import Allowed, Budget, allowed, as_budget
from heliograph.planning.certificate import Certificate
from heliograph.planning.criterion import Error
from heliograph.planning.free_numbers import Build, as_numbers, check_arguments, marked
from heliograph.planning.numbers_descent import Ended, Limits, descend_numbers, limits_of
from heliograph.planning.numbers_problem import Problem
from heliograph.planning.outcome import NetworkDesign
from heliograph.planning.repeated import repeated


def design_numbers(
    build: Build,
    free: object,
    error: Error,
    budget: Budget | ArrayLike | None,
    wanted: ArrayLike | None,
    starts: int,
    seed: int,
) -> NetworkDesign:
    """`design` of a network that is a function of free numbers: the best of several descents, a budget if there is one.

    Raises:
        ValueError: no start from which a budget or a wanted error is met, a network that does not fit the error.
    """
    check_arguments(build, free)
    problem = Problem(*(marked(build) if free is None else (build, as_numbers(free))), error)
    least = None if wanted is None else float(scalar("wanted error", wanted, 0.0))
    if least == 0:
        raise fail("wanted error", "a number above zero", "0")
    problem.at(problem.numbers.start)  # what cannot be is refused before any descent
    problem.check_ends()
    limits = limits_of(_allowed(problem, budget), least, (error.steps, len(problem.names)))
    best = _best(problem, limits, starts, seed)
    if not np.isfinite(best.value):
        raise _unmet(problem, limits, starts, seed)
    return _designed(problem, best, starts, least is not None)


def _best(problem: Problem, limits: Limits, starts: int, seed: int) -> Ended:
    draws = np.random.default_rng(seed)
    begin = [problem.numbers.start, *(problem.numbers.drawn(draws) for _ in range(starts - 1))]
    return min((descend_numbers(problem, x, limits) for x in begin), key=lambda one: one.value)


def _allowed(problem: Problem, budget: Budget | ArrayLike | None) -> Allowed | None:
    if budget is None:
        return None
    hops = len(problem.names)
    room = allowed(as_budget(budget), problem.names, np.ones(hops, dtype=bool), np.zeros((problem.asked.steps, hops)))
    if min(np.min(room.peak, initial=np.inf), np.min(room.each, initial=np.inf), room.total) <= 0:
        raise fail("budget", "limits above zero where numbers are free", "zero")
    return room


def _unmet(problem: Problem, limits: Limits, starts: int, seed: int) -> ValueError:
    """What is least where the limits cannot be met: the error within them, or the power that is sent in any case."""
    if limits.wanted is not None:
        found = _best(problem, limits._replace(wanted=None), starts, seed)
        if np.isfinite(found.value):
            least = f"at least {found.value:.6g}, the least found from {starts} starts"
            return fail("wanted error", least, f"{limits.wanted:.6g}")
    unlimited = Limits(limits.rows[:0], limits.most[:0], np.inf)
    power = _best(problem, unlimited, starts, seed).value
    found_power = f"a total power of {power:.6g} is the least found"
    return fail("budget", f"one that is met from some of {starts} starts ({found_power})", "none that is")


def _designed(problem: Problem, best: Ended, starts: int, by_power: bool) -> NetworkDesign:
    now = problem.at(best.x)
    network = problem.network(best.x)
    before = problem.at(problem.numbers.start)
    error = problem.weighing.exact(now.covariances)
    value, unit = (best.value, "power") if by_power else (error, "error")
    return NetworkDesign(
        powers=dict(zip(problem.names, now.powers.T, strict=True)),
        error=error,
        present=problem.weighing.exact(before.covariances),
        covariance=now.covariances,
        sensitivity=dict(zip(problem.names, (-best.worth.sum(axis=0)).tolist(), strict=True)),
        price=float(np.max(best.worth, initial=0.0) * problem.asked.steps),
        certificate=Certificate(False, value, float("-inf"), best.residual, starts, unit),
        given=repeated(network) if problem.asked.period > 1 else network,
        asked=problem.asked,
        numbers=problem.numbers.named(best.x),
    )
