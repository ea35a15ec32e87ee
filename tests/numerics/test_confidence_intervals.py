"""Means of few values: their standard errors are those of the means, and of one value nothing is known."""

import numpy as np
import pytest

from heliograph.numerics import average_correlated


@pytest.mark.parametrize("count", [2, 5, 20])
def test_errors_of_few_values_are_not_too_small(count):
    """Of independent values it is 1 / sqrt(n); 4,000 series tell its root mean square to 3 %, four standard errors.

    About the mean of the values themselves it was 0.42, 0.65 and 0.9 of that.
    """
    series = np.random.default_rng(0).normal(size=(4000, count))
    said = np.sqrt(np.mean([average_correlated(row)[1] ** 2 for row in series]))
    assert said == pytest.approx(1 / np.sqrt(count), rel=0.05)


def test_of_one_value_no_error_is_known():
    mean, error = average_correlated(np.array([3.0]))
    assert mean == 3.0 and np.isnan(error)
    assert average_correlated(np.full(5, 3.0)) == (3.0, 0.0)


def test_missing_values_do_not_count():
    """Ten of thirty values: the error of ten, to what 4,000 series tell."""
    series = np.random.default_rng(1).normal(size=(4000, 30))
    series[:, np.arange(30) % 3 > 0] = np.nan
    said = np.sqrt(np.mean([average_correlated(row)[1] ** 2 for row in series]))
    assert said == pytest.approx(1 / np.sqrt(10), rel=0.05)
