"""Factors of covariances by eigenvectors, held beside the covariance: one put in its place is factored anew."""

from collections.abc import Callable
from typing import Any
from weakref import ref

import jax
import numpy as np

from heliograph.factors.covariance_factors import columns_of
from heliograph.numerics.check import is_diagonal
from heliograph.numerics.numpy_or_jax import is_traced

LARGE = 100  # a diagonal matrix of more components gets its root without eigenvectors: 18 ms for 1,000, 3 s with them
FACTOR_TOLERANCE = 1e-10  # allowed |A A' - S|_ij, as a share of the product of the deviations of i and j


def factor_by_eigenvectors(covariance: np.ndarray) -> np.ndarray:
    """Return A with A A' = S, from eigenvectors of S, or of the correlations if S has components of other sizes.

    Eigenvalues are exact to rounding of the largest one, so that a component in small units would be lost. An
    eigenvalue below that rounding is set to zero, since its root of about 1e-8 would add noise to combinations that
    have none.
    """
    matrix = np.asarray(covariance)
    if len(matrix) > LARGE and is_diagonal(matrix):
        root: np.ndarray = np.diag(np.sqrt(np.diagonal(matrix)))
        return root
    deviation = np.sqrt(np.diagonal(matrix))
    unit = np.where(deviation > 0, deviation, 1.0)
    for scale in (np.ones_like(unit), unit):
        values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
        rounding = 10 * len(values) * np.finfo(float).eps * np.max(values, initial=0.0)
        factor: np.ndarray = scale[:, None] * (vectors * np.sqrt(np.where(values > rounding, values, 0.0)))
        if np.all(np.abs(factor @ factor.T - matrix) <= FACTOR_TOLERANCE * np.outer(unit, unit)):
            break
    return factor


class WeightsOfFactor:
    """The field of a noise for the weights w of its factor A, with Cov = A diag(w) A': the last of its fields.

    JAX and Equinox (`eqx.tree_at`) make an object anew by setting its fields one after another. When the weights come,
    covariance and factor are there; where these do not belong together, the covariance counts.

    Args:
        factor: returns A with A A' = S from a covariance S (n, n).
        tolerance: what A diag(w) A' may differ from S, in units of two standard deviations.
    """

    def __init__(self, factor: Callable[[np.ndarray], np.ndarray], tolerance: float):
        """Hold `factor`, which returns A with A A' = S, and the relative tolerance of A diag(w) A' = S."""
        self.factor, self.tolerance = factor, tolerance
        # By identity of a factor: references to it and to the covariance to which it was found to belong.
        self._found: dict[int, tuple[ref[Any], ref[Any]]] = {}

    def __get__(self, noise: Any, kind: type | None = None) -> Any:
        """Return the weights w of a noise; on the class itself raise AttributeError, as for any field."""
        if noise is None or "weights" not in noise.__dict__:
            raise AttributeError("weights")
        return noise.__dict__["weights"]

    def __set__(self, noise: Any, weights: Any) -> None:
        """Hold the weights w; factor the covariance anew if A (`factor`) and w are not those of this covariance.

        They are not if JAX or Equinox made the noise anew with another covariance. Numbers are compared. Of a traced
        factor nothing is known but the covariance object with which it came first.
        """
        held = noise.__dict__  # the fields of the noise by name
        held["weights"] = weights
        covariance = held.get("covariance")
        factor = held.get("factor")
        found_factor, found_covariance = self._found.get(id(factor), (None, None))
        is_found = found_factor is not None and found_factor() is factor
        if is_found and found_covariance is not None and found_covariance() is covariance:
            return
        if all(_is_known(part) for part in (covariance, factor, weights)):
            S = np.asarray(covariance)
            if self._belongs_to(np.asarray(factor), np.asarray(weights), S):
                self._note(factor, covariance)
            else:  # one covariance (n, n), or several along leading axes
                n = S.shape[-1]
                held["factor"] = np.reshape([self.factor(one) for one in S.reshape(-1, n, n)], S.shape)
                held["weights"] = np.ones(S.shape[:-1])
        elif is_traced(factor) and isinstance(covariance, np.ndarray | jax.Array):
            # A traced factor tells nothing: it belongs to the covariance that it came with first.
            if is_found:
                make_columns = columns_of
                for _ in range(covariance.ndim - 2):  # of one for each step, or each mode
                    make_columns = jax.vmap(make_columns)
                held["factor"], held["weights"] = make_columns(covariance)
                factor = held["factor"]
            self._note(factor, covariance)

    def _belongs_to(self, A: np.ndarray, w: np.ndarray, S: np.ndarray) -> bool:
        """Return whether A diag(w) A' is S (n, n), or whether these are no numbers of such a shape."""
        if S.shape[:-1] != A.shape[:-1] or S.dtype.kind != "f":
            return True
        deviation = np.sqrt(np.maximum(np.diagonal(S, axis1=-2, axis2=-1), 0.0))
        allowed = self.tolerance * deviation[..., :, None] * deviation[..., None, :]
        return bool(np.all(np.abs((A * w[..., None, :]) @ A.swapaxes(-1, -2) - S) <= allowed))

    def _note(self, factor: Any, covariance: Any) -> None:
        """Remember that a factor was found to belong to a covariance, until the factor is no longer in use."""
        key = id(factor)
        self._found[key] = ref(factor, lambda _: self._found.pop(key, None)), ref(covariance)


def _is_known(part: object) -> bool:
    """Return whether a part is an array of numbers: not traced by JAX, and no placeholder in its place."""
    return isinstance(part, np.ndarray) or (isinstance(part, jax.Array) and not isinstance(part, jax.core.Tracer))
