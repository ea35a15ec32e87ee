"""A small minimiser: BFGS with backtracking, for smooth functions that may be infinite, with few variables or many."""

from collections import deque
from collections.abc import Callable

import numpy as np

from heliograph.numerics.types import Float

Function = Callable[[np.ndarray], tuple[float, np.ndarray]]

DECREASE = 1e-4  # Armijo: least part of the predicted decrease that a step must give
SHORTEN = 0.3  # factor of a step that does not decrease the value enough
SHORTEST = 1e-14  # share of a step: where a shorter one would be needed, none decreases the value
FIRST = 1e-2  # length of a step of steepest descent, of which nothing is known yet
CURVED, CURVED_OF_MANY = 1e-14, 1e-12  # s'y / |s| |y| above which an update is a curvature: dense, and L-BFGS
PATIENCE = 5  # steps in a row that gain nothing


def bfgs(
    function: Function,
    start: Float[np.ndarray, "n"],
    iterations: int = 300,
    tolerance: float = 1e-12,
    memory: int | None = None,
) -> Float[np.ndarray, "n"]:
    """Return a local minimum of a function, found by BFGS from `start`.

    The search ends after PATIENCE steps in a row that gain less than `tolerance`, where no step decreases the value any
    more, or after `iterations` steps. A step to an infinite value is shortened.

    Args:
        function: from x to its value and gradient.
        start: where the search begins; its value is finite.
        iterations: the most steps.
        tolerance: decrease of the value below which a step gains nothing.
        memory: how many of the last updates stand for the inverse Hessian, for thousands of variables (L-BFGS); None
            holds it whole.
    """
    x = np.asarray(start, dtype=np.float64)
    value, gradient = function(x)
    inverse_hessian = _DenseInverseHessian(gradient) if memory is None else _LimitedInverseHessian(memory)
    steps_without_gain = 0
    for _ in range(iterations):
        # Quasi-Newton direction -H g, shortened until the value decreases; then the update of H, the inverse Hessian,
        # by the step and the change of the gradient g.
        direction = -inverse_hessian.times(gradient)
        trial = _backtrack(function, x, value, direction, float(direction @ gradient))
        if trial is None:
            break
        step, new_value, new_gradient = trial
        inverse_hessian.update(step, new_gradient - gradient)
        steps_without_gain = steps_without_gain + 1 if value - new_value < tolerance else 0
        x, value, gradient = x + step, new_value, new_gradient
        if steps_without_gain >= PATIENCE or not np.any(gradient):
            break
    return x


class _DenseInverseHessian:
    """Inverse Hessian H as a matrix, first a small multiple of I and then scaled by the first update."""

    def __init__(self, gradient: np.ndarray):
        """Begin with H = I / (10 |gradient|), so that the first step, -H gradient, has length 1/10."""
        self.matrix = np.eye(len(gradient)) * 0.1 / max(np.linalg.norm(gradient), np.finfo(float).tiny)
        self.is_first_update = True

    def times(self, vector: np.ndarray) -> np.ndarray:
        """Return H v, with the inverse Hessian H = `self.matrix` and the gradient v.

        Where v'H v is not positive, a step -H v would not descend. Then H is replaced by FIRST I / |v|, so that -H v
        has the length FIRST and goes along -v.
        """
        if (self.matrix @ vector) @ vector <= 0:
            self.matrix = np.eye(len(vector)) * FIRST / np.linalg.norm(vector)
        return np.asarray(self.matrix @ vector)

    def update(self, s: np.ndarray, y: np.ndarray) -> None:
        """Update H after a step s that changed the gradient by y, unless the curvature s'y is not positive.

        H: the inverse Hessian, `self.matrix`. H+ = (I - s y'/s'y) H (I - y s'/s'y) + s s'/s'y.
        """
        curvature = float(s @ y)
        is_first = self.is_first_update
        self.is_first_update = False
        if curvature <= CURVED * np.linalg.norm(s) * np.linalg.norm(y):  # not positive beyond rounding
            return
        if is_first:  # the first H was a guess; the step has shown the curvature, so H begins as I s'y / y'y
            self.matrix = np.eye(len(s)) * curvature / float(y @ y)
        factor = np.eye(len(s)) - np.outer(s, y) / curvature  # I - s y'/s'y
        self.matrix = factor @ self.matrix @ factor.T + np.outer(s, s) / curvature


class _LimitedInverseHessian:
    """Inverse Hessian H by its last updates (s, y): steps and the changes of the gradient over them."""

    def __init__(self, memory: int):
        """Begin without updates; the newest `memory` of them are kept."""
        self.updates: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=memory)

    def times(self, vector: np.ndarray) -> np.ndarray:
        """Return H v of a `vector` v by two loops over the updates, newest first and then oldest first (L-BFGS).

        `self.updates`: pairs (s, y) of a step and of the change of the gradient over it, the newest last. An update
        makes H = V'H_before V + s s'/s'y with V = I - y s'/s'y; before the oldest, H = I s'y/y'y with the newest
        pair. The first loop applies the matrices V to v, the second V' and s s'/s'y. Without updates H = I.
        """
        v, weights = vector, []
        for s, y in reversed(self.updates):
            weight = float(s @ v / (s @ y))
            weights.append(weight)
            v = v - weight * y
        if self.updates:
            s, y = self.updates[-1]
            v = v * float(s @ y / (y @ y))
        for (s, y), weight in zip(self.updates, reversed(weights), strict=True):
            v = v + (weight - float(y @ v / (s @ y))) * s
        return v

    def update(self, s: np.ndarray, y: np.ndarray) -> None:
        """Remember a step s and its change y of the gradient, if the curvature s'y is positive beyond rounding.

        The oldest update is dropped where `memory` of them are kept already.
        """
        if s @ y > CURVED_OF_MANY * np.linalg.norm(s) * np.linalg.norm(y):
            self.updates.append((s, y))


def _backtrack(
    function: Function, x: np.ndarray, value: float, direction: np.ndarray, slope: float
) -> tuple[np.ndarray, float, np.ndarray] | None:
    """Shorten the step from x along `direction` until the value is finite and falls enough (Armijo's rule).

    The length is 1 at first, and is multiplied by SHORTEN until the value falls by at least the share DECREASE of what
    the slope promises.

    Args:
        function: from x to its value and gradient.
        x: where the step begins.
        value: that of the function at x.
        direction: of the step.
        slope: direction' gradient at x.

    Returns:
        The step, and value and gradient at its end; None if no length from SHORTEST on will do.
    """
    length = 1.0
    while length >= SHORTEST:
        new_value, gradient = function(x + length * direction)
        is_finite = np.isfinite(new_value) and np.all(np.isfinite(gradient))
        if is_finite and new_value <= value + DECREASE * length * slope:
            return length * direction, new_value, gradient
        length *= SHORTEN
    return None
