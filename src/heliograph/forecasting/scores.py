"""Scores of forecasts against what came: coverage, log score, CRPS, and standard errors of means that overlap."""

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from heliograph.forecasting.mixture_moments import Moments
from heliograph.numerics.gaussian_density import LOG_TURN

LEVELS = (0.5, 0.8, 0.95)  # probabilities of the central intervals whose coverage is counted
BANDWIDTH = 1.3  # times the root of the number of rows
ROUNDING = 1e-13  # of a value: a deviation that is no larger is that of rounding, added up over steps


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
    """Return the forecast of one of m numbers at one horizon from each row, as a mixture of K Gaussians (rows, K).

    Args:
        moments: forecasts of all numbers from each row: weights (rows, horizons, K) and means (rows, horizons, K, m).
            `covariances` holds only the variances, as `roll_forecasts` returns them: (rows, horizons, K, m). `laws`
            has the laws of the single numbers where they are not this mixture, each part (rows, horizons, K, m).
        number: index of the number.
        horizon: index of the horizon.
    """
    if moments.laws is not None:
        weights, means, variances = map(np.asarray, moments.laws)
        return MixtureLaws(*(part[:, horizon, :, number] for part in (weights, means, variances)))
    weights, means, variances = map(np.asarray, (moments.weights, moments.means, moments.covariances))
    return MixtureLaws(weights[:, horizon], means[:, horizon, :, number], variances[:, horizon, :, number])


def compute_probability_below(law: MixtureLaws, values: np.ndarray) -> np.ndarray:
    """Return P(X < value) of each row (rows,), X being of the row's law: uniform on (0, 1) where the laws are right.

    Of a value that a part knows exactly (variance 0) it is P(less) + P(equal) / 2: 1/2 where that is what came.

    Args:
        law: each row's forecast, a mixture of Gaussians.
        values: what came (rows,), NaN where nothing did.
    """
    return np.asarray(np.sum(law.weights * ndtr(_standardise(values[:, None] - law.means, law.variances)), axis=1))


