"""How good a design is, in numbers and in words: a gap where the problem is convex, else starts and a global bound."""

from typing import NamedTuple

import numpy as np

from heliograph.numerics.readable import readable
from heliograph.numerics.types import Float
from heliograph.planning.budget import Allowed
from heliograph.planning.objective import Objective

Powers = Float[np.ndarray, "time free"]


@readable
class Certificate(NamedTuple):
    """What is known of the best that the budget allows (or of the least power for a wanted error).

    convex: whether every local minimum is the least. value: what was found, the error or the power. bound: no
    allocation has less, whatever was searched. stationarity: the part of the error by which a linear model still sees
    it fall within the budget; zero if and only if the conditions of Karush, Kuhn and Tucker hold (of free numbers: over
    a step of the size of their range, or of their start where they have none). starts: descents.
    unit: "error" or "power".
    """

    convex: bool
    value: float
    bound: float
    stationarity: float
    starts: int
    unit: str

    @property
    def gap(self) -> float:
        """How much less may be possible at most."""
        return max(self.value - self.bound, 0.0)

    @property
    def words(self) -> str:
        """What the numbers certify."""
        if self.convex:
            return f"optimal within {self.gap:.1e}: the problem is convex, and no {self.unit} is below {self.bound:.6g}"
        found = "the one start" if self.starts == 1 else f"{self.starts} starts"
        if not np.isfinite(self.bound):
            known = "" if np.isnan(self.stationarity) else f", stationary within {self.stationarity:.1e}"
            return f"best of {found}{known}; no bound is known"
        better = "better" if self.unit == "error" else "less"
        return (
            f"best of {found}, stationary within {self.stationarity:.1e}; nothing can be {better} than {self.bound:.6g}"
        )


def lower_bound(objective: Objective, limits: Allowed, powers: Powers) -> float:
    """f(p) + min over the budget of grad.(q - p), which a convex f nowhere undercuts: the gap of Frank and Wolfe.

    For the worst direction, with the weights v v' of directions in place of the largest eigenvalue, which they bound.
    """
    flat = objective.weighted(powers)
    value, gradient = flat.value_and_gradient(powers)
    return float(value + np.sum(gradient * (limits.most(-gradient) - powers)))


def least_total(objective: Objective, limits: Allowed, powers: Powers, wanted: float) -> float:
    """The least total power at which the linear model at p, below a convex f everywhere, reaches the wanted error."""
    flat = objective.weighted(powers)
    value, gradient = flat.value_and_gradient(powers)
    low, high = 0.0, float(powers.mean(axis=0).sum()) * (1 + 1e-9)
    for _ in range(100):
        middle = (low + high) / 2
        reached = value + np.sum(gradient * (limits._replace(total=middle).most(-gradient) - powers))
        low, high = (low, middle) if reached <= wanted else (middle, high)
    return low
