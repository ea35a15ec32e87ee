"""Paths of one hop each: the error is convex in the powers, and a bound of the best needs one gradient and a sort.

With s = E y^2, t = s - Var v, a = s kappa - t and b = s kappa alpha a path carries j = p / (a p + b), concave in p; the
error is convex and decreasing in the j. So for any powers p and any q within the budget
  f(q) >= f(p) + f'(p).(q - p) >= f(p) - max_q (-f'(p)).(q - p),
and the budget's polytope is one over which a linear function is made large by a sort.
"""

from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import fail, instance, names
from heliograph.numerics.types import Float
from heliograph.planning.adjoint import covariances
from heliograph.planning.budget import Allowed, allowed, as_budget
from heliograph.planning.criterion import Error
from heliograph.planning.paths import Paths, Powers, heard, informations, sensitivities


class Point(NamedTuple):
    """A linear cost of the error covariances at some powers: value, -d/dj of each path, and the gradient by powers."""

    value: float
    worth: Powers
    gradient: Powers


class OneHop(NamedTuple):
    """The problem: paths, weights W of the error covariance at each step, and the powers that are allowed."""

    paths: Paths
    weights: Float[np.ndarray, "time n n"]
    allowed: Allowed

    def at(self, powers: Powers) -> Point:
        """Cost and gradient, by one adjoint recursion."""
        each = heard(self.paths, powers)
        p = covariances(self.paths.plants, informations(self.paths, each.information))
        worth = sensitivities(self.paths, each.information, p, self.weights)
        return Point(float(np.einsum("tij,tji->", self.weights, p)), worth, -worth * each.slope)

    def bound(self, point: Point, powers: Powers) -> float:
        """What no allowed powers come below, from the convex function's tangent at these."""
        best = self.allowed.most(-point.gradient)
        return point.value - float(np.sum(point.gradient * (powers - best)))


def one_hop(paths: Paths, budget: object, error: Error | None, states: tuple[str, ...] | None = None) -> OneHop:
    """The problem of powers for paths of one hop, for a trace.

    Raises:
        ValueError: paths of several hops, an error over other steps than the paths.
    """
    instance("paths", paths, Paths, "Paths (independent_paths, paths_of)")
    error = Error() if error is None else instance("error", error, Error, "an Error")
    steps, hops = paths.kappa.shape
    if hops != paths.rows.shape[1]:
        raise fail("paths of a convex design", "one hop each", f"{hops} hops of {paths.rows.shape[1]} paths")
    if error.steps != steps or (error.horizon is None) != (paths.plants.start is None):
        raise fail("error", f"one over the {steps} steps for which the paths were made", f"{error.steps}")
    n = paths.rows.shape[-1]
    states = names("states", states, n, "x")
    matrix = error.matrix(states)
    weights = error.over()[:, None, None] * matrix
    everyone = np.ones(hops, dtype=bool)
    return OneHop(paths, weights, allowed(as_budget(budget), paths.names, everyone, np.zeros((steps, hops))))


def inside(p: Powers, room: Allowed) -> Powers:
    """Powers that may leave the budget by rounding or a solver's accuracy, made smaller where they do."""
    p = np.clip(p, 0.0, room.peak)
    mean = p.mean(axis=0)
    p = p * np.minimum(1.0, np.divide(room.each, mean, out=np.ones_like(mean), where=mean > 0))
    total = float(p.mean(axis=0).sum())
    return np.asarray(p * min(1.0, room.total / total) if total > 0 else p)
