"""Limits and codes: what does not count, what is refused as limits, and what dropping by value costs a claim."""

import numpy as np
import pytest
from scipy.stats import norm

import heliograph as hg

PLANT, SENSOR = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0], [1.0]], np.eye(2), ["near", "far"])


def limits_of(count, limits=None, invalid=()):
    """Limits of a node of so many numbers."""
    sensor = hg.LinearSensor(np.ones((count, 1)), np.eye(count))
    return hg.Node(sensor, hg.perfect(count), {}, limits=limits, invalid=invalid).limits


def test_what_is_beyond_does_not_count():
    limits = limits_of(2, [(0, 10), (None, 5)], [-999, -1])
    z = np.array([[0.0, -50.0], [10.1, 5.0], [-999, np.nan], [np.nan, -1.0], [3.0, 5.1]])
    expected = [[False, False], [True, False], [True, False], [False, True], [False, True]]
    np.testing.assert_array_equal(limits.outside(z), expected)
    assert (
        limits.describe_missing(z[1], limits.find_refusal_reasons(z[1]), ("near", "far"))
        == "near 10.1 is outside 0 to 10"
    )
    z = np.array([-999, 6.0])
    said = "near -999 is a code, far 6 is outside -inf to 5"
    assert limits.describe_missing(z, limits.find_refusal_reasons(z), ("near", "far")) == said
    np.testing.assert_array_equal(limits_of(2, (-1, 1)).outside(np.array([1.0, 1.5])), [False, True])


@pytest.mark.parametrize(
    ("limits", "invalid", "message"),
    [
        ((1, 0), (), "limits: expected a low end below the high one, got"),
        ((0, 1, 2), (), r"limits: expected \(low, high\), or such a pair for each of 2 received numbers"),
        ([(0, 1)] * 3, (), r"limits: expected \(low, high\), or such a pair"),
        (("a", "b"), (), r"limits: expected \(low, high\)"),
        ((0, np.nan), (), "limits: expected a low end below the high one"),
        (None, "x", "invalid values: expected numbers, got 'x'"),
        (None, [np.nan], "invalid values: expected a finite number or several"),
    ],
)
def test_what_are_no_limits_is_refused(limits, invalid, message):
    with pytest.raises(ValueError, match=message):
        hg.Node(SENSOR, hg.perfect(2), {}, limits=limits, invalid=invalid)
    with pytest.raises(ValueError, match=message):
        hg.Stream(hg.linear_filter(PLANT, SENSOR, hg.perfect(2)), limits=limits, invalid=invalid)


def test_a_stream_without_a_component():
    item = hg.linear_filter(PLANT, SENSOR, hg.perfect(2))
    stream, clean = hg.Stream(item, limits=[(-5, 5), (None, None)], invalid=-999), hg.Stream(item)
    for z, seen in (([0.1, -999], [0.1, np.nan]), ([6.0, 0.3], [np.nan, 0.3]), ([-999, -999], [np.nan] * 2)):
        np.testing.assert_array_equal(stream.push(z).mean, clean.push(seen).mean)
    assert (stream.refused["limits"].tolist(), stream.refused["code"].tolist()) == ([1, 0], [1, 2])
    again = hg.Stream.restore(item, stream.save(), invalid=-999)
    assert (again.refused["limits"].tolist(), again.refused["code"].tolist()) == ([1, 0], [1, 2])
    np.testing.assert_array_equal(again.push([7.0, -999]).mean, clean.push([7.0, np.nan]).mean)


@pytest.mark.parametrize("c", [1.0, 2.0, 3.0])
def test_honest_values_beyond_limits_cost_the_claim_what_is_said(c):
    """E[e^2] is P - K S K' + r K S K', r = 2 (c phi(c) + Q(c)), where limits are c deviations off; the filter claims
    P - K S K' where z counts and P else: it is 2 c phi(c) K S K' too small. Four standard errors of 400,000 runs."""
    rng, p, noise = np.random.default_rng(0), 2.0, 1.0
    x = rng.normal(0, np.sqrt(p), 400_000)
    s, k = p + noise, p / (p + noise)
    z = x + rng.normal(0, np.sqrt(noise), x.size)
    outside = limits_of(1, (-c * np.sqrt(s), c * np.sqrt(s))).outside(z[:, None])[:, 0]
    squares = np.where(outside, x, x - k * z) ** 2
    claimed = np.where(outside, p, p - k * s * k).mean()
    excess = 2 * c * norm.pdf(c) * k * s * k
    assert abs(squares.mean() - claimed - excess) < 4 * squares.std() / np.sqrt(x.size)


