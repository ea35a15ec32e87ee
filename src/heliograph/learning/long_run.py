"""Mean of a series that is correlated over time, and its standard error."""

import numpy as np

from heliograph.learning.intervals import bartlett
from heliograph.numerics.types import Float


def long_run_deviation(values: Float[np.ndarray, " steps"]) -> float:
    """Standard deviation of the sum over the root of the length, by Bartlett's weights."""
    total = bartlett([values[:, None] - values.mean()]).covariance
    return float(np.sqrt(max(total[0, 0], 0.0) / len(values)))


def mean_and_error(values: Float[np.ndarray, " steps"]) -> tuple[float, float]:
    """Mean of a series (steps,), and its standard error."""
    return float(values.mean()), long_run_deviation(values) / float(np.sqrt(len(values)))
