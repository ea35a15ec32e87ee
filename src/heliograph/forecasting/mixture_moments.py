"""Moments of forecast numbers as a mixture, the law of each number by itself, and the prediction that both are.

The branches of a noise that is not Gaussian are the Gaussians of which it is a mixture: without and with outliers, or
of Student's law those of each precision.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.truncation import PlacedLimits
from heliograph.forecasting.forecast_result import Prediction
from heliograph.model.estimate import Claim
from heliograph.numerics.angles.angle import Angles, wrap_angles, wrap_near
from heliograph.numerics.types import Array
from heliograph.random_affine.moments.mixture_components import GaussianBranches


class MarginalLaws(NamedTuple):
    """Mixture of K Gaussians for each of m numbers: weights, means and variances, (K, m) each."""

    weights: jax.Array
    means: jax.Array
    variances: jax.Array


class Moments(NamedTuple):
    """Weights (K,), means (K, m) and covariances (K, m, m) of a mixture.

    `laws`: the law of each number by itself, where it is not the mixture of Gaussians of these moments: with a noise
    that is not Gaussian, or of a state before it is cut to its limits.
    """

    weights: jax.Array
    means: jax.Array
    covariances: jax.Array
    laws: MarginalLaws | None = None


def spread_over_branches(weights: Array, means: Array, variances: Array, branches: GaussianBranches) -> MarginalLaws:
    """Return the law of each number x + noise, where x is a mixture of K Gaussians and the noise one of J.

    The sum is a mixture of K J Gaussians: pair (k, j) has the product of the weights, and the sums of the means and of
    the variances.

    Args:
        weights: weights (K,) of the parts of the numbers without the noise.
        means: means (K, m) of each number in each part, with the mean of the noise.
        variances: variances (K, m) of each number in each part, without the noise.
        branches: log shares, means and variances (m, J) of the noise's Gaussians, about its mean.
    """
    log_share, mean, variance = (jnp.asarray(one).T for one in branches)  # (J, m)
    pairs = (len(weights) * len(log_share), means.shape[-1])  # (K J, m)
    return MarginalLaws(
        weights=(jnp.asarray(weights)[:, None, None] * jnp.exp(log_share)).reshape(pairs),
        means=(jnp.asarray(means)[:, None] + mean).reshape(pairs),
        variances=(jnp.asarray(variances)[:, None] + variance).reshape(pairs),
    )


def has_branches(branches: GaussianBranches) -> bool:
    """Return whether a noise has several branches, so that it is not Gaussian."""
    return int(np.shape(branches.mean)[1]) > 1


def _compute_mean_and_covariance(
    weights: np.ndarray, means: np.ndarray, covariances: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean m (..., m) and covariance P (..., m, m) of a mixture of K Gaussians.

    m = sum_k w_k m_k and P = sum_k w_k (P_k + (m_k - m) (m_k - m)').

    Args:
        weights: w_k (..., K).
        means: m_k (..., K, m).
        covariances: P_k (..., K, m, m).
    """
    mean = np.einsum("...k,...km->...m", weights, means)
    distances = means - mean[..., None, :]
    within = np.einsum("...k,...kij->...ij", weights, covariances)
    return mean, within + np.einsum("...k,...ki,...kj->...ij", weights, distances, distances)


def make_prediction(
    moments: Moments, names: tuple[str, ...], claim: Claim, angles: Angles, limits: PlacedLimits = ()
) -> Prediction:
    """Return the prediction of a mixture of K Gaussians at each horizon, its angles between -pi and pi.

    It has the mean and covariance of all m numbers together, and of each number alone its law: a mixture of Gaussians,
    given by weights, means and variances of its parts.

    Args:
        moments: weights (..., horizons, K), means (..., horizons, K, m) and covariances (..., horizons, K, m, m).
            `laws` has the laws of the single numbers where they are not the same mixture, else it is None.
        names: names of the m predicted numbers.
        claim: what the covariance is said to be (exact, upper bound, nominal); "none" if it says nothing.
        angles: indices of the numbers that are angles.
        limits: index, lowest and highest value of each number that has limits; its law is cut to them.
    """
    weights, means, covariances = map(np.asarray, moments[:3])
    variances = np.maximum(np.diagonal(covariances, axis1=-2, axis2=-1), 0.0)
    means = wrap_near(means, means[..., :1, :], angles)  # within half a turn of the first part, to be averaged
    mean, covariance = _compute_mean_and_covariance(weights, means, covariances)
    if claim == "none":
        covariance = np.full_like(covariance, np.nan)
        variances = np.full_like(variances, np.nan)
    # The law of each number by itself: of these parts, or that in `laws`, whose variances count where one is known.
    law_weights = np.broadcast_to(weights[..., None], means.shape)
    law_means = means
    if moments.laws is not None:
        law_weights, law_means, law_variances = map(np.asarray, moments.laws)
        law_means = wrap_near(law_means, mean[..., None, :], angles)
        known = np.diagonal(covariance, axis1=-2, axis2=-1)[..., None, :]
        variances = np.where(np.isfinite(known), np.maximum(law_variances, 0.0), known)
    # Angles of the mean come to -pi ... pi, and the parts' means move by the same whole turns.
    wrapped = wrap_angles(mean, angles)
    whole_turns = (wrapped - mean)[..., None, :]
    ends = np.tile([-np.inf, np.inf], (len(names), 1))  # lowest and highest value of each number
    for index, low, high in limits:
        ends[index] = low, high
    return Prediction(
        names=names,
        mean=wrapped,
        covariance=covariance,
        claim=claim,
        weights=law_weights,
        part_means=law_means + whole_turns,
        part_variances=variances,
        limits=tuple((low, high) for low, high in ends.tolist()),
    )
