"""Likelihood of recordings over the free numbers: climbed, cut along one of them, and measured at its top."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from heliograph.learning.likelihood.data import Data
from heliograph.learning.likelihood.maximise import Evaluated, Maximum, maximise
from heliograph.learning.likelihood.objective import Evaluation, Objective, at_points
from heliograph.numerics.types import Bool, Float

DIFFERENCE = 1e-3  # standard errors over which scores are differenced
REACH = np.array([0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.5, 7.0])  # standard errors at which a profile is cut first
REFINEMENTS = 2

Watch = Callable[[Maximum], None]


class StoppedError(Exception):
    """Interruption of a climb, with the best so far."""

    def __init__(self, best: Maximum):
        super().__init__()
        self.best = best


@dataclass(frozen=True)
class Surface:
    """Objective over all recordings; the last points are cached, for they are often used again."""

    objective: Objective
    data: Data
    _last: list[tuple[np.ndarray, Evaluation]] = field(default_factory=list, repr=False, compare=False)

    def evaluations(self, x: Float[np.ndarray, "points p"]) -> Evaluation:
        """Evaluation at points."""
        if not (self._last and np.array_equal(self._last[0][0], x)):
            self._last[:] = [(np.array(x), at_points(self.objective, np.asarray(x), self.data))]
        return self._last[0][1]

    def evaluate(self, x: Float[np.ndarray, "points p"]) -> Evaluated:
        """Likelihood, gradient and information at points."""
        evaluation = self.evaluations(x)
        return evaluation.total, evaluation.gradient, evaluation.information

    def climb(
        self, start: Float[np.ndarray, "points p"], active: Bool[np.ndarray, "points p"], watch: Watch
    ) -> Maximum:
        """Climb to the top from each start.

        Raises:
            StoppedError: with the best so far, where the user interrupts.
        """
        best: list[Maximum] = []

        def seen(now: Maximum) -> None:
            best[:] = [now]
            watch(now)

        try:
            return maximise(self.evaluate, start, active, seen)
        except KeyboardInterrupt:
            if not best:
                raise
            raise StoppedError(best[0]) from None

    def hessian(self, x: Float[np.ndarray, " p"], active: Bool[np.ndarray, " p"]) -> Float[np.ndarray, "p p"]:
        """Hessian of -l by central differences of the scores of active coordinates; the information for the others."""
        information: np.ndarray = self.evaluations(x[None]).information[0]
        diagonal = np.diag(information)
        width = np.where(diagonal > 0, DIFFERENCE / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 0.0)
        moving = np.flatnonzero(active & (diagonal > 0))
        shifts = np.zeros((len(moving), len(x)))
        shifts[np.arange(len(moving)), moving] = width[moving]
        if not len(moving):
            return information
        gradient = self.evaluations(np.concatenate([x + shifts, x - shifts])).gradient
        hessian: np.ndarray = information.copy()
        slopes = -(gradient[: len(moving)] - gradient[len(moving) :]) / (2 * width[moving][:, None])
        block = slopes[:, moving]
        hessian[np.ix_(moving, moving)] = (block + block.T) / 2
        return hessian

    def crossing(
        self,
        x: Float[np.ndarray, " p"],
        top: float,
        coordinate: int,
        reach: Float[np.ndarray, " points"],
        drop: float,
        active: Bool[np.ndarray, " p"],
    ) -> float:
        """Find where the likelihood, its other active coordinates at their best, has fallen by `drop` below `top`.

        `reach`: values of the coordinate, away from its best, to begin with. Infinite where it has not fallen there.
        """
        others = active.copy()
        others[coordinate] = False
        inside, outside = x[coordinate], np.nan
        low = 0.0
        # profile at a few values, then again between the two around the crossing
        for _ in range(1 + REFINEMENTS):
            start = np.repeat(x[None], len(reach), axis=0)
            start[:, coordinate] = reach
            total = maximise(self.evaluate, start, np.repeat(others[None], len(reach), axis=0)).total
            fallen = np.sqrt(np.maximum(2 * (top - np.where(np.isfinite(total), total, -np.inf)), 0.0))
            beyond = np.flatnonzero(fallen >= np.sqrt(2 * drop))
            if not len(beyond):
                return float(np.sign(reach[-1] - reach[0]) * np.inf)
            at = int(beyond[0])
            if at > 0:
                inside, low = reach[at - 1], fallen[at - 1]
            outside, high = reach[at], fallen[at]
            reach = np.linspace(inside, outside, len(reach) + 1)[1:]
        # linear in the root of the fall
        if not np.isfinite(high):
            return float(outside)
        return float(inside + (outside - inside) * (np.sqrt(2 * drop) - low) / (high - low))
