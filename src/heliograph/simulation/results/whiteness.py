"""Whiteness of a filter's innovations: a test for memory of the links in a filter that assumes none."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from heliograph.filters.base import AbstractFilter
from heliograph.filters.innovation import HALF
from heliograph.filters.rows.run_over_data import check_data, step_over_known_rows
from heliograph.model.estimate import Innovation
from heliograph.numerics.check import array, check_count, fail, instance, rank
from heliograph.numerics.confidence_intervals import average_correlated
from heliograph.numerics.linalg import whiten
from heliograph.numerics.module import readable
from heliograph.numerics.types import Array, ArrayLike, Float, PyTree


@readable
@dataclass(frozen=True)
class MemoryTest:
    """Correlation of innovations in time, with standard errors, as a test for memory of the links.

    Args:
        correlation: at lags 1, 2, ... (lags,).
        standard_error: of the correlation (lags,).
        p_value: of lag 1 under the hypothesis of no memory.
        p_value_of_all: of all lags together, which tell of an error that changes slowly: small at each lag, at many.
        predictable: the cost of memory: share of the innovations' variance that is predictable from earlier ones; 0 for
            the best linear filter.
        power: mean square of the innovations over the claimed one, 1 where the claim holds (NaN where no covariance is
            known).
        power_error: its standard error.
    """

    correlation: Float[np.ndarray, " lags"]
    standard_error: Float[np.ndarray, " lags"]
    p_value: float
    p_value_of_all: float
    predictable: float
    power: float
    power_error: float

    @property
    def significant(self) -> bool:
        """True if innovations one step apart are correlated, at 1 %."""
        return self.p_value < 0.01

    @staticmethod
    def of(white: Float[np.ndarray, "steps m"], lags: int, claimed: bool) -> "MemoryTest":
        """Return the test of whitened innovations.

        r_t = sum_k w_k w_(k+t) / sum_k w_k^2 at lags t, each product the mean over the components.

        Args:
            white: innovations w over their deviations, NaN where nothing arrived.
            lags: number of lags.
            claimed: whether they are in units of a claimed covariance, so that their power tells of it.

        Raises:
            ValueError: too few steps for the lags, nothing but zeros, innovations beyond all numbers.
        """
        if len(white) < 10 * lags:
            raise fail("data", f"at least {10 * lags} steps for {lags} lags", len(white))
        if not np.any(np.nan_to_num(white)):
            raise fail("data", "innovations of which some are not zero", "nothing but zeros and missing ones")
        if np.isinf(white).any():
            raise fail("data", "innovations that are finite numbers of their deviations", "infinite ones")
        # Correlations are the same in any unit: here a power of two near the largest number, so that no square
        # overflows.
        _, exponent = np.frexp(np.nanmax(np.abs(white)))
        unit = 2.0 ** (int(exponent) - 1)
        white = white / unit
        # Correlations and their standard errors by lag.
        size, size_error = average_correlated(_average_components(white**2))
        by_lag = [average_correlated(_average_components(white[:-t] * white[t:])) for t in range(1, lags + 1)]
        correlation, error = (np.array(column) / size for column in zip(*by_lag, strict=True))
        # Lag 1 by itself: Gaussian. Without an error it is known, and is 0 or not; of one pair nothing is known.
        if error[0] > 0:
            p_value = float(2 * scipy.special.ndtr(-abs(correlation[0]) / error[0]))
        else:
            p_value = float(correlation[0] == 0 or np.isnan(error[0]))
        # All lags together: their squares in units of their errors have a chi-squared sum. No error is taken to be
        # below that of as many independent rows.
        rows = np.count_nonzero(~np.isnan(white).all(axis=1))
        in_errors = np.where(np.isnan(error), 0.0, correlation / np.fmax(error, 1 / np.sqrt(rows)))
        # Share of the variance that the best linear prediction from earlier ones takes (Yule and Walker).
        share = correlation @ np.linalg.lstsq(scipy.linalg.toeplitz([1.0, *correlation[:-1]]), correlation)[0]
        return MemoryTest(
            correlation=correlation,
            standard_error=error,
            p_value=p_value,
            p_value_of_all=float(scipy.special.chdtrc(lags, np.sum(in_errors**2))),
            predictable=float(share),
            power=size * unit * unit if claimed else np.nan,
            power_error=size_error * unit * unit if claimed else np.nan,
        )


def memory_test(
    data: Float[ArrayLike, "steps received"],
    filter: AbstractFilter | None = None,
    inputs: Float[ArrayLike, "steps inputs"] | None = None,
    lags: int = 10,
) -> MemoryTest:
    """Return a test of data for memory of the links that a filter ignores.

    A link with memory loses data in bursts, or has a gain that depends on its last one. If a filter ignores that, its
    innovations, scaled to unit variance (w_k), are correlated in time. The best linear filter's innovations are
    uncorrelated, but need not be independent, so that standard errors allow for correlated products w_k w_(k+t) (Newey
    and West).

    Args:
        data: measurements of the filter (steps, received), or innovations if there is no filter; NaN where missing.
        filter: a filter that states a covariance of its innovations; None by default.
        inputs: rows (steps, inputs); by default a filter without inputs is assumed.
        lags: number of lags; 10 by default.

    Raises:
        ValueError: data or inputs of the wrong shape, a filter that claims no covariance, too few steps for the lags,
            innovations that are all zero or missing.

    Source: Ljung and Box (1978) for white innovations; Newey and West (1987) for the standard errors.
    """
    # Innovations by the factor of their stated covariance; data without a filter by their own mean power.
    check_count("lags", lags)
    whitened = _scale_to_unit_power(data) if filter is None else whitened_innovations(data, filter, inputs)
    return MemoryTest.of(whitened, lags, claimed=filter is not None)


def _scale_to_unit_power(data: ArrayLike) -> Float[np.ndarray, "steps m"]:
    """Return innovations (steps, m) of unknown covariance, each component in units of its own root mean square."""
    values = array("innovations", data, (None,) * max(rank("innovations", data), 1), missing=True)
    value = values[:, None] if values.ndim == 1 else values
    # Divide by the largest value before squaring, which may overflow.
    largest = np.max(np.nan_to_num(np.abs(value)), axis=0, initial=0.0)
    value = value / np.where(largest > 0, largest, 1.0)
    count = np.maximum(np.sum(~np.isnan(value), axis=0), 1)
    deviation = np.sqrt(np.nansum(value**2, axis=0) / count)
    return np.asarray(value / np.where(deviation > 0, deviation, 1.0))


def whitened_innovations(
    data: Float[ArrayLike, "steps received"],
    filter: AbstractFilter,
    inputs: Float[ArrayLike, "steps inputs"] | None = None,
) -> Float[np.ndarray, "steps m"]:
    """Return the innovations L^-1 (z - E z) of a recording, which are white and of variance 1 if the claim is true.

    L L' is the claimed covariance of z - E z. A component is NaN if it did not arrive, if the components before it
    determine it, or if a filter that weighs gave it a weight below 1/2.

    Args:
        data: measurements of the filter (steps, received), NaN where a component did not arrive.
        filter: a filter that claims a covariance.
        inputs: rows (steps, inputs); by default a filter without inputs is assumed.

    Raises:
        ValueError: data or inputs of the wrong shape, a filter that claims no covariance.
    """
    _, whitened = score_innovations(filter, data, inputs)
    return np.asarray(whitened)


def _average_components(parts: Float[np.ndarray, "steps m"]) -> Float[np.ndarray, " steps"]:
    """Return the mean over each row's components that are not NaN; NaN where none is."""
    count = np.sum(~np.isnan(parts), axis=1)
    return np.asarray(np.where(count > 0, np.nansum(parts, axis=1) / np.maximum(count, 1), np.nan))


