"""Covariance of (A, n) in two parts: that of a random gain A, and columns of that of the noise n; and both joined."""

from typing import Any

import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, columns_with_derivatives
from heliograph.numerics.numpy_or_jax import library
from heliograph.random_affine.moments.moment_tensors import Tensor


def split_off_noise(covariance: Tensor, factor: Any = columns_with_derivatives) -> tuple[Tensor, WeightedColumns]:
    """Return the covariances of a random gain A alone, and m columns of Cov n, from those of (A, n).

    `covariance` (m, m, p + 1, p + 1) has at [i, j] the covariance of the rows i and j of (A, n), with n last. If A and
    n are correlated, nothing is split: they are returned as they are, with columns of zeros. `factor` is the function
    that returns columns B and weights w of a covariance, B diag(w) B' = Cov n.
    """
    xp = library(covariance)
    noise_covariance = covariance[..., -1, -1]
    uncorrelated = xp.all(covariance[..., :-1, -1] == 0)  # Cov(A_ia, n_j)
    removed = xp.where(uncorrelated, noise_covariance, 0.0)
    noise = pad_columns(factor(removed))  # m columns, some of them zero if the covariance has fewer
    return covariance - removed[..., None, None] * make_power_of_constant(covariance.shape[-1]), noise


def pad_columns(noise: WeightedColumns) -> WeightedColumns:
    """Return the m x k factor of a covariance, k <= m, with columns of zeros appended, so that it is m x m."""
    xp = library(noise)
    lacking = len(noise.matrix) - noise.matrix.shape[1]
    return WeightedColumns(xp.pad(noise.matrix, ((0, 0), (0, lacking))), xp.pad(noise.weights, (0, lacking)))


def join_gain_and_noise(gain: Tensor, noise: WeightedColumns) -> Tensor:
    """Return the covariances of (A, n) from those of a random gain A alone and the columns of Cov n.

    This is the inverse of `split_off_noise`. Cov n is columns diag(weights) columns', and is added at the constant 1.
    """
    xp = library(gain, noise)
    covariance = (noise.matrix * noise.weights[..., None, :]) @ xp.swapaxes(noise.matrix, -1, -2)
    joint: Tensor = gain + covariance[..., None, None] * make_power_of_constant(gain.shape[-1])
    return joint


def make_power_of_constant(size: int) -> np.ndarray:
    """Return the matrix (size, size) with 1 as its last entry and zeros else: (y, 1) (y, 1)' for y = 0."""
    return np.outer(np.eye(size)[-1], np.eye(size)[-1])
