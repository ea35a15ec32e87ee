"""The number that a design makes small, made of the error covariances of all steps, and its derivative."""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import numpy as np

from heliograph.numerics.check import array, check_count, covariance, fail, flag
from heliograph.numerics.module import Module, readable
from heliograph.numerics.types import ArrayLike, Float

WEIGHT = "weight of the error"
# Smoothing of the largest eigenvalue, less and less: n^(1/32768) is left at the end.
SHARPNESSES = (16, 128, 2048, 32768)

Matrices = Float[np.ndarray, "time n n"]


@readable
class Error(Module):
    """Error that a design makes small: a number made of the covariance P of the best linear filter after each step.

    The number is <W, P>, or the largest eigenvalue of W^1/2 P W^1/2, in the steady state unless a horizon is given.

    Args:
        weight: W as a matrix (n, n), or a number for each named state ({"position": 1.0} counts that state alone); the
            identity unless given.
        worst: the largest eigenvalue (the worst direction) in place of the trace.
        horizon: the mean over so many steps from the plant's initial covariance on, in place of the steady state.
        at_end: with a horizon, the error after its last step alone.
        period: the steady mean over a period of so many steps, in each of which transmitters may have another power.

    Raises:
        ValueError: a horizon and a period, an end without a horizon, a weight that is no covariance or weighs nothing.
    """

    weight: np.ndarray | dict[str, float] | None
    worst: bool = eqx.field(static=True)
    horizon: int | None = eqx.field(static=True)
    at_end: bool = eqx.field(static=True)
    period: int = eqx.field(static=True)

    def __init__(
        self,
        weight: "Float[ArrayLike, 'n n'] | Mapping[str, float] | None" = None,
        worst: bool = False,
        horizon: int | None = None,
        at_end: bool = False,
        period: int = 1,
    ):
        """Check and hold which number is made of the covariance P, and of which steps.

        The arguments are those of the class.
        """
        if isinstance(weight, Mapping):
            self.weight = dict(weight)
        else:
            self.weight = None if weight is None else covariance(WEIGHT, weight)
        self.worst, self.at_end = flag("worst", worst), flag("at_end", at_end)
        self.horizon = None if horizon is None else check_count("horizon of the error", horizon)
        self.period = check_count("period of the error", period)
        if self.horizon is not None and self.period > 1:
            raise fail("error", "a horizon or a period", "both")
        if self.at_end and self.horizon is None:
            raise fail("error at the end", "a horizon", "none")

    @property
    def steps(self) -> int:
        """Number of steps over which the powers may differ."""
        return self.period if self.horizon is None else self.horizon

    def matrix(self, states: tuple[str, ...]) -> Float[np.ndarray, "n n"]:
        """Return the weight W (n, n) of the error <W, P> for a plant with these states; P is the filter's covariance.

        Args:
            states: names of the plant's states.

        Raises:
            ValueError: a state that the plant does not have, a weight of another size.
        """
        n = len(states)
        if self.weight is None:
            return np.eye(n)
        if isinstance(self.weight, dict):
            unknown = sorted(set(self.weight) - set(states))
            if unknown:
                raise fail(WEIGHT, f"numbers for some of the states {list(states)}", unknown)
            diagonal = np.array([float(self.weight.get(name, 0.0)) for name in states])
            matrix = covariance(WEIGHT, np.diag(diagonal), n)
        else:
            matrix = array(WEIGHT, self.weight, (n, n))
        if not np.any(matrix):
            raise fail(WEIGHT, "one that weighs something", "zero")
        return np.asarray(matrix)

    def criterion(self, states: tuple[str, ...]) -> "Criterion":
        """Return the number to be made small, as a function of covariances, for a plant with these states.

        `self.matrix`: the weight of the states' covariance. If the worst direction counts (`self.worst`), the number is
        the largest eigenvalue, smoothed by an exponent of SHARPNESSES, the sharpest last.
        """
        # Only the last step counts (the last unit vector), or all steps count alike.
        shares = np.eye(self.steps)[-1] if self.at_end else np.full(self.steps, 1 / self.steps)
        weight = np.tile(self.matrix(states), (self.steps, 1, 1))
        return Criterion(weight=weight, shares=shares, sharpness=SHARPNESSES[-1] if self.worst else None)


class SmoothedError(NamedTuple):
    """A criterion's number at some covariances P_k, smoothed if it is an eigenvalue, and its derivative by each P_k."""

    value: float
    slopes: Matrices


