"""The number that the covariances of all steps become, and its derivative by them."""

from typing import NamedTuple

import numpy as np

from heliograph.numerics.types import Float
from heliograph.planning.criterion import Error

Matrices = Float[np.ndarray, "time n n"]

SHARPER = (16, 128, 2048)  # smoothing of the largest eigenvalue, less and less: n^(1/2048) is left at the end


class Weighing(NamedTuple):
    """sum_k share_k f(P_k), with f = <W, P>, or the largest eigenvalue of S = W^1/2 P W^1/2.

    sharpness: None for the trace, else q: the eigenvalue as tr(S^q)^(1/q), smooth, and above it by no more than the
    factor n^(1/q).
    """

    weight: Matrices
    shares: Float[np.ndarray, "time"]
    sharpness: int | None

    def smooth(self, p: Matrices) -> tuple[float, Matrices]:
        """The number, smoothed where it is an eigenvalue, and its derivative by each P."""
        values, weights = self._by_step(p)
        return float(self.shares @ values), self.shares[:, None, None] * weights

    def exact(self, p: Matrices) -> float:
        """The number itself."""
        if self.sharpness is None:
            return self.smooth(p)[0]
        root = _root(self.weight)
        return float(self.shares @ np.linalg.eigvalsh(root @ p @ root)[:, -1])

    def touching(self, p: Matrices) -> "Weighing":
        """The linear function <V, P> that touches the number at p and is nowhere above it."""
        if self.sharpness is None:
            return self
        weights, root = self._by_step(p)[1], np.linalg.pinv(_root(self.weight))
        size = np.trace(root @ weights @ root, axis1=1, axis2=2)
        return self._replace(weight=weights / size[:, None, None], sharpness=None)

    def sharper(self) -> list["Weighing"]:
        """From the smoothest to this one."""
        return [self] if self.sharpness is None else [self._replace(sharpness=q) for q in SHARPER]

    def _by_step(self, p: Matrices) -> tuple[Float[np.ndarray, "time"], Matrices]:
        if self.sharpness is None:
            return np.einsum("kij,kij->k", self.weight, p), self.weight
        root = _root(self.weight)
        values, vectors = np.linalg.eigh(root @ p @ root)
        relative = np.maximum(values / values[:, -1:], 0.0)
        total = (relative**self.sharpness).sum(axis=1)
        share = relative ** (self.sharpness - 1) * (total ** (1 / self.sharpness - 1))[:, None]
        turned = root @ vectors
        return values[:, -1] * total ** (1 / self.sharpness), (turned * share[:, None]) @ np.swapaxes(turned, 1, 2)


def weighing(error: Error, weight: Float[np.ndarray, "n n"]) -> Weighing:
    """That of an error with its matrix of weights."""
    return Weighing(np.tile(weight, (error.steps, 1, 1)), error.over(), SHARPER[-1] if error.worst else None)


def _root(weight: Matrices) -> Matrices:
    """W^1/2."""
    values, vectors = np.linalg.eigh(weight)
    scale = np.sqrt(np.maximum(values, 0.0))
    return np.asarray((vectors * scale[:, None, :]) @ np.swapaxes(vectors, 1, 2))
