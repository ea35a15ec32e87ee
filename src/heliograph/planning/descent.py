"""Small errors within a power budget: descent from a start, and Newton's method on the face where it ends."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, NonlinearConstraint, minimize

from heliograph.numerics.types import Float
from heliograph.planning.budget import Allowed
from heliograph.planning.objective import Objective

Powers = Float[np.ndarray, "time free"]

ITERATIONS = 400
FINE, COARSE = 1e-14, 1e-8  # relative change at which a descent ends, and one of many of which one will go on
SHIFT = 1e-5  # relative, of the differences of gradients that make a Hessian
OFF = 1e-7  # of the largest power: what counts as none
ROUNDS = 4  # of Newton's method
MISSED = 1e-9  # relative excess of an error that is mended afterwards


class Found(NamedTuple):
    """Powers and their error."""

    powers: Powers
    error: float


def descend(objective: Objective, limits: Allowed, start: Powers, tolerance: float = FINE) -> Found:
    """A local minimum from `start`, by sequential quadratic programmes in powers relative to the budget."""
    shape, unit = start.shape, _unit(limits, start)
    first = objective.value(start)

    def function(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = objective.value_and_gradient(np.maximum(x, 0.0).reshape(shape) * unit)
        return value / first, gradient.ravel() * unit / first

    rows, most = _rows(limits)
    constraints = [LinearConstraint(rows, -np.inf, most / unit)] if len(rows) else []
    bounds = Bounds(np.zeros(start.size), limits.peak.ravel() / unit)
    result = minimize(function, start.ravel() / unit, jac=True, bounds=bounds, constraints=constraints,
                      method="SLSQP", options={"ftol": tolerance, "maxiter": ITERATIONS})  # fmt: skip
    found = _inside(limits, np.clip(result.x.reshape(shape) * unit, 0.0, limits.peak))
    value = objective.value(found)
    return Found(found, value) if value < first else Found(start, first)


def lower_total(objective: Objective, limits: Allowed, wanted: float, start: Powers, tolerance: float = FINE) -> Powers:
    """Powers of a locally least total whose error is no larger than wanted, from some that reach it."""
    shape, unit = start.shape, max(float(start.mean(axis=0).sum()), np.finfo(float).tiny)

    def room(x: np.ndarray) -> np.ndarray:
        return np.array([1.0 - objective.value(np.maximum(x, 0.0).reshape(shape) * unit) / wanted])

    def slope(x: np.ndarray) -> np.ndarray:
        return -objective.value_and_gradient(np.maximum(x, 0.0).reshape(shape) * unit)[1].ravel() * unit / wanted

    price = np.full(start.size, 1 / len(start))
    rows, most = _rows(limits._replace(total=np.inf))
    constraints: list[LinearConstraint | NonlinearConstraint] = [NonlinearConstraint(room, 0.0, np.inf, slope)]
    if len(rows):
        constraints.append(LinearConstraint(rows, -np.inf, most / unit))

    def total(x: np.ndarray) -> tuple[float, np.ndarray]:
        return float(price @ x), price

    result = minimize(total, start.ravel() / unit, jac=True, method="SLSQP",
                      bounds=Bounds(np.zeros(start.size), limits.peak.ravel() / unit), constraints=constraints,
                      options={"ftol": tolerance, "maxiter": ITERATIONS})  # fmt: skip
    found = _inside(limits._replace(total=np.inf), np.clip(result.x.reshape(shape) * unit, 0.0, limits.peak))
    better = found.mean(axis=0).sum() < start.mean(axis=0).sum() and room(found.ravel() / unit)[0] > -MISSED
    return found if better else start


def polish(objective: Objective, limits: Allowed, found: Found) -> Found:
    """Newton's method on the face of the budget where a descent ended, kept while the error does not rise.

    The step solves H d + A' l = -g, A d = 0 over the powers that are neither zero nor at their peak, with A the limits
    that are reached and H by differences of the gradient.
    """
    for _ in range(ROUNDS):
        step = _newton(objective, limits, found.powers)
        if step is None:
            break
        tried = _inside(limits, np.clip(found.powers + step, 0.0, limits.peak))
        value = objective.value(tried)
        if not value <= found.error * (1 + 1e-15):
            break
        found = Found(tried, value)
    return found


def _newton(objective: Objective, limits: Allowed, powers: Powers) -> Powers | None:
    shape, size = powers.shape, max(float(powers.max(initial=0.0)), np.finfo(float).tiny)
    inside = (powers > OFF * size) & (powers < limits.peak * (1 - OFF))
    index = np.flatnonzero(inside)
    if not len(index):
        return None
    hessian = np.empty((len(index), len(index)))
    for column, flat in enumerate(index):
        shift = np.zeros(powers.size)
        shift[flat] = SHIFT * powers.ravel()[flat]
        above, below = (objective.value_and_gradient(powers + sign * shift.reshape(shape))[1] for sign in (1, -1))
        hessian[:, column] = (above - below).ravel()[index] / (2 * shift[flat])
    gradient = objective.value_and_gradient(powers)[1].ravel()[index]
    rows, most = _rows(limits)
    reached = rows @ powers.ravel() >= most * (1 - OFF)
    face = rows[reached][:, index]
    face = face[np.abs(face).sum(axis=1) > 0]
    scale = powers.ravel()[index]
    system = np.block([
        [scale[:, None] * (hessian + hessian.T) / 2 * scale, scale[:, None] * face.T],
        [face * scale, np.zeros((len(face), len(face)))],
    ])  # fmt: skip
    right = np.concatenate([-scale * gradient, np.zeros(len(face))])
    solved = np.linalg.lstsq(system, right, rcond=1e-14)[0][: len(index)]
    step = np.zeros(powers.size)
    step[index] = scale * solved
    return step.reshape(shape)


def _unit(limits: Allowed, start: Powers) -> float:
    """What powers are counted in."""
    finite = [limits.total, *limits.peak[np.isfinite(limits.peak)], float(start.max(initial=0.0))]
    return max((one for one in finite if np.isfinite(one)), default=1.0) or 1.0


def _rows(limits: Allowed) -> tuple[Float[np.ndarray, "limits entries"], Float[np.ndarray, "limits"]]:
    """Limits of means over time as rows of the entries, and their values."""
    steps, count = limits.peak.shape
    bounded = np.flatnonzero(np.isfinite(limits.each)) if steps > 1 or count > 0 else np.zeros(0, dtype=int)
    rows = [np.tile(np.eye(count)[h], steps) / steps for h in bounded]
    most = list(limits.each[bounded])
    if np.isfinite(limits.total):
        rows.append(np.ones(steps * count) / steps)
        most.append(limits.total)
    return np.array(rows).reshape(-1, steps * count), np.array(most)


def _inside(limits: Allowed, powers: Powers) -> Powers:
    """The powers, less what rounding puts above a limit."""
    mean = powers.mean(axis=0)
    own = np.divide(limits.each, mean, out=np.ones_like(mean), where=mean > limits.each)
    powers = powers * own
    total = powers.mean(axis=0).sum()
    return powers * (limits.total / total) if total > limits.total else powers
