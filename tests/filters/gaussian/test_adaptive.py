"""Variances learned on line: right where they jump, no worse after losses, where the printed recursion diverges."""

import numpy as np
import pytest

import heliograph as hg
from tests.filters.gaussian.test_robust import PLANT, A, C, judged

BEST_LINEAR = hg.linear_filter(PLANT, hg.LinearSensor(C, np.eye(2)), hg.perfect(2))


def drawn(loss, runs=40, steps=600):
    """Constant velocity; R = 9 from step 200 to 399, else 1; a row is lost with probability `loss`."""
    rng = np.random.default_rng(3)
    x, truth, rows = np.array([0, 0, 1.0, 1.0]) + rng.standard_normal((runs, 4)), [], []
    for k in range(steps):
        x = x @ A.T + np.sqrt(0.1) * rng.standard_normal((runs, 4))
        z = x[:, :2] + (3 if 200 <= k < 400 else 1) * rng.standard_normal((runs, 2))
        truth.append(x)
        rows.append(np.where(rng.random((runs, 1)) < loss, np.nan, z))
    return np.stack(truth, 1), np.stack(rows, 1)


def plain(variance=4.0):
    return hg.kalman_filter(PLANT, hg.LinearSensor(C, variance * np.eye(2)))


def test_a_variance_that_jumps_is_followed():
    """NEES within 0.1 of 1 and a smaller error than the filter that keeps R = 4."""
    truth, z = drawn(0.0)
    (error, nees), (fixed, _) = judged(hg.adaptive_filter(plain()), truth, z), judged(plain(), truth, z)
    assert error < fixed and abs(nees - 1) < 0.1


@pytest.mark.parametrize("memory", [0.9, 0.5])
def test_losses_leave_the_prior(memory):
    """With 90 % lost the printed recursion reaches R = 0 and a NEES of millions; towards a prior it stays at 1."""
    _, nees = judged(hg.adaptive_filter(plain(), memory), *drawn(0.9))
    assert abs(nees - 1) < 0.15


def printed(z, memory, iterations=5):
    """The published recursion for a scalar random walk, in NumPy: a, b <- rho a, rho b, R = b / a from the old b."""
    m, p, a, b, squares = 0.0, 1.0, 3.0, 12.0, []
    for value in z:
        p, a, b = p + 0.1, memory * a, memory * b
        if np.isnan(value):
            continue
        a, old = a + 0.5, b
        for _ in range(iterations):
            gain = p / (p + b / a)
            mean, left = m + gain * (value - m), p * (1 - gain)
            b = old + ((value - mean) ** 2 + left) / 2
        m, p = mean, left
        squares.append((b / a, p))
    return np.array(squares)


def test_the_printed_recursion_forgets_to_no_noise_after_losses():
    """After 200 lost values it claims less than half of the variance that it should; losses leave ours as it was."""
    z = np.full(202, np.nan)
    z[0] = z[201] = 0.0
    assert printed(z, 0.5)[-1, 1] < 0.5 * printed(z, 1.0)[-1, 1]
    item = hg.adaptive_filter(plain(), 0.5)
    state, _ = item.correct(item.init(), [0.3, np.nan])
    assert item.variances(state)[1] == 4.0
    for _ in range(5):
        state, _ = item.correct(item.predict(state), [np.nan, np.nan])
    np.testing.assert_array_equal(item.variances(state), item.variances(item.correct(item.init(), [0.3, np.nan])[0]))


@pytest.mark.parametrize("value", [1e8, 1e16, -1e20, 1e155])
def test_no_absurd_value_is_learned_as_noise(value):
    """By the variance that it leaves behind itself a value is never far: it would hide all others for 4,000 steps."""
    stream = hg.Stream(hg.adaptive_filter(plain()))
    before = stream.push([0.3, -0.2])
    with pytest.raises(ValueError, match=r"measurement of step 1: expected a plausible one, got .* deviations"):
        stream.push([value, 0.0])
    assert abs(stream.push([0.2, 0.1]).mean[0]) < 10 * np.sqrt(before.covariance[0, 0])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: hg.adaptive_filter(plain(), 0.0), "memory of an adaptive filter"),
        (
            lambda: hg.adaptive_filter(hg.linear_filter(PLANT, hg.LinearSensor(C, np.eye(2)), hg.perfect(2))),
            "one of kal",
        ),
    ],
)
def test_what_cannot_adapt_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
