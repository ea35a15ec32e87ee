"""Fits compared and tested: information criteria, likelihood-ratio and Wald tests."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2
from typing_extensions import TypeAliasType

from heliograph.numerics.check import check_count, fail, scalar, table
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float

ROUNDING = 1e-6  # nats by which the likelihood of a larger model may be lower, as its search ended so near

Values = TypeAliasType("Values", Mapping[str, Float[ArrayLike, ""]])


@readable
class FitTest(NamedTuple):
    """Test of a statement about free numbers, by a statistic that has a chi-square law where it is true.

    Args:
        statistic: the statistic.
        freedom: degrees of freedom: how many numbers the statement fixes.
        p_value: probability of a statistic as large where the statement is true.
    """

    statistic: float
    freedom: int
    p_value: float


def chi_square_test(statistic: float, freedom: int) -> FitTest:
    """Return the test by a statistic that is chi-square with so many degrees of freedom where the statement is true.

    Args:
        statistic: the statistic.
        freedom: degrees of freedom.
    """
    return FitTest(float(statistic), freedom, float(chi2.sf(statistic, freedom)))


def compare_likelihoods(larger: float, smaller: float, freedom: int) -> FitTest:
    """Return the likelihood-ratio test of a model with fewer free numbers, by 2 (l - l_0).

    Args:
        larger: l, the log-likelihood of the model with all numbers free.
        smaller: l_0, the log-likelihood of the model with some of them fixed.
        freedom: how many are fixed.

    Raises:
        ValueError: no number is fixed, or the smaller model has a larger likelihood.
    """
    if freedom < 1:
        raise fail("smaller model", "one of fewer free numbers", f"{-freedom} more" if freedom else "as many")
    # The search for the larger model may have ended too low by ROUNDING nats.
    if smaller > larger + ROUNDING:
        raise fail(
            "smaller model", f"a log-likelihood of at most {larger:.6g}, as part of the larger one", f"{smaller:.6g}"
        )
    return chi_square_test(2 * max(larger - smaller, 0.0), freedom)


def wald_test(
    estimates: Mapping[str, float], covariance: Float[np.ndarray, "entries entries"], values: Values
) -> FitTest:
    """Return Wald's test that some numbers have given values, by d' C^-1 d with their distance d and its covariance C.

    Args:
        estimates: the estimates by name, in the order of the covariance.
        covariance: the covariance of the estimates.
        values: the given values by name.

    Raises:
        ValueError: no values, an unknown name, a number that is at a boundary or not identified.
    """
    given = table("values", values, "numbers")
    if not given or set(given) - set(estimates):
        raise fail("values", f"numbers for some of {list(estimates)}", list(given))
    indices = [list(estimates).index(name) for name in given]
    # Numbers at a boundary, or not identified, have NaN as covariance.
    C = covariance[np.ix_(indices, indices)]
    if not np.isfinite(C).all():
        raise fail("values", "numbers that are identified and not at a boundary", list(given))
    d = np.array([estimates[name] - float(scalar(f"value of {name!r}", value)) for name, value in given.items()])
    return chi_square_test(float(d @ np.linalg.solve(C, d)), freedom=len(indices))


class InformationCriteria(NamedTuple):
    """Criteria by which models are compared, the smaller the better: of Akaike, the same for few data, of Schwarz."""

    aic: float
    aicc: float
    bic: float


def compute_criteria(log_likelihood: float, free: int, observations: int) -> InformationCriteria:
    """Return AIC, AICc and BIC; AICc is infinite unless there are more data than free numbers + 1.

    Args:
        log_likelihood: at the maximum, in nats.
        free: number of free numbers.
        observations: number of values that arrived.
    """
    check_count("observations", observations)
    aic = 2 * free - 2 * log_likelihood
    remaining = observations - free - 1
    return InformationCriteria(
        aic=aic,
        aicc=aic + 2 * free * (free + 1) / remaining if remaining > 0 else float("inf"),
        bic=free * float(np.log(observations)) - 2 * log_likelihood,
    )