class Criterion(NamedTuple):
    """Number sum_k share_k f(P_k), with f = <W, P>, or the largest eigenvalue of S = W^1/2 P W^1/2.

    Args:
        weight: W of each step (time, n, n).
        shares: share of each step (time,), which sum to 1.
        sharpness: None for the trace <W, P>. Else q: the eigenvalue is smoothed as tr(S^q)^(1/q), which is above it by
            no more than the factor n^(1/q).
    """

    weight: Matrices
    shares: Float[np.ndarray, "time"]
    sharpness: int | None

    def smooth(self, p: Matrices) -> SmoothedError:
        """Return the number at covariances P (time, n, n), smoothed if it is an eigenvalue, with its derivatives.

        The search minimises this; `compute_exact_error` is the error itself.
        """
        values, slopes = self._differentiate_steps(p)
        return SmoothedError(value=float(self.shares @ values), slopes=self.shares[:, None, None] * slopes)

    def compute_exact_error(self, p: Matrices) -> float:
        """Return the error at covariances p (time, n, n), without smoothing of an eigenvalue.

        It is the sum over steps, with weights `self.shares`, of the trace of W P. If `self.sharpness` is not None, it
        is that of the largest eigenvalue of W^1/2 P W^1/2.
        """
        if self.sharpness is None:
            return self.smooth(p).value
        root = _find_root(self.weight)
        return float(self.shares @ np.linalg.eigvalsh(root @ p @ root)[:, -1])

    def make_tangent(self, p: Matrices) -> "Criterion":
        """Return the linear criterion <V, P> that is a lower bound of this one and meets it at p.

        A linear criterion (`sharpness` None) is its own tangent. Else the criterion is the largest eigenvalue of
        S = W^1/2 P W^1/2, and U = W^-1/2 V W^-1/2 is the derivative of its smoothed form tr(S^q)^(1/q) by S, scaled to
        trace 1. As U >= 0, <V, P> = tr(U S) is an average over the spectrum of S: it never exceeds the largest.
        """
        if self.sharpness is None:
            return self
        _, derivative = self._differentiate_steps(p)
        inverse_root = np.linalg.pinv(_find_root(self.weight))  # W^-1/2
        traces = np.trace(inverse_root @ derivative @ inverse_root, axis1=1, axis2=2)
        return self._replace(weight=derivative / traces[:, None, None], sharpness=None)

    def list_from_smoothest(self) -> "list[Criterion]":
        """Return the criteria from the smoothest to this one, by which a search begins: only this one for a trace."""
        return [self] if self.sharpness is None else [self._replace(sharpness=q) for q in SHARPNESSES]

    def _differentiate_steps(self, p: Matrices) -> tuple[Float[np.ndarray, "time"], Matrices]:
        """Return f(P_k) (time,) and df/dP_k (time, n, n) of each step: f is tr W P or the smoothed eigenvalue.

        W is `self.weight` of each step, S = W^1/2 P W^1/2, and q is `self.sharpness`, None for the trace. The smoothed
        eigenvalue is tr(S^q)^(1/q).
        """
        if self.sharpness is None:
            return np.einsum("kij,kij->k", self.weight, p), self.weight
        # The derivative is W^1/2 S^(q-1) W^1/2 tr(S^q)^(1/q - 1), in units of the largest eigenvalue against overflow.
        q, root = self.sharpness, _find_root(self.weight)
        eigenvalues, vectors = np.linalg.eigh(root @ p @ root)
        largest = eigenvalues[:, -1]
        relative = np.maximum(eigenvalues / largest[:, None], 0.0)
        trace = (relative**q).sum(axis=1)
        slopes = relative ** (q - 1) * (trace ** (1 / q - 1))[:, None]  # of the smoothed value by each eigenvalue
        root_times_vectors = root @ vectors
        derivative = (root_times_vectors * slopes[:, None]) @ np.swapaxes(root_times_vectors, 1, 2)
        return largest * trace ** (1 / q), derivative


def _find_root(weight: Matrices) -> Matrices:
    """Return the symmetric root W^1/2 of each matrix W (time, n, n)."""
    eigenvalues, vectors = np.linalg.eigh(weight)
    root_eigenvalues = np.sqrt(np.maximum(eigenvalues, 0.0))  # what is below 0 is rounding
    return np.asarray((vectors * root_eigenvalues[:, None, :]) @ np.swapaxes(vectors, 1, 2))
