"""Verdicts on networks: certified, impossible, undecided, each with its reason."""

import numpy as np
import pytest

import heliograph as hg

UNSTABLE = [[-1.25]]


def plant(matrix, process=1.0):
    n = len(matrix)
    return hg.LinearPlant(matrix, process * np.eye(n), np.zeros(n), np.eye(n))


def judged(plant_, *nodes):
    made = {f"node{i}": hg.Node(sensor, channel, {}) for i, (sensor, channel) in enumerate(nodes)}
    return hg.certify_boundedness(hg.Network(plant_, made))


def scalar(channel, noise=2.5, a=UNSTABLE):
    return judged(plant(a), (hg.LinearSensor([[1.0]], noise), channel))


def lossy(arrival):
    return hg.erasure(hg.perfect(), arrival)


@pytest.mark.parametrize(
    ("arrival", "verdict"), [(0.3, "impossible"), (0.359, "impossible"), (0.361, "certified"), (0.6, "certified")]
)
def test_a_scalar_plant_has_one_threshold(arrival, verdict):
    found = scalar(lossy(arrival))
    assert found.verdict == verdict
    assert (found.radius < 1) == (verdict == "certified")
    assert (found.growth >= 1) == (verdict == "impossible")


def test_the_bound_is_that_of_the_published_example():
    np.testing.assert_allclose(scalar(lossy(0.6)).bound, 7.32659, rtol=1e-6)


@pytest.mark.parametrize(
    ("arrival", "verdict"), [(0.35, "impossible"), (0.4, "undecided"), (0.47, "undecided"), (0.472, "certified")]
)
def test_between_the_two_conditions_nothing_is_said(arrival, verdict):
    sensor = hg.LinearSensor([[1.0, 1.0]], 2.5)
    assert judged(plant([[1.25, 0.0], [1.0, 1.1]], 20.0), (sensor, lossy(arrival))).verdict == verdict


@pytest.mark.parametrize(
    ("first", "second", "verdict", "why"),
    [(0.85, 0.56, "certified", "radius"), (0.83, 0.56, "impossible", "2.5"), (0.85, 0.55, "impossible", "1.5")],
)
def test_components_that_are_lost_on_their_own(first, second, verdict, why):
    """diag(2.5, 1.5): each component needs 1 - 1/a^2, 0.84 and 0.5556; two nodes are one node with two links."""
    both = judged(
        plant(np.diag([2.5, 1.5])),
        (hg.LinearSensor([[1.0, 0.0]], 1.0), lossy(first)),
        (hg.LinearSensor([[0.0, 1.0]], 1.0), lossy(second)),
    )
    one = judged(
        plant(np.diag([2.5, 1.5])),
        (hg.LinearSensor(np.eye(2), 1.0 * np.eye(2)), hg.parallel([lossy(first), lossy(second)])),
    )
    for found in (both, one):
        assert found.verdict == verdict and why in found.reason
    np.testing.assert_allclose(both.radius, one.radius, rtol=1e-9)


def test_more_sensors_help():
    """Four links that arrive one time in five: nothing comes with probability 0.8^4 = 0.41 < 0.64."""
    sensor = hg.LinearSensor([[1.0]], 1.0)
    assert judged(plant(UNSTABLE), (sensor, lossy(0.2))).verdict == "impossible"
    assert judged(plant(UNSTABLE), *[(sensor, lossy(0.2))] * 4).verdict == "certified"


def test_losses_on_two_hops_are_losses():
    chain = hg.amplify_and_forward([hg.erasure(hg.hop(1.0, 0.1), 0.8), hg.erasure(hg.hop(1.0, 0.1), 0.8)])
    found = scalar(chain, noise=1.0)
    np.testing.assert_allclose(found.bound, scalar(hg.erasure(hg.hop(1.0, 0.2), 0.64), noise=1.0).bound, rtol=1e-9)


@pytest.mark.parametrize("channel", [hg.hop(hg.Rayleigh(1.0), 0.1), hg.dropout(hg.perfect(), 0.99)])
@pytest.mark.parametrize("a", [-1.25, 1.0])
def test_random_gains_that_are_not_told_bound_no_unstable_mode(channel, a):
    found = scalar(channel, a=[[a]])
    assert found.verdict == "impossible"
    assert "only through random gains that are not told" in found.reason


