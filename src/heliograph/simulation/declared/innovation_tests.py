"""Tests of the innovations of a filter whose messages declare noise: their sizes by class, and their memory."""

from typing import NamedTuple

import numpy as np
import scipy

from heliograph.filters.wrappers.reported_law import ToldFilter
from heliograph.numerics.counted_shares import average_correlated
from heliograph.numerics.types import Float, Int
from heliograph.simulation.declared.refit import DeclaredRows
from heliograph.simulation.results.whiteness import whitened_innovations

LEVEL = 0.01  # of each test
LAGS = 10  # messages over which correlations are tested, at most


class InnovationTests(NamedTuple):
    """Tests of innovations over their claimed deviation: sizes by class, and correlation over time.

    Args:
        nis: mean square of each class, with the lower and upper end of its interval for a true claim.
        correlation: over one message.
        p_value: of the correlations over up to ten messages, if there were none in truth.
    """

    nis: list[tuple[float, float, float]]
    correlation: float
    p_value: float

    @property
    def contradicts(self) -> bool:
        """True if sizes or correlations contradict the declared variances, at 1 % each."""
        return self.p_value < LEVEL or any(not low <= nis <= high for nis, low, high in self.nis)


def examine_innovations(
    declared: DeclaredRows, filter: ToldFilter, classes: Int[np.ndarray, " steps"]
) -> InnovationTests:
    """Test the innovations of a filter: their mean squares by class, and their correlation over messages.

    Args:
        declared: the recording, and the link that is judged.
        filter: the filter, as declared or refitted.
        classes: class of each row, -1 of a row that is not used.
    """
    # Innovations u over their claimed deviation, of the values of this link.
    white = whitened_innovations(declared.z, filter, declared.u)[:, declared.place.values]
    # Two tails of each class, so that all classes together contradict a true claim with probability LEVEL.
    tail, nis = LEVEL / declared.classes / 2, list[tuple[float, float, float]]()
    for number in range(declared.classes):
        squares = white[classes == number] ** 2
        count = int(np.sum(~np.isnan(squares)))
        mean = float(np.nansum(squares) / count)
        if filter.knows_gain:  # count times the mean is chi-squared of `count` degrees of freedom
            quantiles = (2 * scipy.special.gammaincinv(count / 2, p) / count for p in (tail, 1 - tail))
            low, high = quantiles if count else (0, 1)
        else:  # Gaussian, with an error that counts correlations between rows
            _, error = average_correlated(np.nanmean(squares, axis=1))
            low, high = 1 + error * scipy.special.ndtri(tail), 1 - error * scipy.special.ndtri(tail)
        nis.append((mean, float(low), float(high)))
    return InnovationTests(nis, *_correlate(white[classes >= 0], filter.knows_gain))


def _correlate(white: Float[np.ndarray, "rows m"], exact: bool) -> tuple[float, float]:
    """Return the correlation over one message, and the p-value of those over up to ten; `exact`: claimed independent.

    r_l = sum_k u_k u_k-l / sum_k u_k^2. Independent: Ljung and Box's sum is chi-squared; else each r_l has its error.
    """
    rows, count = len(white), int(np.sum(~np.isnan(white)))
    lags = min(LAGS, rows // 10)
    power = np.nansum(white**2)
    products = [white[lag:] * white[:-lag] for lag in range(1, lags + 1)]
    r = np.array([np.nansum(product) for product in products]) / power
    if exact:
        squared = count * (rows + 2) * r**2 / (rows - np.arange(1, lags + 1))
    else:
        sums = [average_correlated(np.nansum(product, axis=1)) for product in products]
        squared = np.array([(mean / error) ** 2 if error > 0 else 0.0 for mean, error in sums])
    return float(r[0]), float(scipy.special.gammaincc(lags / 2, np.sum(squared) / 2))
