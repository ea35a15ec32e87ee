"""The error as a function of powers, with its gradient: information of the paths, and the adjoint behind it."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from heliograph.numerics.types import Bool, Float, Int
from heliograph.planning.adjoint import covariances
from heliograph.planning.criterion import Error
from heliograph.planning.paths import Heard, Paths, heard, informations, sensitivities
from heliograph.planning.weighing import Weighing, weighing

Powers = Float[np.ndarray, "time free"]


class Objective(NamedTuple):
    """An error of what `tell` says that powers (time, free) tell of each path; path[f] is the path of column f."""

    paths: Paths
    weighing: Weighing
    path: Int[np.ndarray, "free"]
    tell: Callable[[Powers], Heard]

    def covariances(self, powers: Powers) -> Float[np.ndarray, "time n n"]:
        """P after each step."""
        return covariances(self.paths.plants, informations(self.paths, self.tell(powers).information))

    def value(self, powers: Powers) -> float:
        """The error, smoothed where it is an eigenvalue."""
        return self.weighing.smooth(self.covariances(powers))[0]

    def value_and_gradient(self, powers: Powers) -> tuple[float, Powers]:
        """The error and its derivative by each power."""
        told = self.tell(powers)
        p = covariances(self.paths.plants, informations(self.paths, told.information))
        value, weights = self.weighing.smooth(p)
        worth = sensitivities(self.paths, told.information, p, weights)
        return value, -worth[:, self.path] * told.slope

    def exact(self, powers: Powers) -> float:
        """The error itself."""
        return self.weighing.exact(self.covariances(powers))

    def weighted(self, powers: Powers) -> "Objective":
        """The linear function of the covariances that touches the error here and is nowhere above it."""
        return self._replace(weighing=self.weighing.touching(self.covariances(powers)))


def of_hops(
    paths: Paths,
    error: Error,
    weight: Float[np.ndarray, "n n"],
    free: Bool[np.ndarray, "hop"],
    held: Float[np.ndarray, "time hop"],
) -> Objective:
    """The error by the powers of the hops that are free, the others sending what they do."""

    def tell(powers: Powers) -> Heard:
        whole = held.copy()
        whole[:, free] = powers
        told = heard(paths, whole)
        return Heard(told.information, told.slope[:, free])

    return Objective(paths, weighing(error, weight), paths.path[free], tell)
