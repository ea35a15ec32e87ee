"""What the page for users of other packages promises: the numbers of FilterPy, and words that the index knows."""

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from filterpy.kalman import KalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
from filterpy.stats import NEES

import heliograph as hg

DOCS = Path(__file__).parents[1] / "docs"
F, H = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[1.0, 0.0]])
Q, R = np.array([[1e-3, 0.0], [0.0, 1e-2]]), np.array([[0.1]])
MEAN, COVARIANCE = np.array([0.0, 1.0]), np.array([[1.0, 0.2], [0.2, 0.5]])
Z = np.random.default_rng(0).normal(size=(60, 1)).cumsum(axis=0) / 5
CLOSE = {"rtol": 1e-10, "atol": 1e-10}  # what the page says


def theirs():
    item = KalmanFilter(dim_x=2, dim_z=1)
    item.F, item.H, item.Q, item.R = F, H, Q, R
    item.x, item.P = MEAN.copy(), COVARIANCE.copy()
    return item


def test_the_kalman_filter_and_its_smoother_are_those_of_filterpy():
    kalman = hg.kalman_filter(*hg.state_space(F, H, Q, R, MEAN, COVARIANCE))
    means, covariances, _, _ = theirs().batch_filter(Z)
    result = kalman.run(Z)
    np.testing.assert_allclose(result.means, means, **CLOSE)
    np.testing.assert_allclose(result.covariances, covariances, **CLOSE)
    stepped, total = theirs(), 0.0
    for row, innovation in zip(Z, result.innovations, strict=True):
        stepped.predict()
        stepped.update(row)
        total += stepped.log_likelihood
        np.testing.assert_allclose(innovation, stepped.y, **CLOSE)
    np.testing.assert_allclose(result.log_likelihood, total, **CLOSE)
    smoothed = hg.rts_smoother(kalman, Z)
    again, spreads, _, _ = theirs().rts_smoother(means, covariances)
    np.testing.assert_allclose(smoothed.means, again, **CLOSE)
    np.testing.assert_allclose(smoothed.covariances, spreads, **CLOSE)
    truth = means + np.random.default_rng(1).normal(size=means.shape)
    np.testing.assert_allclose(hg.nees(truth, means, covariances), NEES(truth, means, covariances), **CLOSE)


@pytest.mark.parametrize(("alpha", "beta", "kappa"), [(0.5, 2.0, 1.0), (1.0, 0.0, 1.0)])
def test_the_unscented_filter_is_that_of_filterpy(alpha, beta, kappa):
    item = UnscentedKalmanFilter(
        2, 1, 0.1, lambda x: np.sin(x[:1]), lambda x, dt: np.array([x[0] + 0.1 * x[1], x[1] - np.sin(x[0])]),
        MerweScaledSigmaPoints(2, alpha, beta, kappa),
    )  # fmt: skip
    item.x, item.P, item.Q, item.R = MEAN.copy(), COVARIANCE.copy(), Q, R
    means, covariances = item.batch_filter(Z)
    pendulum = hg.Plant(lambda x, u: jnp.stack([x[0] + 0.1 * x[1], x[1] - jnp.sin(x[0])]), Q, MEAN, COVARIANCE)
    angle = hg.Sensor(lambda x: jnp.sin(x[:1]), R)
    result = hg.unscented_filter(pendulum, angle, hg.perfect(), alpha, beta, kappa).run(Z)
    np.testing.assert_allclose(result.means, means, **CLOSE)
    np.testing.assert_allclose(result.covariances, covariances, **CLOSE)


def test_pykalmans_order_is_a_state_one_step_earlier():
    """It corrects its first state without a prediction: the same from F^-1 m and F^-1 (P - Q) F^-1'."""
    back = np.linalg.inv(F)
    start = back @ MEAN, back @ (COVARIANCE - Q) @ back.T
    result = hg.kalman_filter(*hg.state_space(F, H, Q, R, *start)).run(Z[:1])
    gain = COVARIANCE @ H.T / (H @ COVARIANCE @ H.T + R)
    np.testing.assert_allclose(result.means[0], MEAN + gain @ (Z[0] - H @ MEAN), **CLOSE)
    np.testing.assert_allclose(result.covariances[0], (np.eye(2) - gain @ H) @ COVARIANCE, **CLOSE)


@pytest.mark.parametrize(
    "word", ["UKF", "RTS", "NIS", "NEES", "batch", "gating", "multi-rate", "missing", "late", "dropout", "ensemble"]
)
def test_a_word_that_people_look_for_is_in_the_index(word):
    """And in the text of the page that it leads to, where the site's search finds it."""
    row = next(line for line in (DOCS / "index.md").read_text().splitlines() if line.startswith("|") and word in line)
    pages = re.findall(r"\]\((\w+\.md)", row.split("|")[-2])
    assert pages and any(word.lower() in (DOCS / page).read_text().lower() for page in pages)
