"""Descent of free numbers: a sequential quadratic programme, and Lagrange's conditions where it ends."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import Bounds, NonlinearConstraint, minimize, nnls

from heliograph.numerics.types import Float
from heliograph.planning.budget import Allowed
from heliograph.planning.free_numbers import Vector
from heliograph.planning.numbers_problem import Point, Problem
from heliograph.planning.weighing import Weighing

ITERATIONS, FINE = 300, 1e-13
ROUNDS = 4  # of a descent begun again where it ended, its Hessian forgotten
AT = 1e-7  # relative: how near a limit is one that is reached
FEASIBLE = 1e-7  # relative excess over a limit that counts as none

Powers = Float[np.ndarray, "time hops"]


class Limits(NamedTuple):
    """rows @ (powers, flat) <= most; error <= wanted if given."""

    rows: Float[np.ndarray, "limits entries"]
    most: Float[np.ndarray, "limits"]
    wanted: float | None


class Ended(NamedTuple):
    """Where a descent ended, what it made small, how far Lagrange's conditions are from holding, and a watt's worth.

    residual: the part of the value by which a linear model still sees it fall within the limits, over a step of the
    numbers' own size. worth: the error that one more watt takes away at each step of each transmitter.
    """

    x: Vector
    value: float
    residual: float
    worth: Powers


def limits_of(allowed: Allowed | None, wanted: float | None, shape: tuple[int, int]) -> Limits:
    """The finite limits of a budget as rows of all powers."""
    steps, hops = shape
    if allowed is None:
        return Limits(np.zeros((0, steps * hops)), np.zeros(0), wanted)
    each = np.tile(np.eye(hops), steps) / steps
    rows = np.concatenate([np.eye(steps * hops), each, np.ones((1, steps * hops)) / steps])
    most = np.concatenate([allowed.peak.ravel(), allowed.each, [allowed.total]])
    kept = np.isfinite(most)
    return Limits(rows[kept], most[kept], wanted)


class _Scaled(NamedTuple):
    """A problem in numbers z = x / unit, with values and rooms relative to their own sizes."""

    problem: Problem
    limits: Limits
    weighing: Weighing
    unit: Vector
    size: float

    def point(self, z: np.ndarray) -> Point | None:
        """None where the network cannot be: its error or powers grow without limit."""
        try:
            return self.problem.at(np.asarray(z * self.unit), self.weighing)
        except ValueError:
            return None

    def value(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        """The error, or the total power where an error is wanted, and its derivative."""
        now = self.point(z)
        if now is None:
            return np.inf, np.zeros_like(z)
        if self.limits.wanted is None:
            return now.error / self.size, now.slopes.error * self.unit / self.size
        steps = len(now.powers)
        slope = now.slopes.powers.sum(axis=(0, 1)) / steps
        return float(now.powers.sum()) / steps / self.size, slope * self.unit / self.size

    def room(self, z: np.ndarray) -> np.ndarray:
        """What is left of each limit, as a part of it; of the wanted error last."""
        rows, most, wanted = self.limits
        now = self.point(z)
        if now is None:
            return np.full(len(most) + (wanted is not None), -1.0)
        left = 1 - rows @ now.powers.ravel() / most
        return left if wanted is None else np.append(left, 1 - now.error / wanted)

    def slope(self, z: np.ndarray) -> np.ndarray:
        """Its derivative."""
        rows, most, wanted = self.limits
        now = self.point(z)
        if now is None:
            return np.zeros((len(most) + (wanted is not None), len(z)))
        slopes = now.slopes.powers.reshape(-1, len(z))
        own = -(rows @ slopes) / most[:, None] * self.unit
        return own if wanted is None else np.vstack([own, -now.slopes.error * self.unit / wanted])

    def ends(self) -> Bounds:
        """Of z."""
        low, high = self.problem.numbers.ends
        return Bounds(low / self.unit, high / self.unit)


def descend_numbers(problem: Problem, start: Vector, limits: Limits) -> Ended:
    """The least error within the limits, or the least mean total power with an error no larger than wanted.

    Infinite where no numbers were found within the limits.
    """
    scaled = _scaled(problem, start, limits)
    if scaled is None:
        return _nowhere(problem, start)
    z = start / scaled.unit
    for weighing in problem.weighing.sharper():
        scaled = scaled._replace(weighing=weighing)
        z = _descended(scaled, z)
    if np.any(scaled.room(z) < -FEASIBLE):
        z = _descended(scaled, _mended(scaled, z))
    if scaled.point(z) is None or np.any(scaled.room(z) < -FEASIBLE):
        return _nowhere(problem, start)
    return _ended(scaled, z)


def _scaled(problem: Problem, start: Vector, limits: Limits) -> _Scaled | None:
    low, high = problem.numbers.ends
    unit = np.maximum(np.where(np.isfinite(high - low), high - low, np.abs(start)), 1e-12)
    try:
        now = problem.at(start)
    except ValueError:
        return None
    size = now.error if limits.wanted is None else max(float(now.powers.sum()) / len(now.powers), 1e-12)
    return _Scaled(problem, limits, problem.weighing, unit, size)


def _descended(scaled: _Scaled, z: np.ndarray) -> np.ndarray:
    """Sequential quadratic programmes, begun again while that lowers the value."""
    constraints = []
    if len(scaled.limits.most) or scaled.limits.wanted is not None:
        constraints = [NonlinearConstraint(scaled.room, 0.0, np.inf, scaled.slope)]
    for _ in range(ROUNDS):
        before = scaled.value(z)[0]
        feasible = bool(np.all(scaled.room(z) >= -FEASIBLE))
        again = _programme(scaled.value, z, scaled.ends(), constraints)
        after, fits = scaled.value(again)[0], bool(np.all(scaled.room(again) >= -FEASIBLE))
        if feasible and not (fits and after < before):
            break
        z = again
        if feasible and before - after <= FINE * abs(before):
            break
    return z


def _mended(scaled: _Scaled, z: np.ndarray) -> np.ndarray:
    """The nearest that a descent of the broken limits alone comes to keeping them."""

    def excess(at: np.ndarray) -> tuple[float, np.ndarray]:
        broken = np.minimum(scaled.room(at), 0.0)
        return float(broken @ broken), 2 * broken @ scaled.slope(at)

    return _programme(excess, z, scaled.ends(), [])


def _programme(
    value: Callable[[np.ndarray], tuple[float, np.ndarray]],
    z: np.ndarray,
    ends: Bounds,
    constraints: list[NonlinearConstraint],
) -> np.ndarray:
    result = minimize(value, z, jac=True, method="SLSQP", bounds=ends, constraints=constraints,
                      options={"ftol": FINE, "maxiter": ITERATIONS})  # fmt: skip
    found = np.clip(result.x, ends.lb, ends.ub)
    return found if np.all(np.isfinite(found)) else z


def _ended(scaled: _Scaled, z: np.ndarray) -> Ended:
    """What Lagrange's conditions say: the multipliers that leave least of the gradient, and what they leave."""
    now, x, unit = scaled.point(z), z * scaled.unit, scaled.unit
    assert now is not None
    low, high = scaled.problem.numbers.ends
    value, gradient = scaled.value(z)
    reached = scaled.room(z) < AT
    sides = np.eye(len(z))
    normals = [*scaled.slope(z)[reached], *sides[x <= low + AT * unit], *-sides[x >= high - AT * unit]]
    multipliers, left = np.zeros(len(reached)), float(np.linalg.norm(gradient))
    if normals:
        solved, left = nnls(np.array(normals).T, gradient)
        multipliers[reached] = solved[: int(reached.sum())]
    worth = _worth(scaled, multipliers).reshape(now.powers.shape)
    return Ended(x, value * scaled.size, left / max(value, 1e-300), worth)


def _worth(scaled: _Scaled, multipliers: np.ndarray) -> np.ndarray:
    """The error that one more watt takes away, by entry of the powers, as far as limits of power hold it up."""
    rows, most, wanted = scaled.limits
    of_powers = rows.T @ (multipliers[: len(most)] / most) * scaled.size
    if wanted is None:
        return np.asarray(of_powers)
    of_error = multipliers[-1] * scaled.size / wanted  # the power that one less of the error costs
    steps = scaled.problem.asked.steps
    return np.asarray((of_powers + 1 / steps) / of_error if of_error > 0 else np.zeros_like(of_powers))


def _nowhere(problem: Problem, start: Vector) -> Ended:
    return Ended(start, np.inf, np.inf, np.zeros((problem.asked.steps, len(problem.names))))
