"""Smoothed variances of a wide prior and a precise sensor, against the recursion in fractions."""

from fractions import Fraction

import numpy as np
import pytest

import heliograph as hg
from tests.factors.exact import after, congruence, exactly, inverse, product, total, transposed

A, Q, H = np.array([[1.0, 1.0], [0.0, 1.0]]), 1e-9 * np.eye(2), np.array([[1.0, 0.0]])
TIME, LAG = 5, 2


def in_fractions(wide, precise):
    """Variances (of the state after step k, given the rows up to step `upto`), as a function of both."""
    p, priors, posteriors = exactly(wide * np.eye(2)), [], []
    for _ in range(TIME):
        p = total(congruence(exactly(A), p), exactly(Q))
        priors.append(p)
        p, _ = after(p, exactly(H), [[Fraction(precise)]])
        posteriors.append(p)

    def variances(k, upto):
        known = posteriors[upto]
        for i in reversed(range(k, upto)):
            gain = product(product(posteriors[i], transposed(exactly(A))), inverse(priors[i + 1]))
            known = total(posteriors[i], congruence(gain, total(known, priors[i + 1], -1)))
        return [float(known[0][0]), float(known[1][1])]

    return variances


@pytest.mark.parametrize("precise", [1e-14, 1e-10, 1e-4, 1.0])
@pytest.mark.parametrize("wide", [1.0, 1e6, 1e10, 1e14])
def test_a_wide_prior_and_a_precise_sensor_keep_their_digits(wide, precise):
    """Every smoothed variance within 2 % of the exact one; the worst, .8 %, where they are 1e28 apart."""
    item = hg.kalman_filter(hg.LinearPlant(A, Q, [0, 0], wide * np.eye(2)), hg.LinearSensor(H, [[precise]]))
    _, steps = hg.smoothing.smoother_steps(item, np.zeros((TIME, 1)))
    exact, rows = in_fractions(wide, precise), range(TIME)
    expected = {
        hg.smoothing.FixedInterval(): [exact(k, TIME - 1) for k in rows],
        hg.smoothing.FixedLag(LAG): [exact(k, min(k + LAG, TIME - 1)) for k in rows],
        hg.smoothing.FixedPoint(0): [exact(0, k) for k in rows],
    }
    for smoothing, variances in expected.items():
        found = np.diagonal(smoothing.estimates(steps).covariance, axis1=1, axis2=2)
        np.testing.assert_allclose(found, variances, rtol=0.02)


def test_states_that_start_at_zero_round_as_they_become():
    """A copy of the state, made at each step and kept for one, is what the state was, to its own rounding.

    Its prior is zero, and the pair moves without noise in the copy: the smoothed copy after step k + 1 is the smoothed
    state after step k.
    """
    a = np.array([[0.9, 0.2, 0.0], [-0.1, 0.8, 0.0], [1.0, 0.0, 0.0]])
    steps, n = 8, 3
    plant = hg.LinearPlant(a, np.diag([0.1, 0.2, 0.0]), [0.5, 1.0, 0.0], np.diag([1.0, 2.0, 0.0]))
    item = hg.kalman_filter(plant, hg.LinearSensor([[1.0, 0.5, 0.2]], 0.3))
    result = hg.rts_smoother(item, np.sin(np.arange(steps)))
    assert result.means.shape == (steps, n)
    np.testing.assert_allclose(result.means[1:, 2], result.means[:-1, 0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(result.covariances[1:, 2, 2], result.covariances[:-1, 0, 0], rtol=1e-12)
