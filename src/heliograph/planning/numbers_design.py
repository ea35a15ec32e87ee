"""Designs of networks that are functions of free numbers."""

import numpy as np

from heliograph.numerics.check import fail, scalar
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.budget import Budget, allowed, as_budget
from heliograph.planning.certificate import Certificate
from heliograph.planning.criterion import Error
from heliograph.planning.free_numbers import Build, Ended, Problem, as_numbers, descend_numbers
from heliograph.planning.outcome import NetworkDesign


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
        ValueError: an error that is not the steady one, numbers that are none, no start from which a budget or a wanted
            error is met.
    """
    if error.steps > 1 or error.horizon is not None or error.worst:
        raise fail("error of a network of free numbers", "a steady weighted trace", "another")
    problem = Problem(build, as_numbers({} if free is None else free), error.matrix)
    rows, most = _limits(problem, budget)
    least = None if wanted is None else float(scalar("wanted error", wanted, 0.0))
    draws = np.random.default_rng(seed)
    begin = [problem.numbers.start, *(problem.numbers.drawn(draws) for _ in range(starts - 1))]
    best = min((descend_numbers(problem, x, rows, most, least) for x in begin), key=lambda one: one.value)
    if not np.isfinite(best.value):
        raise _unmet(problem, budget, wanted)
    return _designed(problem, best, error, starts, least is not None)


def _limits(
    problem: Problem, budget: Budget | ArrayLike | None
) -> tuple[Float[np.ndarray, "limits hops"], Float[np.ndarray, "limits"]]:
    """Finite limits as rows of the powers; one step, so that a peak is a limit of the mean."""
    hops = len(problem.names)
    if budget is None:
        return np.zeros((0, hops)), np.zeros(0)
    room = allowed(as_budget(budget), problem.names, np.ones(hops, dtype=bool), np.zeros((1, hops)))
    most = np.append(np.minimum(room.each, room.peak[0]), room.total)
    rows = np.concatenate([np.eye(hops), np.ones((1, hops))])
    kept = np.isfinite(most)
    if np.any(most[kept] <= 0):
        raise fail("budget", "limits above zero where numbers are free", "zero")
    return rows[kept], most[kept]


def _unmet(problem: Problem, budget: object, wanted: object) -> ValueError:
    start = problem.numbers.start
    found = f"from its start it sends {problem.powers(start).sum():.6g}"
    if wanted is None:
        return fail("budget", "one that is met from some start", f"none that is ({found})")
    return fail("wanted error", "one that some start reaches", f"{wanted} ({found}, error {problem.error(start):.6g})")


def _designed(problem: Problem, best: Ended, error: Error, starts: int, by_power: bool) -> NetworkDesign:
    powers = problem.powers(best.x)
    unit = "power" if by_power else "error"
    return NetworkDesign(
        powers={name: np.array([power]) for name, power in zip(problem.names, powers, strict=True)},
        error=problem.error(best.x),
        present=problem.error(problem.numbers.start),
        covariance=problem.covariance(best.x)[None],
        sensitivity=dict(zip(problem.names, [float("nan")] * len(powers), strict=True)),
        price=float("nan"),
        certificate=Certificate(False, best.value, float("-inf"), best.residual, starts, unit),
        given=problem.network(best.x),
        asked=error,
        numbers=problem.numbers.named(best.x),
    )
