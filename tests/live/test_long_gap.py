"""Gaps of any length are predicted across in bounded work, and no event shuts a timeline."""

from fractions import Fraction

import numpy as np
import pytest

import heliograph as hg
from heliograph.live.long_gap import pass_long_gap

SENSOR = hg.LinearSensor([[1.0, 0.0]], 0.5)
PLANT = hg.LinearPlant([[1.0, 1.0], [0.0, 1.0]], np.diag([0.01, 0.1]), [0.0, 1.0], np.eye(2), states=["x", "v"])


@pytest.fixture(scope="module")
def network():
    return hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.perfect(), {"k": hg.kalman_filter(PLANT, SENSOR)})})


def exact(mean, covariance, count):
    """F^n m and F^n P F^n' + sum F^i Q F^i', in rational numbers, for F = [[1, 1], [0, 1]]."""
    n, moved = Fraction(count), np.array([[1, count], [0, 1]], dtype=object)
    q, r = Fraction(0.01), Fraction(0.1)
    summed = [[q * n + r * (n - 1) * n * (2 * n - 1) / 6, r * n * (n - 1) / 2], [r * n * (n - 1) / 2, r * n]]
    mean, covariance = (np.vectorize(lambda x: Fraction(float(x)), otypes=[object])(a) for a in (mean, covariance))
    total = moved @ covariance @ moved.T + np.array(summed, dtype=object)
    return (moved @ mean).astype(float), total.astype(float)


@pytest.mark.parametrize("count", [9_000, 11_000, 10**7, 10**9])
def test_a_gap_of_any_length_is_predicted_across(network, count):
    """The powers of a matrix with the double eigenvalue 1 and rounded entries: 1e9 steps lose half of the digits."""
    line = hg.Timeline(network, window=3)
    line.push("a", 0, 0, [0.1])
    before = line.estimates()["a"]["k"]
    line.advance(count)
    now = line.estimates()["a"]["k"]
    mean, covariance = exact(before.mean, before.covariance, count)
    np.testing.assert_allclose(now.mean, mean, rtol=1e-12)
    np.testing.assert_allclose(now.covariance, covariance, rtol=1e-16 * count + 1e-10)
    assert line.push("a", 1, count, [4.0]) == "used" and abs(line.estimates()["a"]["k"].mean[0] - 4.0) < 1e-6


def random_walk(states, k):
    """Variance of a random walk beside a number that settles, slowly and by no affine map, and one that is kept."""
    x, p, kept = states.T
    return np.stack([x - 1e-4 * x**3, p + 0.25, kept], axis=1)


def test_what_is_not_affine_goes_on_as_it_did():
    """x' = x - e x^3 has 1/x^2 = 1/x0^2 + 2 e n + o(n); beyond the real steps it is taken to stay."""
    start, state = np.zeros(3), np.array([1.0, 2.0, 7.0])
    x, p, kept = pass_long_gap(random_walk, start, state, 0, 10**6)
    assert p == pytest.approx(2.0 + 0.25e6, rel=1e-2) and kept == 7.0
    assert 0 < x < (1 / (1 + 2e-4 * 8_000)) ** 0.5 * 1.01


def test_few_steps_are_taken_one_by_one():
    state, walked = np.array([1.0, 2.0, 7.0]), np.array([[1.0, 2.0, 7.0]])
    for k in range(200):
        walked = random_walk(walked, k)
    np.testing.assert_array_equal(pass_long_gap(random_walk, np.zeros(3), state, 0, 200), walked[0])


def test_a_state_that_is_no_number_begins_with_the_initial_law():
    start, state = np.array([3.0]), np.array([1.0])
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(pass_long_gap(lambda states, k: states * 1e10, start, state, 0, 10**6), start)
        np.testing.assert_array_equal(pass_long_gap(lambda states, k: states * 1.01, start, state, 0, 10**6), start)


def test_one_event_of_a_wrong_clock_does_not_shut_a_timeline(network):
    """Taken at its word until the next goes on from before it; then all is as if it had not come."""
    line, right = hg.Timeline(network, window=3), hg.Timeline(network, window=3)
    for k in range(5):
        assert line.push("a", k, k, [0.1 * k]) == right.push("a", k, k, [0.1 * k]) == "used"
    assert line.push("a", 5, 10**9, [0.5]) == "used" and line.now == 10**9
    assert not len(line.final().time[1:])  # nothing became final by it
    for k in range(5, 12):
        assert line.push("a", k + 1, k, [0.1 * k]) == right.push("a", k + 1, k, [0.1 * k]) == "used"
    assert line.now == 11 and line.counts["a"] | {"used": 12, "future": 1} == line.counts["a"]
    one, other = line.estimates()["a"]["k"], right.estimates()["a"]["k"]
    np.testing.assert_array_equal(one.mean, other.mean)
    np.testing.assert_array_equal(one.covariance, other.covariance)


def test_a_leap_that_a_second_event_confirms_stands(network):
    line = hg.Timeline(network, window=3)
    for k, time in enumerate((0, 1, 20_000, 20_001, 20_010)):
        assert line.push("a", k, time, [1.0]) == "used"
    assert line.counts["a"]["used"] == 5 and line.push("a", 9, 2, [1.0]) == "late"
    assert list(line.final().time) == [0, 1, 20_000, 20_001]


def test_a_late_event_says_nothing_of_a_leap_and_a_clock_confirms_or_contradicts_it(network):
    line = hg.Timeline(network, window=3)
    for k, time in enumerate((0, 2, 20_000, 1)):
        assert line.push("a", k, time, [1.0]) == "used"
    again = hg.Timeline.restore(network, line.save())
    line.advance(20_001)
    assert line.now == 20_001 and line.counts["a"]["future"] == 0
    again.advance(4)
    assert again.now == 4 and again.counts["a"]["future"] == 1
    known = hg.Timeline(network, window=3)
    known.push("a", 0, 0, [1.0], arrival=0)
    known.push("a", 1, 20_000, [1.0], arrival=20_000)  # its arrival says the same
    assert known.push("a", 2, 5, [1.0], arrival=20_001) == "used"
    assert known.counts["a"]["future"] == 0 and known.now == 20_001
