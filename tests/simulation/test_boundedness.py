"""Verdicts on networks: certified, impossible, undecided, each with its reason."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.simulation.description.doubts import doubts_before_data

UNSTABLE = [[-1.25]]


def plant(matrix, process=1.0):
    n = len(matrix)
    return hg.LinearPlant(matrix, process * np.eye(n), np.zeros(n), np.eye(n))


def judged(plant_, *nodes):
    made = {f"node{i}": hg.Node(sensor, channel, {}) for i, (sensor, channel) in enumerate(nodes)}
    return hg.simulation.certify_boundedness(hg.Network(plant_, made))


def scalar(channel, noise=2.5, a=UNSTABLE):
    return judged(plant(a), (hg.LinearSensor([[1.0]], noise), channel))


def lossy(arrival):
    return hg.erasure(hg.perfect(), arrival)


@pytest.mark.parametrize(
    ("arrival", "verdict"), [(0.3, "impossible"), (0.359, "impossible"), (0.361, "certified"), (0.6, "certified")]
)
def test_a_scalar_plant_has_one_threshold(arrival, verdict):
    result = scalar(lossy(arrival))
    assert result.verdict == verdict
    assert (result.radius < 1) == (verdict == "certified")
    assert (result.growth >= 1) == (verdict == "impossible")


def test_the_bound_and_the_gain_are_those_of_the_published_example():
    result = scalar(lossy(0.6))
    np.testing.assert_allclose(result.bound, 7.32659, rtol=1e-6)
    np.testing.assert_allclose(result.gains[True,], -0.93199, rtol=1e-5)
    np.testing.assert_array_equal(result.gains[False,], 0.0)


def test_the_gains_have_the_radius_that_is_said():
    """Two links that amplify: K acts on what is received, whatever units it has."""
    a, c = np.array([[1.2, 0.3], [0.0, 1.1]]), np.eye(2)
    links = hg.parallel([hg.erasure(hg.hop(5.0, 0.1), 0.9), hg.erasure(hg.hop(0.01, 0.1), 0.7)])
    result = judged(plant(a), (hg.LinearSensor(c, np.eye(2)), links))
    assert result.verdict == "certified" and len(result.gains) == 4
    total = 0.0
    for (item, two), gain in result.gains.items():
        loop = a - gain @ np.diag([5.0, 0.01]) @ c
        total = total + (0.9 if item else 0.1) * (0.7 if two else 0.3) * np.kron(loop, loop)
    np.testing.assert_allclose(np.abs(np.linalg.eigvals(total)).max(), result.radius, rtol=1e-9)


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
def test_components_that_are_lost_independently(first, second, verdict, why):
    """diag(2.5, 1.5): each component needs 1 - 1/a^2, 0.84 and 0.5556; two nodes are one node with two links."""
    both = judged(
        plant(np.diag([2.5, 1.5])),
        (hg.LinearSensor([[1.0, 0.0]], 1.0), lossy(first)),
        (hg.LinearSensor([[0.0, 1.0]], 1.0), lossy(second)),
    )
    item = judged(
        plant(np.diag([2.5, 1.5])),
        (hg.LinearSensor(np.eye(2), 1.0 * np.eye(2)), hg.parallel([lossy(first), lossy(second)])),
    )
    for single in (both, item):
        assert single.verdict == verdict and why in single.reason
    np.testing.assert_allclose(both.radius, item.radius, rtol=1e-9)


def test_more_sensors_help():
    """Four links that arrive one time in five: nothing comes with probability 0.8^4 = 0.41 < 0.64."""
    sensor = hg.LinearSensor([[1.0]], 1.0)
    assert judged(plant(UNSTABLE), (sensor, lossy(0.2))).verdict == "impossible"
    assert judged(plant(UNSTABLE), *[(sensor, lossy(0.2))] * 4).verdict == "certified"


def test_losses_on_two_hops_are_losses():
    chain = hg.amplify_and_forward([hg.erasure(hg.hop(1.0, 0.1), 0.8), hg.erasure(hg.hop(1.0, 0.1), 0.8)])
    result = scalar(chain, noise=1.0)
    np.testing.assert_allclose(result.bound, scalar(hg.erasure(hg.hop(1.0, 0.2), 0.64), noise=1.0).bound, rtol=1e-9)


@pytest.mark.parametrize("channel", [hg.hop(hg.Rayleigh(1.0), 0.1), hg.dropout(hg.perfect(), 0.99)])
@pytest.mark.parametrize("a", [-1.25, 1.0])
def test_random_gains_that_are_unknown_bound_no_unstable_mode(channel, a):
    result = scalar(channel, a=[[a]])
    assert result.verdict == "impossible"
    assert "only through random gains that are not known" in result.reason


def test_the_exact_filter_diverges_where_that_is_said():
    """a = 1: P grows as the root of k; a = 1.1: P / E x^2 falls as 1 / k, so that P grows."""
    channel, sensor = hg.hop(hg.Rayleigh(1.0), 0.1), hg.LinearSensor([[1.0]], 1.0)
    slow, fast = (
        hg.linear.lmmse(hg.linear.lifted_system(plant([[a]]), sensor, channel, 1, steps)).gains.covariance[:, 0, 0]
        for a, steps in ((1.0, 800), (1.1, 100))
    )
    np.testing.assert_allclose(slow[-1] / slow[199], 2.0, rtol=0.03)  # the next term of P falls as 1 / root of k
    assert fast[-1] > 1e4 * fast[10]


def test_a_stable_plant_is_bounded_by_its_stationary_covariance():
    result = scalar(hg.hop(hg.Rayleigh(1.0), 0.1), a=[[0.9]])
    assert result.verdict == "certified" and "the plant is stable" in result.reason
    np.testing.assert_allclose(result.bound, 1 / (1 - 0.81))


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
    result = scalar(channel)
    assert result.verdict == "certified"
    np.testing.assert_allclose(result.bound, scalar(hg.hop(2.0, 0.2)).bound, rtol=1e-9)


def test_a_gain_that_is_random_on_what_decays_only():
    """z = x1 + g x2 + n with x2 stable: certain where it matters, without a number for the bound."""
    channel = hg.random_affine.Mixture([hg.random_affine.known([[1.0, g]]) for g in (0.0, 1.0)], [0.5, 0.5])
    noisy = hg.amplify_and_forward([channel, hg.hop(1.0, 0.1)])
    result = judged(plant(np.diag([1.2, 0.9])), (hg.LinearSensor(np.eye(2), np.eye(2)), noisy))
    assert result.verdict == "certified" and result.bound is None


def test_what_is_not_seen_is_said_to_be_not_seen():
    result = judged(plant([[1.2]]), (hg.LinearSensor([[0.0]], 1.0), hg.perfect()))
    assert result.verdict == "impossible" and "is not seen at all" in result.reason


def test_a_rotation_is_undecided_between():
    angle = 0.3
    turn = 1.3 * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    sensor = hg.LinearSensor([[1.0, 0.0]], 1.0)
    verdicts = [judged(plant(turn), (sensor, lossy(p))).verdict for p in (0.4, 0.5, 0.7)]
    assert verdicts == ["impossible", "undecided", "certified"]  # 1 - 1/1.69 = 0.41, 1 - 1/1.69^2 = 0.65


def test_what_nothing_disturbs_may_stay_at_rest():
    still = hg.LinearPlant([[1.2]], 0.0, [1.0], 0.0)
    result = judged(still, (hg.LinearSensor([[1.0]], 1.0), lossy(0.1)))
    assert result.verdict == "undecided" and "may stay zero" in result.reason
    seen = judged(still, (hg.LinearSensor([[1.0]], 1.0), lossy(0.9)))
    assert seen.verdict == "certified"
    np.testing.assert_allclose(seen.gains[True,], 1.2 - 1 / 1.2, atol=0.05)  # that of no losses leaves 1 / a
    begun = hg.LinearPlant([[1.2]], 0.0, [1.0], 1.0)
    assert judged(begun, (hg.LinearSensor([[1.0]], 1.0), lossy(0.1))).verdict == "impossible"


def bursts(fail, recover, name=None):
    return hg.gilbert_elliott(hg.perfect(), hg.erasure(hg.perfect(), 0.0), fail, recover, name)


@pytest.mark.parametrize(("recover", "verdict"), [(0.3, "impossible"), (0.359, "impossible"), (0.361, "certified")])
def test_bursts_must_end_fast_enough(recover, verdict):
    """Losses last longer than P can bear if (1 - recover) a^2 >= 1, however rare they are."""
    assert scalar(bursts(0.01, recover)).verdict == verdict


@pytest.mark.parametrize(
    ("fail", "recover", "bound"), [(0.1, 0.6, 4.5801), (0.3, 0.6, 6.5848), (0.1, 0.9, 3.6612), (0.4, 0.6, 7.3266)]
)
def test_bounds_under_bursts(fail, recover, bound):
    np.testing.assert_allclose(scalar(bursts(fail, recover)).bound, bound, atol=5e-5)


def test_links_with_shared_fading_fail_together():
    """Two sensors: on chains of their own both are silent for long with rho 0.5^2, with one fading state rho 0.5."""
    sensor = hg.LinearSensor([[1.0]], 1.0)
    local = judged(plant([[1.6]]), (sensor, bursts(0.2, 0.5)), (sensor, bursts(0.2, 0.5)))
    shared = judged(plant([[1.6]]), (sensor, bursts(0.2, 0.5, "hill")), (sensor, bursts(0.2, 0.5, "hill")))
    assert local.verdict == "certified"
    assert shared.verdict == "impossible"
    np.testing.assert_allclose(shared.growth, 0.5 * 1.6**2)


def test_modes_that_are_hidden_are_random_gains():
    """Gains of 0.2 and 1 that nobody tells; observed losses beside them help nothing; a drifting gain is as random."""
    hidden = hg.markov_fading([0.2, 1.0], [[0.95, 0.05], [0.03, 0.97]], noise=0.05)
    for channel in (hidden, hg.erasure(hidden, 0.9), hg.model.autoregressive_fading(1.0, 0.3, 0.95, 0.1)):
        result = scalar(channel)
        assert result.verdict == "impossible" and "random gains" in result.reason
    steady = hg.model.autoregressive_fading(1.0, 0.0, 0.95, 0.1)
    np.testing.assert_allclose(scalar(steady).bound, scalar(hg.hop(1.0, 0.1)).bound, rtol=1e-9)


def test_a_mode_that_shows_itself_by_its_losses_only_in_probability():
    """Losses with 0.1 or 0.9 by a hidden mode: the receiver knows the losses, and the bound holds for what it knows."""
    soft = hg.gilbert_elliott(hg.erasure(hg.perfect(), 0.9), hg.erasure(hg.perfect(), 0.1), 0.1, 0.5)
    result = scalar(soft)
    assert result.verdict == "certified" and len(result.gains) == 2
    assert mean_error_of_hidden_modes(0.1, 0.5, (0.9, 0.1)) < result.bound
    clear = hg.gilbert_elliott(hg.erasure(hg.perfect(), 1.0), hg.erasure(hg.perfect(), 0.0), 0.1, 0.5)
    np.testing.assert_allclose(scalar(clear).bound, scalar(bursts(0.1, 0.5)).bound, rtol=1e-12)


def mean_error_of_hidden_modes(fail, recover, arrival, steps=20_000):
    """E P of a scalar plant along one long path."""
    draws, p, bad, total = np.random.default_rng(0).random((steps, 2)), 1.0, 0, 0.0
    for change, arrives in draws:
        total += p
        p = 1.25**2 * (p * 2.5 / (p + 2.5) if arrives < arrival[bad] else p) + 1.0
        bad = int(change < fail) if bad == 0 else int(change >= recover)
    return total / steps


def test_a_mode_that_is_never_reached_does_not_matter():
    chain = hg.random_affine.MarkovChain([[1.0, 0.0], [0.1, 0.9]], initial=[1.0, 0.0])
    links = hg.markov_fading([hg.perfect(), hg.erasure(hg.perfect(), 0.0)], chain)
    np.testing.assert_allclose(scalar(links).bound, scalar(hg.perfect()).bound, rtol=1e-9)


def test_uncertain_transitions_are_refused():
    chain = hg.random_affine.MarkovChain([[0.9, 0.1], [0.5, 0.5]], radius=0.01)
    with pytest.raises(ValueError, match="chain of a channel: expected one of known transition"):
        scalar(hg.markov_fading([hg.perfect(), hg.erasure(hg.perfect(), 0.0)], chain))


def test_what_varies_or_filters_is_refused():
    sensor = hg.LinearSensor([[1.0]], 1.0)
    with pytest.raises(ValueError, match="channel: expected one that does not vary"):
        judged(plant([[0.9]]), (sensor, hg.model.over_time([hg.perfect()])))
    with pytest.raises(ValueError, match="plant: expected a LinearPlant that does not vary, got one that varies"):
        judged(hg.model.over_time([plant([[0.9]])]), (sensor, hg.perfect()))


def test_a_link_that_delivers_late_is_refused_and_doubted():
    """It has more inputs than the sensor has outputs, which no product of matrices may find out."""
    late = hg.model.delayed(hg.hop(1.0, 0.1), 1)
    with pytest.raises(ValueError, match="channel: expected one without delays, got one that is late"):
        scalar(late)
    sensor = hg.LinearSensor([[1.0]], 2.5)
    doubts = doubts_before_data(hg.Network(plant(UNSTABLE), {"a": hg.Node(sensor, late, {})}))
    assert any(
        "boundedness: not judged (channel: expected one without delays, got one that is late" in str(doubt)
        for doubt in doubts
    )


def test_a_network_in_which_nothing_is_measured_is_refused():
    with pytest.raises(ValueError, match="nodes: expected at least one that receives a sensor, got none"):
        hg.simulation.certify_boundedness(hg.Network(plant([[0.9]]), {"a": None}))


def test_a_link_that_tells_its_gain_is_refused_in_words_that_fit():
    plant, sensor = hg.LinearPlant([[1.1]], 1.0, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
    link = hg.hop(hg.Rayleigh(0.8), 0.1, known=True)
    with pytest.raises(ValueError, match="channel: expected one whose gain and noise no message tells"):
        hg.simulation.certify_boundedness(hg.Network(plant, {"a": hg.Node(sensor, link, {})}))


HOLDS_BACK = [
    {"trigger": hg.Periodic(8)},
    {"trigger": hg.SendOnDelta(3.0)},
    {"limits": (-5, 5)},
    {"encoder": hg.Words(8, -5, 5)},
]


@pytest.mark.parametrize("chosen", HOLDS_BACK)
def test_what_values_decide_to_hold_back_certifies_nothing(chosen):
    """Such nodes were taken to deliver every value: a bound of 2.95 where all is refused, or cut, once |y| > 5."""
    sensor, silent = hg.LinearSensor([[1.0]], 2.5), hg.LinearSensor([[0.0]], 1.0)
    alone = hg.Node(sensor, hg.perfect(), {}, **chosen)
    beside = hg.Node(hg.LinearSensor([[1.0]], 10.0), hg.perfect(), {})

    def judge(a, /, **nodes):
        return hg.simulation.certify_boundedness(hg.Network(plant([[a]]), nodes))

    unjudged = judge(1.2, a=alone)
    assert unjudged.verdict == "undecided" and "nodes ['a'] show is not counted" in unjudged.reason
    # The other node alone certifies, with the steady variance P- = q + a^2 P- r / (P- + r) behind it.
    found, b = judge(1.2, a=alone, b=beside), 10 * (1 - 1.2**2) - 1
    assert found.verdict == "certified" and found.bound[0, 0] == pytest.approx((-b + np.sqrt(b * b + 40)) / 2)
    assert judge(0.9, a=alone).bound[0, 0] == pytest.approx(1 / (1 - 0.9**2))
    assert judge(1.2, a=hg.Node(silent, hg.perfect(), {}, **chosen)).verdict == "impossible"


def test_a_sensor_with_feedback_is_refused_as_a_random_gain_multiplies_an_error_alone():
    """It was said to be impossible, of a growth of 1.1, where the filter's mean square error stays at 0.28."""
    unstable, sensor = plant([[1.05]], 0.5), hg.LinearSensor([[1.0]], 0.2)
    link = hg.hop(hg.Discrete([0.5, 1.0, 1.5], [0.25, 0.5, 0.25]), 0.1)
    node = hg.Node(sensor, link, {"f": hg.filters.fed_back_filter(unstable, sensor, link)})
    network = hg.Network(unstable, {"a": node})
    assert np.mean(hg.monte_carlo(network, 150, 20, 0).errors("a", "f")[:, -50:] ** 2) < 0.5  # 1000 steps of 0.28
    with pytest.raises(ValueError, match="nodes: expected sensors without feedback"):
        hg.simulation.certify_boundedness(network)
