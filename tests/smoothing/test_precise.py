"""Smoothed moments of wide priors, precise sensors and singular noises, against the recursion in fractions."""

import numpy as np
import pytest

import heliograph as hg
from tests.factors.exact import after, congruence, exactly, inverse, product, total, transposed

A, H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
TIME, LAG = 5, 2


def in_fractions(plant, sensor, z):
    """Mean and covariance (of the state after step k, given the rows up to step `upto`), as a function of both."""
    a, q, h, r = map(exactly, (plant.matrix, plant.noise.covariance, sensor.matrix, sensor.noise.covariance))
    m, p = exactly(plant.initial_mean[:, None]), exactly(plant.initial_covariance)
    priors, posteriors = [], []
    for row in z:
        m, p = product(a, m), total(congruence(a, p), q)
        priors.append((m, p))
        if not np.isnan(row).any():
            p, gain = after(p, h, r)
            m = total(m, product(gain, total(exactly(row[:, None]), product(h, m), -1)))
        posteriors.append((m, p))

    def moments(k, upto):
        mean, known = posteriors[upto]
        for i in reversed(range(k, upto)):
            (m, p), (ahead, prior) = posteriors[i], priors[i + 1]
            gain = product(product(p, transposed(a)), inverse(prior))
            mean = total(m, product(gain, total(mean, ahead, -1)))
            known = total(p, congruence(gain, total(known, prior, -1)))
        return np.array(mean, dtype=float)[:, 0], np.array(known, dtype=float)

    return moments


@pytest.mark.parametrize(
    ("wide", "precise", "moved"),
    [
        *((wide, precise, 1e-9) for wide in (1.0, 1e6, 1e10, 1e14) for precise in (1e-14, 1e-10, 1e-4, 1.0)),
        (1e14, 1e-10, 0.0),
        (1e10, 1e-14, 0.0),
    ],
)
def test_a_wide_prior_and_a_precise_sensor_keep_their_digits(wide, precise, moved):
    """Every smoothed variance within 2 % of the exact one; the worst, .8 %, where they are 1e28 apart.

    A state that moves without noise is known to its rounding, which the next test is of.
    """
    plant = hg.LinearPlant(A, moved * np.eye(2), [0, 0], wide * np.eye(2))
    sensor, z = hg.LinearSensor(H, [[precise]]), np.zeros((TIME, 1))
    _, steps = hg.smoothing.smoother_steps(hg.kalman_filter(plant, sensor), z)
    exact, rows = in_fractions(plant, sensor, z), range(TIME)
    expected = {
        hg.smoothing.FixedInterval(): [exact(k, TIME - 1) for k in rows],
        hg.smoothing.FixedLag(LAG): [exact(k, min(k + LAG, TIME - 1)) for k in rows],
        hg.smoothing.FixedPoint(0): [exact(0, k) for k in rows],
    }
    for smoothing, moments in expected.items():
        found = np.diagonal(smoothing.estimates(steps).covariance, axis1=1, axis2=2)
        np.testing.assert_allclose(found, [np.diagonal(covariance) for _, covariance in moments], rtol=0.02)


def test_what_moves_without_noise_is_known_to_the_rounding_of_its_prior():
    """Position and velocity 1e28 apart: 4 eps of 1e7 at each step, some .8 % of what the sensor leaves.

    They add up to 18 % of a smoothed variance, and none is below the exact one.
    """
    plant, sensor, z = hg.LinearPlant(A, 0.0, [0, 0], 1e14), hg.LinearSensor(H, 1e-14), np.zeros((TIME, 1))
    exact, result = in_fractions(plant, sensor, z), hg.rts_smoother(hg.kalman_filter(plant, sensor), z)
    found = np.diagonal(result.covariances, axis1=1, axis2=2)
    ratio = found / [np.diagonal(exact(k, TIME - 1)[1]) for k in range(TIME)]
    assert np.all(ratio > 1 - 1e-3) and np.all(ratio < 1.2)


@pytest.mark.parametrize(("apart", "most"), [(1e24, 1.001), (1e26, 1.01), (1e28, 1.1)])
def test_three_states_that_move_without_noise_keep_their_digits(apart, most):
    """Position, velocity and acceleration: none below exact fractions, nor above them by more than rounding is.

    A part of the next state that others determine is told by the rounding of these, carried on: 22 times the exact
    variance and .89 of it came out at 1e28 where it was by that of the part itself.
    """
    a = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    plant = hg.LinearPlant(a, 0.0, np.zeros(3), 1e14)
    sensor, z = hg.LinearSensor([[1.0, 0.0, 0.0]], 1e14 / apart), np.zeros((TIME, 1))
    exact, result = in_fractions(plant, sensor, z), hg.rts_smoother(hg.kalman_filter(plant, sensor), z)
    found = np.diagonal(result.covariances, axis1=1, axis2=2)
    ratio = found / [np.diagonal(exact(k, TIME - 1)[1]) for k in range(TIME)]
    assert np.all(ratio > 1 - 1e-3) and np.all(ratio < most)


@pytest.mark.parametrize("seed", [0, 5, 6])
def test_a_noise_of_the_state_of_one_direction(seed):
    """Q = g g' with no entry zero: but for one, its parts are rounding, which must not be divided by.

    Means and covariances to 1e-10 of a deviation: a hundred products of variances 1e6 to 1e17 apart, by squares.
    """
    rng = np.random.default_rng(seed)
    a, g, h = rng.normal(size=(3, 3)), rng.normal(size=(3, 1)), rng.normal(size=(1, 3))
    plant = hg.LinearPlant(
        a, 10.0 ** rng.integers(-12, 2) * g @ g.T, np.zeros(3), 10.0 ** rng.integers(0, 7) * np.eye(3)
    )
    sensor, z = hg.LinearSensor(h, [[10.0 ** rng.integers(-10, 1)]]), np.array([[0.3], [np.nan], [-0.2], [0.5]])
    exact, result = in_fractions(plant, sensor, z), hg.rts_smoother(hg.kalman_filter(plant, sensor), z)
    for k in range(len(z)):
        mean, covariance = exact(k, len(z) - 1)
        deviation = np.sqrt(np.diagonal(covariance))
        np.testing.assert_allclose(result.means[k] / deviation, mean / deviation, rtol=0, atol=1e-10)
        relative = (result.covariances[k] - covariance) / np.outer(deviation, deviation)
        np.testing.assert_allclose(relative, 0, rtol=0, atol=1e-10)


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
