"""The steady state of the Kalman filter against its recursion, run until it stands still."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import heliograph as hg


@given(st.integers(1, 3), st.integers(1, 2), st.floats(0.1, 1.1), st.integers(0, 1000))
def test_it_is_the_limit_of_the_recursion(n, m, radius, seed):
    rng = np.random.default_rng(seed)
    F, H = rng.normal(size=(n, n)), rng.normal(size=(m, n))
    F *= radius / np.abs(np.linalg.eigvals(F)).max()
    q, r = rng.normal(size=(n, n)), rng.normal(size=(m, m))
    Q, R = q @ q.T + 0.1 * np.eye(n), r @ r.T + 0.1 * np.eye(m)
    result = hg.steady_state(*hg.state_space(F, H, Q, R, np.zeros(n), np.eye(n)))
    prior, before = np.eye(n), np.zeros((n, n))
    for _ in range(3000):
        K = prior @ H.T @ np.linalg.inv(H @ prior @ H.T + R)
        P = (np.eye(n) - K @ H) @ prior
        prior, before = F @ P @ F.T + Q, prior
        if np.abs(prior - before).max() <= 1e-15 * np.abs(prior).max():  # it stands still
            break
    scale = np.abs(prior).max()
    np.testing.assert_allclose(result.prior_covariance, prior, atol=1e-8 * scale)
    np.testing.assert_allclose(result.covariance, P, atol=1e-8 * scale)
    np.testing.assert_allclose(result.gain, K, atol=1e-7 * (1 + np.abs(K).max()))


def test_a_scalar_has_its_formula():
    """P = sqrt(q r + q^2 / 4) + q / 2 before the measurement of a random walk."""
    result = hg.steady_state(*hg.state_space([[1.0]], [[1.0]], 0.5, 2.0, [0.0], 1.0))
    prior = np.sqrt(0.5 * 2 + 0.5**2 / 4) + 0.25
    np.testing.assert_allclose(result.prior_covariance, [[prior]], rtol=1e-12)
    np.testing.assert_allclose(result.gain, [[prior / (prior + 2)]], rtol=1e-12)


def test_exact_measurements_have_one_too():
    result = hg.steady_state(*hg.state_space([[0.9]], [[1.0]], 1.0, 0.0, [0.0], 1.0))
    np.testing.assert_allclose([result.prior_covariance[0, 0], result.gain[0, 0]], 1.0, rtol=1e-9)
    assert result.covariance[0, 0] == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    ("F", "H", "Q"),
    [
        ([[1.2, 0.0], [0.0, 0.5]], [[0.0, 1.0]], np.eye(2)),  # an unstable mode that the sensor does not see
        ([[1.0]], [[1.0]], 0.0),  # a constant: its variance falls for ever as 1 / k
    ],
)
def test_there_may_be_none(F, H, Q):
    plant, sensor = hg.state_space(F, H, Q, 1.0, np.zeros(len(F)), np.eye(len(F)))
    with pytest.raises(ValueError, match="steady state: expected unstable modes that the sensor sees, and noise"):
        hg.steady_state(plant, sensor)


def test_what_varies_has_none():
    plant, sensor = hg.state_space([[0.9]], [[1.0]], 1.0, 1.0, [0.0], 1.0)
    with pytest.raises(ValueError, match="a LinearPlant that does not vary, got one that varies"):
        hg.steady_state(hg.model.over_time([plant, plant]), sensor)
