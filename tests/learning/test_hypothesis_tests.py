"""Log-likelihoods, criteria and tests of fits, against what they are by hand."""

import time
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

import heliograph as hg

RNG = np.random.default_rng(0)
WALK = np.cumsum(RNG.normal(size=150)) + RNG.normal(size=150)


def walk(q=None, r=None):
    """A walk whose variances are free, or known."""

    def network():
        plant = hg.LinearPlant([[1.0]], hg.free(0.5, "q") if q is None else q, [0.0], 1.0)
        sensor = hg.LinearSensor([[1.0]], hg.free(0.5, "r") if r is None else r)
        return hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {})})

    return network


@cache
def found():
    """Both variances fitted, once for all tests."""
    return hg.fit(walk(), WALK, starts=1)


@cache
def fixed():
    """One of them, where the other is known."""
    return hg.fit(walk(r=1.0), WALK, starts=1)


def test_criteria_are_those_of_the_books():
    """k = 2 numbers, n = 150 values."""
    fit = found()
    top = fit.log_likelihood
    assert isinstance(top, float) and fit.log_likelihoods == {"linear": top}
    assert fit.observations == 150 and fit.free_numbers == 2
    assert fit.aic == 4 - 2 * top and fit.bic == 2 * np.log(150) - 2 * top
    assert abs(fit.aicc - (4 - 2 * top + 12 / 147)) < 1e-12


def test_a_ratio_of_likelihoods_and_walds_test_agree():
    """Of one number that is well known: both are chi-square of one degree, and near each other (within a third)."""
    ratio, wald = found().likelihood_ratio(fixed()), found().wald({"r": 1.0})
    assert ratio.freedom == wald.freedom == 1
    assert ratio.statistic == pytest.approx(2 * (found().log_likelihood - fixed().log_likelihood), abs=1e-9)
    assert ratio.p_value == pytest.approx(chi2.sf(ratio.statistic, 1))
    error = found().rows()[1].standard_error
    assert wald.statistic == pytest.approx(((found().values["r"] - 1) / error) ** 2, rel=1e-9)
    far = found().wald({"q": 9.0, "r": 9.0})
    assert far.freedom == 2 and far.p_value < 1e-6


def test_a_fit_is_printed_at_once_and_its_intervals_when_asked_for():
    fit = hg.fit(walk(), WALK, starts=1)
    start = time.perf_counter()
    said = str(fit)
    assert time.perf_counter() - start < 1  # an evaluation of 150 rows takes a millisecond
    assert "about" in said and "`rows()`" in said and "q" in said
    fit.rows()
    assert "about" not in str(fit)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: fixed().likelihood_ratio(found()), "smaller model: expected one of fewer free numbers, got 1 more"),
        (lambda: found().likelihood_ratio(hg.fit(walk(r=1.0), WALK[:100], starts=1)), "same 150 values"),
        (lambda: found().likelihood_ratio(3), "smaller model: expected what hg.fit returns"),
        (lambda: found().wald({"z": 1.0}), r"values: expected numbers for some of \['q', 'r'\]"),
        (lambda: found().wald({}), "values: expected numbers"),
    ],
)
def test_what_cannot_be_tested_says_so_in_one_line(call, words):
    with pytest.raises(hg.InputError, match=words):
        call()