def score_innovations(
    filter: AbstractFilter,
    data: Float[ArrayLike, "steps m"],
    inputs: Float[ArrayLike, "steps inputs"] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the log-likelihood of each step (steps,), and the whitened innovations L^-1 (z - E z) (steps, m).

    L L' is the claimed covariance of z - E z. A component is NaN if it did not arrive, if a filter that weighs gave it
    a weight below 1/2, or if the components before it determine it.

    Args:
        filter: a filter that claims a covariance.
        data: its measurements (steps, m), NaN where a component did not arrive.
        inputs: its inputs (steps, inputs); by default a filter without inputs is assumed.

    Raises:
        ValueError: data or inputs of the wrong shape, a filter that claims no covariance.
    """
    instance("filter", filter, AbstractFilter, "a filter, such as kalman_filter(...)")
    if filter.claim == "none":
        raise fail("filter", "one that claims a covariance", "one that claims none")
    _, (likelihoods, whitened) = step_over_known_rows(filter, *check_data(filter, data, inputs), _score_row)
    return likelihoods, whitened


def _score_row(filter: AbstractFilter, state: PyTree, innovation: Innovation, k: Array) -> tuple[jax.Array, jax.Array]:
    """Return one row's log-likelihood and its whitened innovation (m,), NaN for components that are not used.

    `innovation`: value e, its claimed covariance S and, of a filter that gives unlikely components a smaller weight,
    these weights. Whitened is L^-1 e with L L' = S. The row's state and number are not used.
    """
    is_used = ~jnp.isnan(innovation.value)
    if innovation.weight is not None:  # do not judge a filter by what it mostly left out
        is_used &= innovation.weight >= HALF
    # Replace components that are not used by 0 with variance 1 and no correlation.
    unit_if_unused = jnp.diag(jnp.where(is_used, 0.0, 1.0))
    covariance = jnp.where(is_used[:, None] & is_used, innovation.covariance, unit_if_unused)
    whitened = whiten(covariance, jnp.where(is_used, innovation.value, 0.0))
    return jnp.asarray(innovation.log_likelihood), jnp.where(is_used, whitened, jnp.nan)
