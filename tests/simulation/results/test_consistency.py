"""NEES and NIS on plain arrays, and the chi-squared law that they are compared with."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import heliograph as hg


@given(st.integers(1, 4), st.integers(0, 1000))
def test_nees_is_the_quadratic_form(n, seed):
    rng = np.random.default_rng(seed)
    truth, mean, root = rng.normal(size=(5, n)), rng.normal(size=(5, n)), rng.normal(size=(5, n, n))
    covariance = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(n)
    expected = [e @ np.linalg.solve(p, e) for e, p in zip(truth - mean, covariance, strict=True)]
    np.testing.assert_allclose(hg.nees(truth, mean, covariance), expected, rtol=1e-9)  # condition below 1e4
    np.testing.assert_allclose(hg.nis(truth - mean, covariance), expected, rtol=1e-9)
    np.testing.assert_allclose(hg.nees(truth[0], mean[0], covariance[0]), expected[0], rtol=1e-9)


def test_one_covariance_is_that_of_all_steps():
    e, p = np.array([[1.0, 2.0], [np.nan, 0.5], [3.0, -1.0]]), np.array([[2.0, 0.5], [0.5, 1.0]])
    repeated = np.tile(p, (3, 1, 1))
    np.testing.assert_array_equal(hg.nees(e, np.zeros_like(e), p), hg.nees(e, np.zeros_like(e), repeated))
    np.testing.assert_array_equal(hg.nis(e, p), hg.nis(e, repeated))


def test_missing_components_are_left_out():
    s = np.array([[2.0, 1.0], [1.0, 3.0]])
    e = np.array([[1.0, np.nan], [np.nan, 2.0], [np.nan, np.nan]])
    expected = [1 / 2, 4 / 3, np.nan]
    np.testing.assert_allclose(hg.nis(e, np.tile(s, (3, 1, 1))), expected, rtol=1e-15)
    np.testing.assert_allclose(hg.nees(e, np.zeros((3, 2)), np.tile(s, (3, 1, 1))), expected, rtol=1e-15)


def test_what_is_known_exactly_counts_one_or_is_infinite():
    covariance = np.diag([1.0, 0.0])
    assert hg.nees([2.0, 1.0], [0.0, 1.0], covariance) == 5
    assert np.isinf(hg.nees([2.0, 1.1], [0.0, 1.0], covariance))


def test_a_true_claim_has_the_chi_squared_law():
    """Of 400 simulations the 95 % interval holds the mean in 360 to 397 (0.999 of a binomial law); so each step's."""
    rng = np.random.default_rng(1)
    runs = rng.normal(size=(400, 50, 3))
    values = hg.nis(runs, np.tile(np.eye(3), (400, 50, 1, 1)))
    inside = sum(hg.consistency(row, 3, lags=1).consistent for row in values)
    low, high = stats.binom.ppf([0.0005, 0.9995], 400, 0.95)
    assert low <= inside <= high
    result = hg.consistency(values, 3)
    assert result.expected == 3 and result.consistent and result.means.shape == (50,)
    np.testing.assert_allclose(result.means, values.mean(axis=0))
    np.testing.assert_allclose(result.interval, stats.chi2.ppf([0.025, 0.975], 60_000) / 20_000)
    np.testing.assert_allclose(result.intervals[7], stats.chi2.ppf([0.025, 0.975], 1200) / 400)
    within = (result.intervals[:, 0] <= result.means) & (result.means <= result.intervals[:, 1])
    assert stats.binom.ppf(0.001, 50, 0.95) <= within.sum()
    assert np.all(np.abs(result.autocorrelation) < 2 * result.autocorrelation_bound)  # of ten, four deviations


def test_a_false_claim_is_seen_and_correlation_too():
    rng = np.random.default_rng(2)
    e = rng.normal(size=500)
    drift = np.zeros(500)
    for k in range(1, 500):
        drift[k] = 0.9 * drift[k - 1] + np.sqrt(1 - 0.9**2) * e[k]
    ones = np.ones((500, 1, 1))
    assert not hg.consistency(hg.nis(1.2 * e[:, None], ones), 1).consistent
    result = hg.consistency(hg.nis(drift[:, None], ones), 1)
    assert result.autocorrelation[0] == pytest.approx(0.81, abs=0.12)  # rho^2 of squares; 500 steps
    assert result.autocorrelation[0] > 5 * result.autocorrelation_bound


def test_missing_values_do_not_hide_a_correlation():
    """rho^2 = 0.81 of squares, of which three in ten came: other pairs counted as 0, which made it 0.24.

    20 runs of 5,000 steps know it to some 0.02.
    """
    rng = np.random.default_rng(2)
    drift = np.zeros((20, 5000))
    for k in range(1, 5000):
        drift[:, k] = 0.9 * drift[:, k - 1] + np.sqrt(1 - 0.9**2) * rng.normal(size=20)
    drift[rng.random(drift.shape) < 0.7] = np.nan
    result = hg.consistency(hg.nis(drift[..., None], np.eye(1)), 1, lags=3)
    np.testing.assert_allclose(result.autocorrelation, 0.81 ** np.arange(1, 4), atol=0.08)


