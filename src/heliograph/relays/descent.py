"""Small minimisers: BFGS with backtracking, for smooth functions that may be infinite, with few variables or many."""

from collections import deque
from collections.abc import Callable

import numpy as np

from heliograph.numerics.types import Float

Function = Callable[[np.ndarray], tuple[float, np.ndarray]]

DECREASE = 1e-4  # Armijo: least part of the predicted decrease that a step must give
SHORTEN = 0.3
SHORTEST = 1e-14
PATIENCE = 5  # steps in a row that gain nothing
MEMORY = 30  # updates that stand for the inverse Hessian of many variables


def bfgs(
    function: Function, start: Float[np.ndarray, "n"], iterations: int = 300, tolerance: float = 1e-12
) -> Float[np.ndarray, "n"]:
    """Minimise by BFGS from `start`, where the value is finite; a step to an infinite value is shortened.

    Stops after PATIENCE steps that gain less than `tolerance`, or where no step decreases the value any more.
    """
    x = np.asarray(start, dtype=np.float64)
    value, gradient = function(x)
    inverse = np.eye(len(x)) * 0.1 / max(np.linalg.norm(gradient), np.finfo(float).tiny)
    idle = 0
    for iteration in range(iterations):
        # Quasi-Newton direction; steepest descent where it is no direction of descent.
        direction = -inverse @ gradient
        if direction @ gradient >= 0:
            inverse = np.eye(len(x)) * 1e-2 / np.linalg.norm(gradient)
            direction = -inverse @ gradient
        taken = _backtrack(function, x, value, direction, float(direction @ gradient))
        if taken is None:
            break
        # BFGS update of the inverse Hessian.
        step, new_value, new_gradient = taken
        inverse = _update(inverse, step, new_gradient - gradient, first=iteration == 0)
        idle = idle + 1 if value - new_value < tolerance else 0
        x, value, gradient = x + step, new_value, new_gradient
        if idle >= PATIENCE or not np.any(gradient):
            break
    return x


def lbfgs(
    function: Function, start: Float[np.ndarray, "n"], iterations: int, tolerance: float
) -> Float[np.ndarray, "n"]:
    """Minimise like `bfgs`, for thousands of variables: the last MEMORY updates stand for the inverse Hessian."""
    x = np.asarray(start, dtype=np.float64)
    value, gradient = function(x)
    updates: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=MEMORY)
    idle = 0
    for _ in range(iterations):
        # Two-loop recursion for the quasi-Newton direction.
        direction = -_inverse_times(updates, gradient)
        taken = _backtrack(function, x, value, direction, float(direction @ gradient))
        if taken is None:
            break
        step, new_value, new_gradient = taken
        change = new_gradient - gradient
        # Curvature condition s' y > 0.
        if step @ change > 1e-12 * np.linalg.norm(step) * np.linalg.norm(change):
            updates.append((step, change))
        idle = idle + 1 if value - new_value < tolerance else 0
        x, value, gradient = x + step, new_value, new_gradient
        if idle >= PATIENCE or not np.any(gradient):
            break
    return x


def _inverse_times(
    updates: deque[tuple[np.ndarray, np.ndarray]], vector: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """H v of the updates (s, y), H = V'H_before V + s s'/s'y with V = I - y s'/s'y, H = I s'y/y'y before the first."""
    v, parts = vector, []
    for s, y in reversed(updates):
        parts.append(float(s @ v / (s @ y)))
        v = v - parts[-1] * y
    if updates:
        s, y = updates[-1]
        v = v * float(s @ y / (y @ y))
    for (s, y), part in zip(updates, reversed(parts), strict=True):
        v = v + (part - float(y @ v / (s @ y))) * s
    return v


def _backtrack(
    function: Function, x: np.ndarray, value: float, direction: np.ndarray, slope: float
) -> tuple[np.ndarray, float, np.ndarray] | None:
    length = 1.0
    while length >= SHORTEST:
        new_value, gradient = function(x + length * direction)
        if np.isfinite(new_value) and np.all(np.isfinite(gradient)) and new_value <= value + DECREASE * length * slope:
            return length * direction, new_value, gradient
        length *= SHORTEN
    return None


def _update(
    inverse: Float[np.ndarray, "n n"], s: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"], first: bool
) -> Float[np.ndarray, "n n"]:
    """H+ = (I - s y'/s'y) H (I - y s'/s'y) + s s'/s'y, skipped where the curvature s'y is not positive."""
    curvature = float(s @ y)
    if curvature <= 1e-14 * np.linalg.norm(s) * np.linalg.norm(y):
        return inverse
    if first:
        inverse = np.eye(len(s)) * curvature / float(y @ y)
    left = np.eye(len(s)) - np.outer(s, y) / curvature
    return np.asarray(left @ inverse @ left.T + np.outer(s, s) / curvature)
