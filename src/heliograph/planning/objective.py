"""The error as a function of powers, with its gradient: information of the paths, and the adjoint behind it."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from heliograph.numerics.types import Bool, Float, Int
from heliograph.planning.adjoint import covariances
from heliograph.planning.criterion import Error
from heliograph.planning.paths import Heard, Paths, heard, informations, sensitivities

Powers = Float[np.ndarray, "time free"]

SHARPEST = 2048  # smoothing of the largest eigenvalue that is left at the end: n^(1/2048)


class Objective(NamedTuple):
    """An error of what `tell` says that powers (time, free) tell of each path; path[f] is the path of column f.

    weight: W of each step; shares: of each step in the error. sharpness: None for the trace <W, P>, else q: the
    largest eigenvalue of S = W^1/2 P W^1/2 as tr(S^q)^(1/q), smooth, and above it by no more than the factor n^(1/q).
    """

    paths: Paths
    weight: Float[np.ndarray, "time n n"]
    shares: Float[np.ndarray, "time"]
    sharpness: int | None
    path: Int[np.ndarray, "free"]
    tell: Callable[[Powers], Heard]

    def covariances(self, powers: Powers) -> Float[np.ndarray, "time n n"]:
        """P after each step."""
        return covariances(self.paths.plants, informations(self.paths, self.tell(powers).information))

    def value(self, powers: Powers) -> float:
        """The error."""
        return float(self.shares @ self._weigh(self.covariances(powers))[0])

    def value_and_gradient(self, powers: Powers) -> tuple[float, Powers]:
        """The error and its derivative by each power."""
        told = self.tell(powers)
        p = covariances(self.paths.plants, informations(self.paths, told.information))
        values, weights = self._weigh(p)
        worth = sensitivities(self.paths, told.information, p, self.shares[:, None, None] * weights)
        return float(self.shares @ values), -worth[:, self.path] * told.slope

    def exact(self, powers: Powers) -> float:
        """The error itself, the largest eigenvalue where that is smoothed."""
        p = self.covariances(powers)
        if self.sharpness is None:
            return float(self.shares @ np.einsum("kij,kij->k", self.weight, p))
        root = _root(self.weight)
        return float(self.shares @ np.linalg.eigvalsh(root @ p @ root)[:, -1])

    def weighted(self, powers: Powers) -> "Objective":
        """The linear function <V, P> of the covariances that touches the error here and is nowhere above it."""
        if self.sharpness is None:
            return self
        weights = self._weigh(self.covariances(powers))[1]
        root = np.linalg.pinv(_root(self.weight))
        shares = np.trace(root @ weights @ root, axis1=1, axis2=2)
        return self._replace(weight=weights / shares[:, None, None], sharpness=None)

    def _weigh(
        self, p: Float[np.ndarray, "time n n"]
    ) -> tuple[Float[np.ndarray, "time"], Float[np.ndarray, "time n n"]]:
        """The error of each step, and its derivative by P."""
        if self.sharpness is None:
            return np.einsum("kij,kij->k", self.weight, p), self.weight
        root = _root(self.weight)
        values, vectors = np.linalg.eigh(root @ p @ root)
        relative = np.maximum(values / values[:, -1:], 0.0)
        total = (relative**self.sharpness).sum(axis=1)
        share = relative ** (self.sharpness - 1) * (total ** (1 / self.sharpness - 1))[:, None]
        turned = root @ vectors
        return values[:, -1] * total ** (1 / self.sharpness), (turned * share[:, None]) @ np.swapaxes(turned, 1, 2)


def _root(weight: Float[np.ndarray, "time n n"]) -> Float[np.ndarray, "time n n"]:
    """W^1/2."""
    values, vectors = np.linalg.eigh(weight)
    scale = np.sqrt(np.maximum(values, 0.0))
    return np.asarray((vectors * scale[:, None, :]) @ np.swapaxes(vectors, 1, 2))


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

    weights = np.tile(weight, (error.steps, 1, 1))
    return Objective(paths, weights, error.over(), SHARPEST if error.worst else None, paths.path[free], tell)
