"""Noises given all data: those of statsmodels, of the joint law, of the law that they claim; breaks and outliers."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.forecasting import disturbances
from tests.models.public_series import NILE


def level(noise=15099.0):
    plant = hg.LinearPlant([[1.0]], 1469.1, [0.0], 1e7, states=["level"])
    return hg.kalman_filter(plant, hg.LinearSensor([[1.0]], noise, outputs=["flow"]))


def test_the_niles_are_statsmodels():
    """statsmodels 0.15, local level from a known start; its variances are given all data, and add up with ours.

    The largest are the textbook's, of 1899 and 1913; among two hundred tests neither is rare.
    """
    found = disturbances(level(), NILE)
    expected = [8.77967664334, -343.453268286, -58.3702926084]
    np.testing.assert_allclose(found.output_noise[[0, 42, 99], 0], expected, rtol=1e-10)
    expected = [-0.691018124934, -48.6551047443, 18.2292502847, -5.67930305788]
    np.testing.assert_allclose(found.state_noise[[1, 28, 43, 99], 0], expected, rtol=1e-10)
    given = np.array([63.486478922376, 48.236468256102, 63.499275128215])
    np.testing.assert_allclose(found.output_deviation[[0, 42, 99], 0] ** 2, 15099 - given**2, rtol=1e-10)
    given = np.array([36.935291783925, 35.252114857544, 35.252114768333, 36.936860463233])
    np.testing.assert_allclose(found.state_deviation[[1, 28, 43, 99], 0] ** 2, 1469.1 - given**2, rtol=1e-9)
    assert found.shocks() == []
    one, other = found.shocks(0.5)
    assert (one.row, one.kind, round(one.residual, 2), round(one.p, 2)) == (28, "break", -3.23, 0.24)
    assert (other.row, other.kind, round(other.residual, 2), round(other.p, 2)) == (42, "outlier", -3.04, 0.47)
    gaps = np.array(NILE, dtype=float)
    gaps[20:40] = np.nan
    found = disturbances(level(), gaps)
    np.testing.assert_allclose(found.state_noise[[1, 28, 43, 99], 0][1], -9.62777825977, rtol=1e-10)
    assert np.isnan(found.output_residuals[20:40]).all()


def two():
    A, Q = np.array([[1.0, 0.5], [-0.2, 0.8]]), np.array([[0.3, 0.1], [0.1, 0.4]])
    C, R = np.array([[1.0, 0.0], [0.5, 1.0], [0.0, 2.0]]), np.diag([0.2, 0.5, 0.3]) + 0.1
    return A, Q, C, R


def test_they_are_those_of_the_joint_law():
    """Two states and three outputs, of which one is missing at times: mean and variance by conditioning on all data."""
    A, Q, C, R = two()
    steps, rng = 5, np.random.default_rng(0)
    z = rng.normal(size=(steps, 3)) * 2
    z[1, 2], z[3] = np.nan, np.nan
    found = disturbances(hg.kalman_filter(hg.LinearPlant(A, Q, [0.0, 0.0], np.eye(2)), hg.LinearSensor(C, R)), z)
    # x_k and z_k as maps of (x_0, w_1 ... w_5, v_1 ... v_5), whose covariance is G.
    G = np.zeros((2 + 5 * steps, 2 + 5 * steps))
    G[:2, :2] = np.eye(2)
    x, maps = np.eye(2, len(G)), []
    for k in range(steps):
        w, v = slice(2 + 2 * k, 4 + 2 * k), slice(2 + 2 * steps + 3 * k, 5 + 2 * steps + 3 * k)
        G[w, w], G[v, v] = Q, R
        x = A @ x + np.eye(len(G))[w]
        maps.append(C @ x + np.eye(len(G))[v])
    came = ~np.isnan(z).ravel()
    H = np.concatenate(maps)[came]
    gain = np.linalg.solve(H @ G @ H.T, H @ G).T
    mean, variance = gain @ z.ravel()[came], np.diagonal(gain @ H @ G)
    np.testing.assert_allclose(found.state_noise.ravel(), mean[2 : 2 + 2 * steps], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.state_deviation.ravel() ** 2, variance[2 : 2 + 2 * steps], rtol=1e-9)
    np.testing.assert_allclose(found.output_noise.ravel()[came], mean[2 + 2 * steps :][came], rtol=1e-9)
    np.testing.assert_allclose(found.output_deviation.ravel()[came] ** 2, variance[2 + 2 * steps :][came], rtol=1e-9)


def test_breaks_and_outliers_are_found_where_they_are_and_nowhere_else():
    """Of 100 honest recordings at most four have a shock at 1 % (binomial, 99.6 %); of a break its shadow is none."""
    filter, rng = level(400.0), np.random.default_rng(1)
    x = 3162.3 * rng.normal(size=(100, 1)) + np.cumsum(1469.1**0.5 * rng.normal(size=(100, 80)), axis=1)
    z = x + 20.0 * rng.normal(size=x.shape)
    assert sum(bool(disturbances(filter, one).shocks()) for one in z) <= 4
    broken = z[0].copy()
    broken[40:] += 500.0
    broken[60] += 400.0
    assert [(e.row, e.kind, e.name) for e in disturbances(filter, broken).shocks() if e.p < 1e-6] == [
        (40, "break", "level"),
        (60, "outlier", "flow"),
    ]
    broken[40:] += 1e6  # where every p is 0 too
    assert (40, "break") in [(shock.row, shock.kind) for shock in disturbances(filter, broken).shocks()]


def test_other_models_are_refused():
    plant, sensor = hg.LinearPlant([[0.9]], 0.5, [0.0], 2.0), hg.LinearSensor([[1.0]], 0.3)
    with pytest.raises(hg.InputError, match="disturbances: expected a Kalman filter, exact for a linear plant"):
        disturbances(hg.filters.open_loop_filter(plant), [[1.0]])
    noisy = hg.linear_filter(plant, sensor, hg.hop(1.0, noise=0.2))
    with pytest.raises(hg.InputError, match="disturbances: expected a filter whose channel hands on"):
        disturbances(noisy, [[1.0], [2.0]])
    with pytest.raises(hg.InputError, match="measurements: expected at least one row"):
        disturbances(hg.kalman_filter(plant, sensor), np.zeros((0, 1)))
    with pytest.raises(hg.InputError, match="false: expected"):
        disturbances(hg.kalman_filter(plant, sensor), [[1.0], [2.0]]).shocks(2.0)