@pytest.mark.parametrize(("c", "ratio"), [(1.0, 2.75), (2.0, 1.84), (4.0, 1.0)])
def test_what_limits_refuse_adds_up_over_time_and_a_code_costs_nothing(c, ratio):
    """E[e^2] over E[P] of x+ = .95 x + w, z = x + v within c deviations of z; 4 standard errors of 40,000 runs are 3 %.

    The ratios are those of another program's 200,000 runs (2.762, 1.840, 1.002); with the same share lost by chance 1.
    """
    rng, runs, steps, start = np.random.default_rng(1), 40_000, 60, 0.1 / (1 - 0.95**2)
    limits = limits_of(1, (-c * np.sqrt(start + 0.05), c * np.sqrt(start + 0.05)))
    x, spread = rng.normal(0, np.sqrt(start), runs), {"by value": (0.0, start), "by chance": (0.0, start)}
    for _ in range(steps):
        x = 0.95 * x + rng.normal(0, np.sqrt(0.1), runs)
        z = x + rng.normal(0, np.sqrt(0.05), runs)
        refused = limits.outside(z[:, None])[:, 0]
        for name, lost in (("by value", refused), ("by chance", rng.permutation(refused))):
            mean, p = 0.95 * spread[name][0], 0.9025 * spread[name][1] + 0.1
            gain = np.where(lost, 0.0, p / (p + 0.05))
            spread[name] = mean + gain * (z - mean), p - gain * p
    found = {name: np.mean((x - mean) ** 2) / np.mean(p) for name, (mean, p) in spread.items()}
    assert found == pytest.approx({"by value": ratio, "by chance": 1.0}, rel=0.03)


def test_a_stream_with_limits_claims_nothing():
    item = hg.linear_filter(PLANT, SENSOR, hg.perfect(2))
    bounded, coded = hg.Stream(item, limits=[(-5, 5), (None, None)]), hg.Stream(item, invalid=-999)
    assert (bounded.push([0.1, 0.2]).claim, coded.push([0.1, -999]).claim) == ("nominal", "exact")


@pytest.mark.parametrize(
    ("value", "code", "same"),
    [
        (float(np.float32(-9999.9)), -9999.9, True),  # as a column of single precision has it
        (float(np.float32(-9999.9)) * 0.1, -999.99, True),  # and scaled
        (float(np.float32(2147483647)), 2147483647, True),
        (32767 * 0.1, 3276.7, True),  # a whole number that was scaled
        (32767 * 0.01, 327.67, True),
        (2147483646.0, 2147483647.0, False),
        (-9999.8, -9999.9, False),
        (65534 * 0.1, 6553.5, False),
        (0.0, 0.0, True),
        (1e-300, 0.0, False),
    ],
)
def test_a_code_is_equal_in_the_type_in_which_it_came(value, code, same):
    limits, z = limits_of(1, None, code), np.array([value])
    assert limits.outside(z).tolist() == [same]
    assert ("is a code" in limits.describe_missing(z, limits.find_refusal_reasons(z), ["z"])) == same


def test_one_pair_of_limits_is_for_what_is_measured():
    """Limits of a temperature took the number of lost messages, and the link's gain, for temperatures out of range."""
    sensor, rule = hg.LinearSensor([[1.0]], 0.1), hg.SendOnDelta(0.3, losses="known")
    counted = hg.Node(sensor, hg.erasure(hg.perfect(), 0.8), {}, trigger=rule, limits=(10, 60), stuck=5)
    told = hg.Node(sensor, hg.hop(hg.Rayleigh(0.8), 0.1, known=True), {}, limits=(10, 60), stuck=5)
    each = hg.Node(sensor, hg.hop(hg.Rayleigh(0.8), 0.1, known=True), {}, limits=[(10, 60), (0.1, 5)], stuck=[5, 3])
    for node, low, counts in ((counted, [10, -np.inf], [5, np.inf]), (told, [10, -np.inf], [5, np.inf]),
                              (each, [10, 0.1], [5, 3])):  # fmt: skip
        np.testing.assert_array_equal(node.limits.low, low)
        np.testing.assert_array_equal(node.limits.stuck, counts)
