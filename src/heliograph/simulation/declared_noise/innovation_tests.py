"""Tests of the innovations of a filter whose messages declare noise: their sizes by class, and their memory."""

from typing import NamedTuple

import numpy as np
import scipy

from heliograph.filters.wrappers.told_link_law import ToldFilter
from heliograph.numerics.confidence_intervals import average_correlated
from heliograph.numerics.types import Float, Int
from heliograph.simulation.declared_noise.refit import DeclaredRows
from heliograph.simulation.results.whiteness import whitened_innovations

LEVEL = 0.01  # of each test
LAGS = 10  # messages over which correlations are tested, at most


class NisOfClass(NamedTuple):
    """Mean square of the innovations of one class, and the interval in which it is if their claim is true.

    Args:
        mean: of the squares, 1 where the claim is true.
        low: lower end of the interval.
        high: upper end.
    """

    mean: float
    low: float
    high: float


class InnovationTests(NamedTuple):
    """Tests of innovations over their claimed deviation: sizes by class, and correlation over time.

    Args:
        nis: mean square of each class, with its interval for a true claim.
        correlation: over one message.
        p_value: of the correlations over up to ten messages, if there were none in truth.
    """

    nis: list[NisOfClass]
    correlation: float
    p_value: float

    @property
    def contradicts(self) -> bool:
        """True if sizes or correlations contradict the declared variances, at 1 % each."""
        return self.p_value < LEVEL or any(not nis.low <= nis.mean <= nis.high for nis in self.nis)


def examine_innovations(
    declared: DeclaredRows, filter: ToldFilter, classes: Int[np.ndarray, " steps"]
) -> InnovationTests:
    """Test the innovations of a filter: their mean squares by class, and their correlation over messages.

    Messages of the link declare the variance of their noise, and a class has messages of similar variances. If the
    declared variances hold, whitened innovations have mean square 1 in each class, and are not correlated in time.

    Args:
        declared: the recording, and the link that is judged.
        filter: the filter, with variances as declared, or scaled to fit the recording.
        classes: class of each row, -1 of a row that is not used.
    """
    # u = S^-1/2 (z - E z) of the link's values: independent of each other, of variance 1, if S is true.
    values_of_link = declared.columns.values  # columns of z
    whitened = whitened_innovations(declared.z, filter, declared.u)[:, values_of_link]
    # Probability beyond each end of a class's interval, two ends for each class: by Bonferroni, all classes together
    # contradict a true claim with probability LEVEL at most.
    tail = LEVEL / declared.classes / 2
    nis = list[NisOfClass]()
    for number in range(declared.classes):
        squares = whitened[classes == number] ** 2
        count = int(np.sum(~np.isnan(squares)))
        mean = float(np.nansum(squares) / count)
        if filter.knows_gain:
            # With known gains innovations are Gaussian: count times the mean is chi-squared of `count` degrees.
            quantiles = (2 * scipy.special.gammaincinv(count / 2, p) / count for p in (tail, 1 - tail))
            low, high = quantiles if count else (0, 1)  # without values the mean is NaN, in no interval
        else:
            # With random gains only the mean of many squares is Gaussian: 1 -+ quantile * error, with a standard error
            # that counts correlations between rows.
            _, error = average_correlated(np.nanmean(squares, axis=1))
            low, high = 1 + error * scipy.special.ndtri(tail), 1 - error * scipy.special.ndtri(tail)
        nis.append(NisOfClass(mean=mean, low=float(low), high=float(high)))
    correlation, p_value = _test_correlation(whitened[classes >= 0], exact=filter.knows_gain)
    return InnovationTests(nis, correlation, p_value)


def _test_correlation(normalised: Float[np.ndarray, "rows m"], exact: bool) -> tuple[float, float]:
    """Return the correlation r_1 of innovations one message apart, and the p-value of r_1, ..., r_10 together.

    r_l = sum_k u_k u_(k-l) / sum_k u_k^2. If innovations have no memory, the sum over l of r_l^2 / Var(r_l) is
    chi-squared. Var(r_l) is that of Ljung and Box if innovations are independent, else it is estimated.

    Args:
        normalised: innovations u in units of their claimed deviation, NaN where there is none. Fewer than 100 rows are
            tested at fewer lags.
        exact: True if innovations are independent when their claim is true.
    """
    rows, count = len(normalised), int(np.sum(~np.isnan(normalised)))
    lags = min(LAGS, rows // 10)  # LAGS: 10
    power = np.nansum(normalised**2)
    products = [normalised[lag:] * normalised[:-lag] for lag in range(1, lags + 1)]
    correlations = np.array([np.nansum(product) for product in products]) / power
    if exact:
        squares = count * (rows + 2) * correlations**2 / (rows - np.arange(1, lags + 1))
    else:
        sums = [average_correlated(np.nansum(product, axis=1)) for product in products]
        squares = np.array([(mean / error) ** 2 if error > 0 else 0.0 for mean, error in sums])
    p_value = scipy.special.gammaincc(lags / 2, np.sum(squares) / 2)  # upper tail of chi-squared, `lags` degrees
    return float(correlations[0]), float(p_value)
