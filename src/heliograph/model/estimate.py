"""An estimate and what its covariance claims to be; an innovation and how likely the filter finds it."""

from dataclasses import replace
from typing import Any, Literal, TypeVar

import equinox as eqx
import numpy as np

from heliograph.numerics.angles.manifold import Manifold
from heliograph.numerics.check import DEFINITENESS_TOLERANCE, fail, items, show_value, standard_deviations
from heliograph.numerics.linalg import find_not_finite
from heliograph.numerics.module import Module, readable
from heliograph.numerics.types import Array, Float, PyTree
from heliograph.random_affine.noises.outlier_noise import has_bounded_noise
from heliograph.random_affine.words.rounding_noise import find_rounded_noises

Claim = Literal["exact", "upper", "nominal", "none"]
STRENGTH: dict[Claim, int] = {"none": -1, "nominal": 0, "upper": 1, "exact": 2}


@readable
class Estimate(Module):
    """An estimate and the covariance claimed for its error.

    claim: "exact" if `covariance` is E[(x - mean)(x - mean)'], "upper" if it dominates it, "nominal" if it is only what
    the filter's approximations say, "none" if no covariance is claimed: then `covariance` is NaN.

    All is up to rounding, on the safe side: that of the mean, and a hundred eps of what a variance was before the last
    measurement. `claim` is what the filter claims of a sound estimate; of many, `claims` says
    where it holds.

    modes: probabilities of the present mode (..., M), of a filter that weighs modes; None of all others. Chains of
    plant, sensor and links are one joint chain, in this order, the first slowest (`joint_modes`).

    attitude: indices of the states that are the rotation vectors of attitudes, three of each. Their errors, whose
    covariance this is, are turns in the estimated axes, `error`.

    Shapes: mean (..., n), covariance (..., n, n).
    """

    mean: "Float[Array, '... n']"
    covariance: "Float[Array, '... n n']"
    claim: Claim = eqx.field(static=True)
    modes: "Array | None" = None
    attitude: tuple[int, ...] = eqx.field(static=True, default=(), repr=False)

    def __check_init__(self) -> None:
        """Raise ValueError unless `claim` is "exact", "upper", "nominal" or "none"; called after construction."""
        check_claim(self.claim)

    def error(self, truth: Float[Array, "... n"]) -> Any:
        """Return truth - mean (..., n), of attitudes the turn from the estimated to the true one, in radians.

        Args:
            truth: true states (..., n); angles within half a turn of the estimated ones.
        """
        return Manifold((), self.attitude).difference(truth, self.mean)

    @property
    def claims(self) -> np.ndarray:
        """The claim of each estimate, (...): "none" where mean or covariance are no numbers, or the latter is none."""
        return np.where(mask_sound_estimates(self), self.claim, "none")


@readable
class JudgedEstimate(Estimate):
    """An estimate on live data, and what the filter made of what arrived last.

    nis: squared innovation e' S^-1 e, about `received` on average where the claim is right; NaN where nothing arrived
    or no covariance is claimed. received: how many numbers arrived. refused: why the filter alone left them out, "" if
    it did not. weight: of each number (m,), from 0 (left out) to 1 (in full), NaN where it did not arrive, of a filter
    that weighs them; None of all others.
    """

    nis: float = float("nan")
    received: int = 0
    refused: str = eqx.field(static=True, default="")
    weight: Array | None = None


@readable
class Innovation(Module):
    """Innovation of a measurement: z - E[z | earlier data], its covariance and its log-likelihood.

    Components that did not arrive are NaN in value and covariance. A filter that claims no covariance has NaN in all
    but the value.

    Args:
        value: z minus its prediction (..., m).
        covariance: covariance of the innovation as the filter computes it (..., m, m).
        log_likelihood: log p(components that arrived | earlier data) as the filter sees it (...), 0 when nothing
            arrived; log N(value; 0, covariance) unless the filter says otherwise.
        weight: weight of each component in the update (..., m), from 0 (left out) to 1 (in full), of a filter that
            weighs them; None of all others.
    """

    value: "Float[Array, '... m']"
    covariance: "Float[Array, '... m m']"
    log_likelihood: "Float[Array, '...']"
    weight: "Float[Array, '... m'] | None" = None


def check_claim(claim: object) -> None:
    """Raise ValueError unless `claim` is "exact", "upper", "nominal" or "none"."""
    if not isinstance(claim, str) or claim not in STRENGTH:
        raise fail("claim", f"one of {', '.join(STRENGTH)}", show_value(claim))


