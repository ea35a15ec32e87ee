"""Scores of forecasts against what came: coverage, log score, CRPS, and standard errors of means that overlap."""

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from heliograph.forecasting.mixture_moments import Moments
from heliograph.numerics.gaussian_density import LOG_TURN

LEVELS = (0.5, 0.8, 0.95)  # probabilities of the central intervals whose coverage is counted
BANDWIDTH = 1.3  # times the root of the number of rows


class MixtureLaws(NamedTuple):
    """Mixtures of Gaussians, one for each row: weights, means and variances (rows, K)."""

    weights: np.ndarray
    means: np.ndarray
    variances: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """Mean of each row's forecast (rows,)."""
        return np.asarray(np.sum(self.weights * self.means, axis=1))


def select_law(moments: Moments, number: int, horizon: int) -> MixtureLaws:
    """Return the law of one number at one horizon (its index), from each row."""
    if moments.laws is not None:
        weights, means, variances = map(np.asarray, moments.laws)
        of_number = (slice(None), horizon, slice(None), number)
        return MixtureLaws(weights[of_number], means[of_number], variances[of_number])
    weights, means = np.asarray(moments.weights), np.asarray(moments.means)
    variances = np.asarray(moments.covariances)  # the field holds variances here, in place of covariances
    return MixtureLaws(weights[:, horizon], means[:, horizon, :, number], variances[:, horizon, :, number])


def compute_probability_below(law: MixtureLaws, values: np.ndarray) -> np.ndarray:
    """Return P(less than what came) of each row (rows,): uniform on (0, 1) where the laws are right."""
    return np.asarray(np.sum(law.weights * ndtr((values[:, None] - law.means) / np.sqrt(law.variances)), axis=1))


def log_score(law: MixtureLaws, values: np.ndarray) -> np.ndarray:
    """Return the log density (rows,) of the values, in nats; larger is better.

    The largest term is taken out of the sum, so that not every exponential is 0. LOG_TURN: log(2 pi).
    """
    squares = (values[:, None] - law.means) ** 2 / law.variances
    with np.errstate(divide="ignore"):  # a part may have weight 0
        log_weights = np.log(law.weights)
    log_terms = log_weights - (squares + np.log(law.variances) + LOG_TURN) / 2
    largest = log_terms.max(axis=1)
    return np.asarray(largest + np.log(np.sum(np.exp(log_terms - largest[:, None]), axis=1)))


def crps(law: MixtureLaws, values: np.ndarray) -> np.ndarray:
    """Return the continuous ranked probability score (rows,), in the unit of the values z; smaller is better.

    It is E|X - z| - E|X - X'| / 2 for independent X and X' of the law. For one Gaussian it is
    s (t (2 Phi(t) - 1) + 2 phi(t) - pi^(-1/2)) with t = (z - m) / s.

    Source: Gneiting and Raftery, Strictly proper scoring rules (2007); Grimit et al. (2006) for mixtures.
    """
    distance_from_z = np.sum(law.weights * _compute_mean_size(values[:, None] - law.means, law.variances), axis=1)
    distance_of_two = np.zeros(len(values))  # E|X - X'|
    for i in range(law.weights.shape[1]):
        differences, variances = law.means[:, [i]] - law.means, law.variances[:, [i]] + law.variances
        mean_sizes = _compute_mean_size(differences, variances)
        distance_of_two += law.weights[:, i] * np.sum(law.weights * mean_sizes, axis=1)
    return np.asarray(distance_from_z - distance_of_two / 2)


def _compute_mean_size(mean: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return E|Y| = m (2 Phi(t) - 1) + 2 s phi(t) with t = m / s, for a Gaussian Y of mean m and deviation s."""
    deviation = np.sqrt(variance)
    t = mean / deviation
    return np.asarray(mean * (2 * ndtr(t) - 1) + 2 * deviation * np.exp(-(t**2) / 2) / np.sqrt(2 * np.pi))


class ScoreMean(NamedTuple):
    """A mean over rows with its standard error."""

    value: float
    error: float


def average_overlapping(values: np.ndarray, horizon: int) -> ScoreMean:
    """Return the mean of the values (rows,) that are not NaN, and its standard error; both NaN if there are none.

    Forecasts from neighbouring rows share what happens in between, so errors at horizon h are correlated over at least
    h - 1 rows. The squared error is n^-2 sum_l w_l sum_t d_t d_(t+l), with deviations d from the mean and Bartlett's
    weights w over max(h - 1, 1.3 sqrt(n)) lags. BANDWIDTH: 1.3.

    Source: Newey and West (1987); the number of lags by Lazarus, Lewis, Stock and Watson, HAR inference (2018).
    """
    came = ~np.isnan(values)
    count = int(came.sum())
    if not count:
        return ScoreMean(float("nan"), float("nan"))
    mean = float(values[came].mean())
    d = np.where(came, values - mean, 0.0)
    lags = min(max(horizon - 1, int(BANDWIDTH * count**0.5)), len(values) - 1)
    total = d @ d
    for lag in range(1, lags + 1):
        bartlett_weight = 1 - lag / (lags + 1)
        total += 2 * bartlett_weight * (d[lag:] @ d[:-lag])
    return ScoreMean(mean, float(np.sqrt(np.maximum(total, 0.0)) / count))
