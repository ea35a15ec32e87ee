"""How large the squared innovations of one recording are, beside what the filter's claim makes of that recording."""

from dataclasses import replace

import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.numerics.confidence_intervals import average_correlated
from heliograph.numerics.types import Float
from heliograph.simulation.results.whiteness import MemoryTest


def compute_expected_squares(
    filter: AbstractFilter, data: Float[np.ndarray, "steps m"], inputs: Float[np.ndarray, "steps inputs"]
) -> Float[np.ndarray, "steps m"]:
    """Return the mean square, over its claimed variance, that the model expects of each innovation in this recording.

    It is the innovation's variance given this recording, divided by its variance over all runs. That is 1 for most
    filters. With random gains of the links it is not, since the state of this run differs from its mean over all runs.
    Then `given_record` returns another filter, whose covariances are given the data; else it returns the filter itself.
    `data`: what the filter received (steps, m). The result (steps, m) is 1 too where no variance is claimed.
    """
    conditioned = filter.given_record()
    if conditioned is filter:
        return np.ones(data.shape)
    # Variances of the innovations (steps, m), given this recording and over all runs.
    in_run, over_runs = (
        np.diagonal(one.run(data, inputs).innovation_covariances, axis1=1, axis2=2) for one in (conditioned, filter)
    )
    is_positive = over_runs > 0
    return np.where(is_positive, in_run / np.where(is_positive, over_runs, 1.0), 1.0)


def compute_ratio_of_squares(
    squares: Float[np.ndarray, " steps"], expected: Float[np.ndarray, " steps"]
) -> tuple[float, float]:
    """Return (ratio, standard error): the mean square over the expected mean square, which is 1 if the claim holds.

    Args:
        squares: squared innovations in units of their claim, NaN where there is none.
        expected: what the model expects of each square in this recording, over its variance in all runs; 1 for most
            filters.
    """
    is_known = ~np.isnan(squares) & ~np.isnan(expected)
    if not is_known.any() or not expected[is_known].any():
        return np.nan, np.nan
    mean_expected = float(expected[is_known].mean())
    ratio = float(squares[is_known].mean()) / mean_expected
    # To first order, the error of this ratio of means is the error of mean(square - ratio * expected), divided by
    # mean(expected).
    _, residual_error = average_correlated(np.where(is_known, squares - ratio * expected, np.nan))
    return ratio, residual_error / mean_expected


def scale_size_to_expected(
    test: MemoryTest, white: Float[np.ndarray, "steps m"], expected: Float[np.ndarray, "steps m"]
) -> MemoryTest:
    """Return the test with its mean square (`power`) divided by that which the model expects in this recording.

    Args:
        test: test of the innovations' size and memory.
        white: innovations in units of their claimed deviations (steps, m), NaN where none came.
        expected: what the model expects of each square (steps, m) in this recording, over its variance in all runs. If
            all are 1, `test` is returned.
    """
    if np.all(expected == 1):
        return test
    came = ~np.isnan(white)
    # Means over the numbers of each row; NaN in a row without any.
    count = np.maximum(came.sum(axis=1), 1)
    mean_squares = np.where(came, white**2, 0.0).sum(axis=1) / count
    mean_expected = np.where(came, expected, 0.0).sum(axis=1) / count
    mean_squares = np.where(came.any(axis=1), mean_squares, np.nan)
    power, error = compute_ratio_of_squares(mean_squares, mean_expected)
    return replace(test, power=power, power_error=error)
