"""Tests of innovations in units of their claimed covariance: their size, their memory, and one that is too large."""

from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from heliograph.numerics.types import Float
from heliograph.simulation.results.whiteness import MemoryTest

LAGS = 10  # of the test for memory, with ten rows for each at least
LEAST_SIZE = 1.1  # ratio of a mean square to its claim, or the reverse, below which none is worth a warning


def judge_size(size: float, error: float, numbers: int, level: float) -> int:
    """Return 1 (too large) or -1 (too small) if a mean square differs from its claim, 1, significantly; else 0.

    log(size) is nearly Gaussian with the standard error error / size. That is itself an estimate, so at least
    sqrt(2 / N) is taken, its value for N independent Gaussian numbers. To be significant, the difference must also
    exceed the factor LEAST_SIZE.

    Args:
        size: mean square of innovations over their claimed variance.
        error: its standard error.
        numbers: N, how many innovations it is the mean of.
        level: probability of a false alarm.
    """
    if not (size > 0 and error > 0):
        return 0
    relative_error = max(error / size, np.sqrt(2 / numbers) if numbers else 0.0)  # of size: the error of its logarithm
    half_width = max(-ndtri(level / 2) * relative_error, np.log(LEAST_SIZE))
    return int(np.sign(np.log(size))) if abs(np.log(size)) > half_width else 0


class ImpossibleInnovation(NamedTuple):
    """An innovation of `deviations` claimed standard deviations in row number `row`, counted from 1."""

    row: int
    deviations: float


def find_impossible_innovation(
    white: Float[np.ndarray, "steps m"] | None, probability: float
) -> ImpossibleInnovation | None:
    """Return the largest innovation if no law with the claimed variance gives one as large so often, else None.

    By Chebyshev's inequality P(|e| >= t) <= 1 / t^2 for every law of e with a mean square of at most 1, so that neither
    Gaussian noise nor a number of rows is needed. The result has its row, counted from 1, and its size in deviations.

    Args:
        white: innovations in units of their claimed covariance, NaN where nothing arrived; None for a filter without a
            claim.
        probability: an innovation is called impossible if one as large has less than this probability.
    """
    if white is None or not np.any(~np.isnan(white)):
        return None
    sizes = np.abs(np.nan_to_num(white))
    row, _ = np.unravel_index(np.argmax(sizes), sizes.shape)
    largest = float(sizes.max())
    return ImpossibleInnovation(int(row) + 1, largest) if largest**2 * probability > 1 else None


def subtract_mean(white: Float[np.ndarray, "steps m"]) -> Float[np.ndarray, "steps m"]:
    """Return the innovations minus the mean of each output.

    If outliers lie to one side and a filter drops them, the innovations that it keeps have a mean other than 0. The
    test for correlation in time would take it for memory.
    """
    count = np.maximum(np.sum(~np.isnan(white), axis=0), 1)
    return np.asarray(white - np.nansum(white, axis=0) / count)


def find_memory(white: Float[np.ndarray, "steps m"]) -> MemoryTest | None:
    """Return the test whether innovations are correlated from message to message; None if there are too few for it.

    It needs ten rows for each lag, more than LAGS numbers, and one that is not 0. Rows in which nothing came are left
    out. `white`: innovations in units of their claimed covariance. LAGS is 10: the most lags that are tested.
    """
    came = white[~np.isnan(white).all(axis=1)]
    lags = min(LAGS, len(came) // 10)
    if not lags or np.count_nonzero(~np.isnan(came)) <= LAGS or not np.any(np.nan_to_num(came)):
        return None
    return MemoryTest.of(came, lags, claimed=True)
