"""The mean of a series that remembers, and its standard error."""

import numpy as np

from heliograph.numerics.types import Float


def long_run_variance(values: Float[np.ndarray, "steps k"]) -> Float[np.ndarray, "k k"]:
    """Covariance of sqrt(T) times the mean: Bartlett's weights over L = ceil(4 (T / 100)^(2/9)) lags.

    Source: Newey and West (1987, 1994).
    """
    apart = values - values.mean(axis=0)
    steps = len(apart)
    lags = min(int(np.ceil(4 * (steps / 100) ** (2 / 9))), steps - 1)
    total = apart.T @ apart / steps
    for lag in range(1, lags + 1):
        product = apart[lag:].T @ apart[:-lag] / steps
        total = total + (1 - lag / (lags + 1)) * (product + product.T)
    return np.asarray(total)


def mean_and_error(values: Float[np.ndarray, " steps"]) -> tuple[float, float]:
    """Mean, and the root of the long-run variance over the length."""
    variance = float(long_run_variance(values[:, None])[0, 0])
    return float(values.mean()), float(np.sqrt(max(variance, 0.0) / len(values)))
