"""The Gaussian log-likelihood of an innovation: SciPy's, on a support, and free where nobody asks."""

import jax
import numpy as np
import pytest
from scipy import stats

import heliograph as hg
from heliograph.filters.innovation import gaussian_innovation, posterior_weights

ROUNDING = 1e-12


def density(value, covariance):
    with jax.enable_x64(True):
        return float(
            gaussian_innovation(np.asarray(value), np.zeros(len(value)), np.asarray(covariance)).log_likelihood
        )


@pytest.mark.parametrize("m", [1, 2, 5, 12])
@pytest.mark.parametrize("units", [1.0, 1e-9])
def test_it_is_scipys(m, units):
    draw = np.random.default_rng(m)
    root = draw.normal(size=(m, m)) * np.append(np.ones(m - 1), units)[:, None]
    value, covariance = root @ draw.normal(size=m), root @ root.T
    # in units in which SciPy, whose tolerance is relative to the largest eigenvalue, loses nothing
    scale = np.sqrt(np.diag(covariance))
    expected = stats.multivariate_normal(np.zeros(m), covariance / np.outer(scale, scale)).logpdf(value / scale)
    assert density(value, covariance) == pytest.approx(expected - np.log(scale).sum(), rel=1e-9)


def test_components_that_did_not_arrive_are_left_out():
    covariance = np.array([[2.0, 0.5, 0.3], [0.5, 1.0, 0.2], [0.3, 0.2, 3.0]])
    with jax.enable_x64(True):
        result = gaussian_innovation(np.array([1.0, np.nan, -2.0]), np.array([0.5, 0.0, 0.0]), covariance)
    left = np.array([0, 2])
    assert np.array_equal(np.isnan(result.value), [False, True, False])
    assert np.array_equal(np.isnan(result.covariance), np.isnan(result.value)[:, None] | np.isnan(result.value))
    expected = stats.multivariate_normal(np.zeros(2), covariance[np.ix_(left, left)]).logpdf([0.5, -2.0])
    assert float(result.log_likelihood) == pytest.approx(expected, rel=ROUNDING)
    assert density([np.nan, np.nan], np.eye(2)) == 0


def test_on_a_support_the_free_components_count():
    """z_2 = 2 z_1 and z_3 known: the density of z_1 where they agree, none where they do not."""
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = 0.7 * np.outer([1.0, 2.0], [1.0, 2.0])
    assert density([0.4, 0.8, 0.0], covariance) == pytest.approx(stats.norm.logpdf(0.4, 0, np.sqrt(0.7)), rel=ROUNDING)
    assert density([0.4, 0.9, 0.0], covariance) == -np.inf
    assert density([0.4, 0.8, 0.1], covariance) == -np.inf


def test_an_indefinite_covariance_gives_nan():
    assert np.isnan(density([0.1, 0.2], [[1.0, 2.0], [2.0, 1.0]]))


def test_a_silent_channel_says_nothing():
    plant, sensor = hg.LinearPlant([[0.9]], 0.1, [1.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
    item = hg.linear_filter(plant, sensor, hg.model.silent())
    received = item.correct(item.predict(item.init()), [0.0])[1]
    assert received.value[0] == 0 and received.covariance[0, 0] == 0 and received.log_likelihood == 0


def test_the_covariance_behind_a_random_gain_is_that_of_the_data():
    """S of the first step by the law of total variance: E[g^2] Var y + Var(g) (E y)^2 + noise."""
    plant, sensor = hg.LinearPlant([[0.5]], 0.2, [3.0], 1.0), hg.LinearSensor([[2.0]], 0.1)
    gain = hg.Discrete([0.5, 1.0], [0.3, 0.7], 0.1)  # uncertain: the innovation is the nominal law's
    variance, mean = 4 * (0.25 + 0.2) + 0.1, 2 * 1.5
    spread = gain.moment(2) - gain.moment(1) ** 2
    expected = gain.moment(2) * variance + spread * mean**2 + 0.3
    for make in (hg.linear_filter, hg.cubature_filter):
        item = make(plant, sensor, hg.hop(gain, 0.3))
        received = item.correct(item.predict(item.init()), [2.0])[1]
        assert received.covariance[0, 0] == pytest.approx(expected, rel=ROUNDING)
        assert received.value[0] == pytest.approx(2.0 - gain.moment(1) * mean, rel=ROUNDING)


def test_a_step_computes_an_innovation_only_on_request():
    plant, sensor = hg.LinearPlant(0.9 * np.eye(2), 0.1, [1.0, 0.0], 1.0), hg.LinearSensor(np.eye(2), 0.1)
    item = hg.linear_filter(plant, sensor, hg.hop(hg.Rayleigh(1.0), 0.1, dimension=2))

    def program(function):
        with jax.enable_x64(True):
            z = jax.numpy.ones((32, 2))
            return jax.jit(jax.vmap(lambda z: function(item.init(), z))).lower(z).compile().as_text()

    assert " log(" in program(lambda s, z: item.correct(s, z)[1].log_likelihood)
    assert " log(" not in program(item.step)


def test_what_all_components_exclude_leaves_their_weights():
    """And an impossible component stays so, whatever it says; the log-likelihood is -inf."""
    with jax.enable_x64(True):
        weights = np.array([0.3, 0.7, 0.0])
        after, density, excluded = posterior_weights(weights, np.array([-np.inf, -np.inf, np.nan]))
        assert bool(excluded) and float(density) == -np.inf
        np.testing.assert_allclose(after, weights, rtol=1e-15)
        after, density, excluded = posterior_weights(weights, np.array([-2.0, -1.0, 5.0]))
    assert not bool(excluded)
    raw = np.array([0.3 * np.exp(-2.0), 0.7 * np.exp(-1.0), 0.0])
    np.testing.assert_allclose(after, raw / raw.sum(), rtol=1e-15)
    assert float(density) == pytest.approx(np.log(raw.sum()), rel=1e-15)


@pytest.mark.parametrize("big", [1e300, 8.9e307, 1e308])
def test_a_variance_near_the_largest_number_is_as_if_nothing_was_measured(big):
    """log N by logarithms: two steps, each with -log(2 pi big) / 2 beside the density of what is measured."""
    plant = hg.LinearPlant(np.eye(2), 0.1 * np.eye(2), [0.0, 0.0], np.eye(2))
    z = np.array([[1.0, 2.0], [1.5, 2.5]])
    result = hg.kalman_filter(plant, hg.LinearSensor(np.eye(2), np.diag([big, 0.01]))).run(z)
    alone = hg.kalman_filter(plant, hg.LinearSensor([[0.0, 1.0]], 0.01)).run(z[:, 1:])
    expected = alone.log_likelihood - (np.log(2 * np.pi) + np.log(big))
    assert result.log_likelihood == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(result.means, alone.means, rtol=1e-12, atol=1e-280)
    robust = hg.robust_filter(
        plant, hg.LinearSensor(np.eye(2), np.diag([big, 0.01])), hg.perfect(2), hg.filters.Huber()
    )
    assert robust.run(z).means[-1, 1] == pytest.approx(alone.means[-1, 1], rel=0.2)  # of what Huber's weight leaves
