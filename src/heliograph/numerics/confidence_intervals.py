"""Shares that were counted, and of values correlated in time their correlation and the error of their mean."""

from typing import NamedTuple

import numpy as np
import scipy

from heliograph.numerics.module import readable
from heliograph.numerics.types import Float


@readable
class Share(NamedTuple):
    """Probability with its 95 % interval.

    Args:
        estimate: the estimate.
        low: lower end of the interval.
        high: upper end.
    """

    estimate: float
    low: float
    high: float


def wilson(hits: float, of: float) -> Share:
    """Return the share k / n of hits, k = `hits` among n = `of`, with Wilson's 95 % interval; (NaN, 0, 1) if n is 0.

    The interval holds the p with |k - n p| <= 1.96 sqrt(n p (1 - p)).

    Source: Wilson, Probable inference (1927).
    """
    if not of:
        return Share(float("nan"), 0.0, 1.0)
    n, z = of, float(scipy.special.ndtri(0.975))  # z = 1.96
    p = hits / n
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half_width = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    # Without hits the lower end is exactly 0, and with hits only the upper end is exactly 1; rounding would miss this.
    low = 0.0 if hits == 0 else float(middle - half_width)
    high = 1.0 if hits == n else float(middle + half_width)
    return Share(estimate=p, low=low, high=high)


def count_independent(values: Float[np.ndarray, " time"]) -> float:
    """Return the number N (1 - a) / (1 + a) of independent values that tell the mean as well as these N values.

    a is the correlation of neighbours. A negative one counts as 0, so that the number is at most N. It is at least 1.
    """
    deviations, count = values - np.mean(values), len(values)
    sum_of_squares = float(np.sum(deviations**2))
    a = 0.0
    if sum_of_squares and count > 2:
        a = np.clip(np.sum(deviations[1:] * deviations[:-1]) / sum_of_squares, 0.0, 0.999)
    return max(float(count * (1 - a) / (1 + a)), 1.0)


def average_correlated(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Return the mean of correlated values that are not NaN, and its standard error by Bartlett's weights.

    The weights W reach over the cube root of the length. Deviations from the mean of these very values are too small:
    of n independent ones e' W e is n - 1' W 1 / n variances in the mean, and not n, which is made good. The error of a
    single value is not known, NaN.
    """
    is_known = ~np.isnan(values)
    count = max(int(is_known.sum()), 1)
    mean = float(values[is_known].sum() / count)
    if count == 1:
        return mean, float("nan")
    deviations = np.where(is_known, values - mean, 0.0)
    width = int(np.ceil(len(values) ** (1 / 3))) + 1

    def weigh(x: np.ndarray) -> float:
        """Return x' W x = sum_t (1 - |t| / width) sum_k x_k x_(k+t), with Bartlett's weights W.

        It equals the sum of squares of all moving sums of `width` numbers, divided by the width.
        """
        return float(np.sum(np.convolve(x, np.ones(width)) ** 2) / width)

    # e' W e is the variance of the sum of all values but for the loss of the mean, n / (n - 1' W 1 / n).
    variance_of_sum, ones = weigh(deviations), weigh(is_known.astype(float))
    return mean, float(np.sqrt(variance_of_sum * count / (count - ones / count)) / count)


def correlate_over_steps(
    deviations: Float[np.ndarray, "series steps"], lags: int
) -> tuple[Float[np.ndarray, " lags"], float]:
    """Return correlations r_t over t = 1, ..., `lags` steps, and the largest standard error of one that is zero.

    Of N steps n values and n_t pairs of them came: r_t = (1 - t / N) (n / n_t) sum e_k e_(k+t) / sum e_k^2, so that
    pairs that did not come do not count as uncorrelated ones. Where all came the first factors are 1, and the error is
    1 / sqrt(n). r_t is NaN where no pair came, or where nothing varies.

    Args:
        deviations: e, from the mean, NaN for what did not come.
        lags: number of lags.
    """
    is_known = ~np.isnan(deviations)
    e = np.where(is_known, deviations, 0.0)
    steps, count = deviations.shape[1], int(is_known.sum())  # N and n
    power = float(np.sum(e**2))
    correlations = np.full(lags, np.nan)  # r_1, r_2, ...
    errors = [1 / np.sqrt(max(count, 1))]  # standard errors, of which the largest is returned
    for t in range(1, min(lags, steps - 1) + 1):
        pairs = int(np.sum(is_known[:, :-t] & is_known[:, t:]))  # n_t
        if pairs and power > 0:
            share = (1 - t / steps) * count / pairs
            correlations[t - 1] = share * np.sum(e[:, :-t] * e[:, t:]) / power
            errors.append((1 - t / steps) / np.sqrt(pairs))
    return correlations, float(max(errors))


def round_to(value: float, error: float) -> str:
    """Return a number as text, to two digits of its standard error, or to four of its own without an error above 0."""
    if not (np.isfinite(value) and 0 < error < np.inf):
        return f"{value:.4g}"
    decimals = 1 - int(np.floor(np.log10(error)))  # digits after the point; if negative, round to tens or hundreds
    if not -6 <= decimals <= 9:
        return f"{value:.4g}"
    return f"{round(value, decimals):.{max(decimals, 0)}f}"