def test_correlations_of_few_pairs_are_in_their_bound_as_often_as_it_says():
    """White values of which a third came, 300 times: 95 % of ten lags, within what 3,000 dependent trials leave."""
    rng = np.random.default_rng(3)
    inside = []
    for _ in range(300):
        z = rng.normal(size=(300, 1))
        z[rng.random(300) < 2 / 3] = np.nan
        found = hg.consistency(hg.nis(z, np.eye(1)), 1)
        inside.append(np.abs(found.autocorrelation) <= found.autocorrelation_bound)
    assert 0.93 < np.mean(inside) < 0.985  # the bound is that of the lag with the fewest pairs


def test_a_lag_that_no_two_values_have_has_no_correlation():
    values = np.full(40, np.nan)
    values[::2] = np.random.default_rng(0).chisquare(1, size=20)
    result = hg.consistency(values, 1, lags=4)
    assert np.isnan(result.autocorrelation).tolist() == [True, False, True, False]
    assert np.isnan(hg.consistency(np.ones(9), 1).autocorrelation).all()  # nothing varies


def test_errors_and_innovations_across_a_full_turn_are_judged_by_the_shorter_way():
    """A heading about pi, once by place and once by the model: 2,000 values of two degrees of freedom each."""
    rng = np.random.default_rng(3)
    truth = np.column_stack([np.pi + 0.1 * rng.normal(size=2000), rng.normal(size=2000)])
    mean = truth + rng.normal(size=truth.shape) * [0.1, 1.0]
    truth[:, 0], mean[:, 0] = (np.angle(np.exp(1j * heading)) for heading in (truth[:, 0], mean[:, 0]))
    claimed = np.diag([0.01, 1.0])
    plant = hg.Plant(lambda x, u: x, np.eye(2), [0.0, 0.0], np.eye(2), states=["heading", "x"], circular=["heading"])
    sensor = hg.Sensor(lambda x: x, np.eye(2), outputs=["heading", "x"], circular=["heading"])
    assert not hg.consistency(hg.nees(truth, mean, claimed), 2).consistent
    for values in (
        hg.nees(truth, mean, claimed, plant),
        hg.nees(truth, mean, claimed, [0]),
        hg.nis(truth - mean, claimed, sensor),
        hg.nis(truth - mean, claimed, [0]),
    ):
        assert hg.consistency(values, 2).consistent
    with pytest.raises(ValueError, match="angles: expected those of a sensor of 3 outputs, got one of"):
        hg.nis(np.zeros(3), np.eye(3), sensor)


def test_each_value_may_have_its_degrees_of_freedom():
    values = np.array([1.0, 2.0, np.nan])
    result = hg.consistency(values, [1, 2, 1])
    assert (result.mean, result.expected) == (1.5, 1.5)
    np.testing.assert_allclose(result.interval, stats.chi2.ppf([0.025, 0.975], 3) / 2)
    assert np.isnan(result.means[2]) and np.isnan(result.intervals[2]).all()


@pytest.mark.parametrize(
    ("values", "dimension", "words"),
    [
        ([np.nan], 1, "values: expected at least one that is not NaN"),
        ([1.0], 0, "dimension: expected the degrees of freedom"),
        ([1.0, 2.0], [1, 2, 3], "dimension: expected the degrees of freedom"),
    ],
)
def test_what_cannot_be_compared_is_refused(values, dimension, words):
    with pytest.raises(ValueError, match=words):
        hg.consistency(values, dimension)
    with pytest.raises(ValueError, match="confidence"):
        hg.consistency([1.0], 1, confidence=1.0)


@pytest.mark.parametrize("judge", [lambda e, p: hg.nees(e, 0 * e, p), hg.nis])
def test_a_matrix_that_is_no_covariance_is_refused(judge):
    """Of an asymmetric one only a triangle would count; an indefinite one gave NaN, which counts as missing."""
    e = np.ones((3, 2))
    with pytest.raises(hg.InputError, match="covariance: expected symmetric matrices, got entries that differ by 1 "):
        judge(e, np.array([[2.0, 1.0], [0.0, 2.0]]))
    indefinite = np.stack([np.eye(2), np.array([[1.0, 2.0], [2.0, 1.0]]), np.eye(2)])
    with pytest.raises(hg.InputError, match=r"covariance at 1: expected a positive semidefinite .* eigenvalue -1$"):
        judge(e, indefinite)
    # What is missing is no claim, and a state known exactly is one.
    assert np.isnan(judge(e, np.full((2, 2), np.nan))).all()
    assert judge(e, np.diag([0.0, 1.0])).tolist() == [np.inf] * 3