def test_the_exact_filter_diverges_where_that_is_said():
    """a = 1: P grows as the root of k; a = 1.1: P / E x^2 falls as 1 / k, so that P grows."""
    channel, sensor = hg.hop(hg.Rayleigh(1.0), 0.1), hg.LinearSensor([[1.0]], 1.0)
    slow, fast = (
        hg.linear.lmmse(hg.linear.lifted_system(plant([[a]]), sensor, channel, 1, steps)).gains.covariance[:, 0, 0]
        for a, steps in ((1.0, 800), (1.1, 100))
    )
    np.testing.assert_allclose(slow[-1] / slow[199], 2.0, rtol=0.03)  # the next term of P falls as 1 / root of k
    assert fast[-1] > 1e4 * fast[10]


def test_a_stable_plant_is_bounded_by_its_own_covariance():
    found = scalar(hg.hop(hg.Rayleigh(1.0), 0.1), a=[[0.9]])
    assert found.verdict == "certified" and "the plant is stable" in found.reason
    np.testing.assert_allclose(found.bound, 1 / (1 - 0.81))


def test_rows_of_certain_gain_are_enough():
    """The unstable state over a known link, the stable one over a random link; then the other way round."""
    sensor, known, random = hg.LinearSensor(np.eye(2), np.eye(2)), hg.hop(1.0, 0.1), hg.hop(hg.Rayleigh(1.0), 0.1)
    mixed = plant(np.diag([1.2, 0.9]))
    assert judged(mixed, (sensor, hg.parallel([known, random]))).verdict == "certified"
    assert judged(mixed, (sensor, hg.parallel([random, known]))).verdict == "impossible"


def test_a_sum_of_random_rows_may_be_certain():
    """z = (g y, (2 - g) y): the gains are random, their sum is not."""
    law = hg.Discrete([0.5, 1.5], [0.5, 0.5])
    rows = hg.random_affine.Mixture(
        [hg.random_affine.known([[v], [2 - v]]) for v in np.asarray(law.values)], law.probabilities
    )
    channel = hg.amplify_and_forward([rows, hg.hop(1.0, 0.1, dimension=2)])
    found = scalar(channel)
    assert found.verdict == "certified"
    np.testing.assert_allclose(found.bound, scalar(hg.hop(2.0, 0.2)).bound, rtol=1e-9)


def test_a_gain_that_is_random_on_what_decays_only():
    """z = x1 + g x2 + n with x2 stable: certain where it matters, without a number for the bound."""
    channel = hg.random_affine.Mixture([hg.random_affine.known([[1.0, g]]) for g in (0.0, 1.0)], [0.5, 0.5])
    noisy = hg.amplify_and_forward([channel, hg.hop(1.0, 0.1)])
    found = judged(plant(np.diag([1.2, 0.9])), (hg.LinearSensor(np.eye(2), np.eye(2)), noisy))
    assert found.verdict == "certified" and found.bound is None


def test_what_is_not_seen_is_said_to_be_not_seen():
    found = judged(plant([[1.2]]), (hg.LinearSensor([[0.0]], 1.0), hg.perfect()))
    assert found.verdict == "impossible" and "is not seen at all" in found.reason


def test_a_rotation_is_undecided_between():
    angle = 0.3
    turn = 1.3 * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    sensor = hg.LinearSensor([[1.0, 0.0]], 1.0)
    verdicts = [judged(plant(turn), (sensor, lossy(p))).verdict for p in (0.4, 0.5, 0.7)]
    assert verdicts == ["impossible", "undecided", "certified"]  # 1 - 1/1.69 = 0.41, 1 - 1/1.69^2 = 0.65


def test_what_nothing_disturbs_may_stay_at_rest():
    still = hg.LinearPlant([[1.2]], 0.0, [1.0], 0.0)
    found = judged(still, (hg.LinearSensor([[1.0]], 1.0), lossy(0.1)))
    assert found.verdict == "undecided" and "may stay zero" in found.reason
    begun = hg.LinearPlant([[1.2]], 0.0, [1.0], 1.0)
    assert judged(begun, (hg.LinearSensor([[1.0]], 1.0), lossy(0.1))).verdict == "impossible"


def test_what_varies_or_filters_is_refused():
    sensor = hg.LinearSensor([[1.0]], 1.0)
    with pytest.raises(ValueError, match="boundedness: expected channels that do not vary"):
        judged(plant([[0.9]]), (sensor, hg.over_time([hg.perfect()])))
    with pytest.raises(ValueError, match="boundedness: expected a LinearPlant that does not vary, got one that varies"):
        judged(hg.over_time([plant([[0.9]])]), (sensor, hg.perfect()))
