"""Drawn pasts have the smoother's moments, and the model's covariances between times."""

import numpy as np
import pytest

import heliograph as hg

DRAWS = 20_000


def test_drawn_pasts_are_those_of_the_joint_law():
    """All states and measurements are jointly Gaussian: mean and covariance of the states given z, by one inversion."""
    plant, sensor = hg.state_space([[0.8]], [[1.0]], 0.5, 0.3, [1.0], 2.0)
    z = np.array([0.3, np.nan, -0.4, 1.1])
    drawn = hg.smoothing.simulation_smoother(hg.kalman_filter(plant, sensor), z, draws=DRAWS)[:, :, 0]
    # Var x_k and Cov(x_j, x_k) = .8^|k - j| Var x_min(j, k), before any data.
    variances = [0.64 * 2.0 + 0.5]
    for _ in range(3):
        variances.append(0.64 * variances[-1] + 0.5)
    prior = np.array([[0.8 ** abs(j - k) * variances[min(j, k)] for k in range(4)] for j in range(4)])
    mean, arrived = 0.8 ** np.arange(1, 5), ~np.isnan(z)
    gain = prior[:, arrived] @ np.linalg.inv(prior[np.ix_(arrived, arrived)] + 0.3 * np.eye(arrived.sum()))
    mean, covariance = mean + gain @ (z - mean)[arrived], prior - gain @ prior[arrived]
    deviation = np.sqrt(np.diag(covariance))
    assert np.all(np.abs(drawn.mean(axis=0) - mean) < 5 * deviation / np.sqrt(DRAWS))
    assert np.all(np.abs(np.cov(drawn.T) - covariance) < 5 * np.sqrt(2 / DRAWS) * np.outer(deviation, deviation))


def test_no_draws_are_refused():
    filter = hg.kalman_filter(*hg.state_space([[1.0]], [[1.0]], 1.0, 1.0, [0.0], 1.0))
    with pytest.raises(ValueError, match="draws"):
        hg.smoothing.simulation_smoother(filter, [1.0], draws=0)
    with pytest.raises(ValueError, match="measurements: expected at least one row"):
        hg.smoothing.simulation_smoother(filter, np.zeros((0, 1)))