def _standardise(difference: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return difference / sqrt(variance); where the variance is 0, a difference of 0 is 0 and any other is infinite."""
    deviation = np.sqrt(variance)
    is_known = deviation == 0
    in_deviations = difference / np.where(is_known, 1.0, deviation)
    return np.asarray(
        np.where(is_known & (difference != 0) & ~np.isnan(difference), np.copysign(np.inf, difference), in_deviations)
    )


def is_known_and_came(law: MixtureLaws, values: np.ndarray) -> np.ndarray:
    """Return in which rows the law knows the value, but for rounding, and it came (rows,).

    Any interval about such a forecast holds what comes, whatever share it claims, so it tests no coverage.

    Args:
        law: each row's forecast.
        values: what came (rows,).
    """
    rounding = ROUNDING * np.abs(law.mean)
    is_known = (np.sqrt(law.variances) <= rounding[:, None]).all(axis=1)
    return np.asarray(is_known & (np.abs(values - law.mean) <= rounding))


def log_score(law: MixtureLaws, values: np.ndarray) -> np.ndarray:
    """Return the log density (rows,) of the values, in nats; larger is better.

    The largest term is taken out of the sum, so that not every exponential is 0. Of what is known exactly (variance 0)
    the density is infinite where it came, and 0 elsewhere. LOG_TURN: log(2 pi).

    Args:
        law: each row's forecast, a mixture of Gaussians.
        values: what came (rows,), NaN where nothing did.
    """
    squares = _standardise(values[:, None] - law.means, law.variances) ** 2
    with np.errstate(divide="ignore"):  # a part may have weight 0, or variance 0
        log_weights = np.log(law.weights)
        log_variances = np.log(law.variances)
    # An infinite square is no density, however small the variance.
    log_terms = log_weights - (squares + np.where(np.isinf(squares), 0.0, log_variances) + LOG_TURN) / 2
    largest = log_terms.max(axis=1)
    finite = np.where(np.isinf(largest), 0.0, largest)
    with np.errstate(divide="ignore", over="ignore"):
        return np.asarray(finite + np.log(np.sum(np.exp(log_terms - finite[:, None]), axis=1)))


def crps(law: MixtureLaws, values: np.ndarray) -> np.ndarray:
    """Return the continuous ranked probability score (rows,), in the unit of the values z; smaller is better.

    It is E|X - z| - E|X - X'| / 2 for independent X and X' of the law. For one Gaussian it is
    s (t (2 Phi(t) - 1) + 2 phi(t) - pi^(-1/2)) with t = (z - m) / s.

    Args:
        law: each row's forecast, a mixture of Gaussians.
        values: what came, z (rows,), NaN where nothing did.

    Source: Gneiting and Raftery, Strictly proper scoring rules (2007); Grimit et al. (2006) for mixtures.
    """
    distance_from_z = np.sum(law.weights * _compute_mean_size(values[:, None] - law.means, law.variances), axis=1)
    # The distance of X and X' takes K^2 terms, and is the same in rows whose laws differ by a shift alone, as those of
    # a settled filter do: each such law once.
    shape = np.concatenate([law.weights, law.means - law.means[:, :1], law.variances], axis=1)
    _, rows, which = np.unique(shape, axis=0, return_index=True, return_inverse=True)
    distance_of_two = _compute_distance_of_two(MixtureLaws(*(part[rows] for part in law)))[which.ravel()]
    return np.asarray(distance_from_z - distance_of_two / 2)


def _compute_distance_of_two(law: MixtureLaws) -> np.ndarray:
    """Return E|X - X'| of independent X and X' of each row's law (rows,); each pair of parts counts twice.

    It is sum_ij w_i w_j E|Y_ij|, with Y_ij Gaussian of mean m_i - m_j and variance v_i + v_j, for parts i and j of the
    mixture.
    """
    total = np.zeros(len(law.weights))
    for i in range(law.weights.shape[1]):
        differences = law.means[:, [i]] - law.means[:, i:]
        variances = law.variances[:, [i]] + law.variances[:, i:]
        pairs = law.weights[:, [i]] * law.weights[:, i:] * _compute_mean_size(differences, variances)
        total += pairs[:, 0] + 2 * pairs[:, 1:].sum(axis=1)
    return total


def _compute_mean_size(mean: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return E|Y| = m (2 Phi(t) - 1) + 2 s phi(t) with t = m / s, for a Gaussian Y of mean m and deviation s."""
    t = _standardise(mean, variance)
    return np.asarray(mean * (2 * ndtr(t) - 1) + 2 * np.sqrt(variance) * np.exp(-(t**2) / 2) / np.sqrt(2 * np.pi))


class ScoreMean(NamedTuple):
    """A mean over rows with its standard error."""

    value: float
    error: float


def average_overlapping(values: np.ndarray, horizon: int) -> ScoreMean:
    """Return the mean of the values (rows,) that are not NaN, and its standard error; both NaN if there are none.

    Forecasts from neighbouring rows share what happens in between, so errors at horizon h are correlated over at least
    h - 1 rows. Let d be the n values' deviations from their mean, and W the matrix of Bartlett's weights, which fall
    linearly to 0 over max(h - 1, 1.3 sqrt(n)) lags (BANDWIDTH: 1.3). Then d' W d / n^2 estimates the squared standard
    error. It is too small in short recordings, since d are deviations from the mean of these very values. For errors
    that overlap, with the correlation matrix S of entries max(1 - lag / h, 0), it is too small by the factor
    E[d' W d] / 1' S 1, where 1 is the vector of ones; so it is divided by that. A single value has the error NaN.

    Source: Newey and West (1987); the number of lags by Lazarus, Lewis, Stock and Watson, HAR inference (2018).

    Args:
        values: a score of each row's forecast (rows,), NaN where nothing came to compare it with.
        horizon: h, how many rows ahead the forecasts go.
    """
    came = ~np.isnan(values)
    n = int(came.sum())
    if not n:
        return ScoreMean(float("nan"), float("nan"))
    mean = float(values[came].mean())
    if n == 1 or not np.isfinite(mean):
        return ScoreMean(mean, float("nan"))
    lags = min(max(horizon - 1, int(BANDWIDTH * n**0.5)), len(values) - 1)
    # W and S as functions of the lag, 1 - lag / count for lags below count; the vector of ones, 0 for values that are
    # NaN.
    bartlett = _fall_over_lags(lags + 1)
    overlap = _fall_over_lags(horizon)
    one = came.astype(float)
    # E[d' W d] = tr(M W M S) with M = I - 1 1' / n over the rows that are not NaN, which `one` marks by ones:
    # tr(W S) + (1' W 1) (1' S 1) / n^2 - 2 / n 1' W S 1.
    # `_weigh_neighbours(v, w)` is the product of the matrix of entries w[|i - j|] and the vector v.
    W_one = _weigh_neighbours(one, bartlett)
    S_one = _weigh_neighbours(one, overlap)
    one_W_one, one_S_one = one @ W_one, one @ S_one
    shortest = min(len(bartlett), len(overlap))
    expected = one @ _weigh_neighbours(one, bartlett[:shortest] * overlap[:shortest])  # tr(W S) = sum of W_ij S_ij
    expected += one_W_one * one_S_one / n**2 - 2 / n * (W_one * one) @ S_one
    # d' W d (1' S 1) / E[d' W d]; over n^2 it is the squared standard error.
    d = np.where(came, values - mean, 0.0)
    total = d @ _weigh_neighbours(d, bartlett) * one_S_one / expected
    return ScoreMean(mean, float(np.sqrt(np.maximum(total, 0.0)) / n))


def average_coverage(is_inside: np.ndarray, horizon: int, level: float) -> ScoreMean:
    """Return the share of forecasts whose interval of probability `level` held what came, with its standard error.

    The error is at least that of an interval that holds what it claims: where all or none were inside, their scatter
    would say 0.

    Args:
        is_inside: of each row 1 if the value was inside, 0 if outside, NaN where nothing came (rows,).
        horizon: rows ahead; forecasts from neighbouring rows overlap over so many.
        level: probability that the interval claims.
    """
    share, error = average_overlapping(is_inside, horizon)
    came = (~np.isnan(is_inside)).astype(float)
    overlap = came @ _weigh_neighbours(came, _fall_over_lags(horizon))
    if not overlap:
        return ScoreMean(share, error)
    return ScoreMean(share, float(np.fmax(error, np.sqrt(level * (1 - level) * overlap) / came.sum())))


def _fall_over_lags(count: int) -> np.ndarray:
    """Return 1 - lag / count of the lags 0 to count - 1."""
    return np.asarray(1 - np.arange(count) / count)


def _weigh_neighbours(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return s_i = sum_j weights[|i - j|] values_j for each row i, over rows nearer than len(weights), itself too."""
    reach = len(weights) - 1
    symmetric = np.concatenate([weights[:0:-1], weights])  # weights of the distances -reach ... reach
    # The full convolution begins `reach` rows before the first row.
    return np.asarray(np.convolve(values, symmetric)[reach : reach + len(values)])