def weakest(claims: list[Claim]) -> Claim:
    """Return the weakest of some claims, in the order "exact", "upper", "nominal", "none".

    A claim says what an estimate's covariance is: exactly that of the error, an upper bound of it, only what the filter
    believes, or nothing.

    Args:
        claims: at least one.

    Raises:
        ValueError: no claims, or something else among them.
    """
    if not items("claims", claims, "claims"):
        raise fail("claims", "at least one", "none")
    for claim in claims:
        check_claim(claim)
    return min(claims, key=STRENGTH.__getitem__)


def lower_claim_by_noise(claim: Claim, *models: PyTree) -> Claim:
    """Return a claim, lowered to what the noises of these models support.

    It is "upper" at most if a noise is only known by a bound of its covariance. It is "nominal" at most if a
    measurement is rounded so coarsely that the rounding error depends on the signal.
    """
    rounded = find_rounded_noises(*models)
    if not all(noise.is_exact or noise.is_bounded for noise in rounded):
        return weakest([claim, "nominal"])
    bounded = has_bounded_noise(*models) or any(noise.is_bounded for noise in rounded)
    return weakest([claim, "upper"]) if bounded else claim


def mask_sound_estimates(estimate: Estimate) -> np.ndarray:
    """Return which estimates have a finite mean and, if they claim one, a valid covariance (to rounding)."""
    has_finite_mean = ~find_not_finite(np.asarray(estimate.mean), 1)
    if estimate.claim == "none":
        return has_finite_mean
    return np.asarray(has_finite_mean & _mask_covariances_over_time(np.asarray(estimate.covariance)))


def _mask_covariances_over_time(matrices: np.ndarray) -> np.ndarray:
    """Return which matrices (..., n, n) are finite and positive semidefinite to rounding, judging equal ones once."""
    # When a filter has settled, most matrices (time, n, n) of a long recording equal the previous one.
    if matrices.ndim == 3 and len(matrices) > 2 and np.array_equal(matrices[-1], matrices[len(matrices) // 2]):
        rows = matrices.reshape(len(matrices), -1)
        is_new = np.append(True, (rows[1:] != rows[:-1]).any(axis=1))
        index_among_new = np.cumsum(is_new) - 1  # for each matrix, that of the last new one
        return np.asarray(_mask_covariances(matrices[is_new])[index_among_new])
    return _mask_covariances(matrices)


def _mask_covariances(matrices: np.ndarray) -> np.ndarray:
    """Return which matrices (..., n, n) are finite and positive semidefinite to rounding."""
    is_finite = ~find_not_finite(matrices, 2)
    # Try a quick test of all at once. If it fails, test each matrix as correlations, so that units do not matter.
    if is_finite.all() and _are_definite((matrices + np.swapaxes(matrices, -1, -2)) / 2):
        return np.asarray(is_finite)
    finite = np.where(is_finite[..., None, None], matrices, np.eye(matrices.shape[-1]))
    deviations = standard_deviations(finite)
    variance_products = deviations[..., :, None] * deviations[..., None, :]
    correlations = (finite + np.swapaxes(finite, -1, -2)) / (2 * variance_products)
    are_covariances: np.ndarray = is_finite & _is_semidefinite(correlations)
    return are_covariances


def _are_definite(covariances: np.ndarray) -> bool:
    """Return whether all matrices P are semidefinite to rounding: whether P + tol diag(P) has a Cholesky factor.

    If so, their correlations have no eigenvalue below -tol (DEFINITENESS_TOLERANCE). The matrices are changed in place.
    """
    diagonal = np.arange(covariances.shape[-1])
    covariances[..., diagonal, diagonal] *= 1 + DEFINITENESS_TOLERANCE
    try:
        np.linalg.cholesky(covariances)
    except np.linalg.LinAlgError:
        return False
    return True


def _is_semidefinite(correlations: np.ndarray) -> np.ndarray:
    """Return which matrices (..., n, n) have no eigenvalue below zero, to rounding.

    If C + tol I has a Cholesky factor for all of them, none has an eigenvalue below -tol (DEFINITENESS_TOLERANCE). This
    test takes a sixth of the time. If it fails, the eigenvalues tell which matrices are semidefinite.
    """
    try:
        np.linalg.cholesky(correlations + DEFINITENESS_TOLERANCE * np.eye(correlations.shape[-1]))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.eigvalsh(correlations)[..., 0] >= -DEFINITENESS_TOLERANCE)
    return np.ones(correlations.shape[:-2], dtype=bool)


AnyEstimate = TypeVar("AnyEstimate", bound=Estimate)


def lower_unsound_claim(estimate: AnyEstimate) -> AnyEstimate:
    """Return one estimate, with the claim "none" if its mean is not finite or its covariance is not valid.

    Several estimates side by side (a mean of more than one axis) are returned unchanged; their property `claims` says
    which claims hold.
    """
    if estimate.claim == "none" or np.ndim(estimate.mean) > 1 or mask_sound_estimates(estimate).all():
        return estimate
    return replace(estimate, claim="none")
