"""The mean of a series that remembers, and its standard error."""

import numpy as np

from heliograph.learning.intervals import bartlett
from heliograph.numerics.types import Float


def long_run_deviation(values: Float[np.ndarray, " steps"]) -> float:
    """Standard deviation of the sum, over the root of the length: by Bartlett's weights."""
    total = bartlett([values[:, None] - values.mean()]).covariance
    return float(np.sqrt(max(total[0, 0], 0.0) / len(values)))


def mean_and_error(values: Float[np.ndarray, " steps"]) -> tuple[float, float]:
    """Mean, and its standard error."""
    return float(values.mean()), long_run_deviation(values) / float(np.sqrt(len(values)))
