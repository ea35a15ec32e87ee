"""Filters that know something of the modes: limits, all paths of the modes, and simulation."""

from itertools import pairwise, product

import numpy as np
import pytest

import heliograph as hg
from tests.filters.modal_problems import BURSTS, PLANT, SENSOR, bursts
from tests.follow import follow

side_information_filter, late_filter = hg.filters.side_information_filter, hg.filters.mode_late_filter
known_filter = hg.filters.mode_known_filter
ARRIVAL = [0.5, 0.95]
LOSSY = hg.markov_fading([hg.erasure(hg.hop(g, 0.05), a) for g, a in zip((0.2, 1.0), ARRIVAL, strict=True)], BURSTS)
CLASSES = np.array([[0.7, 0.2, 0.1], [0.1, 0.3, 0.6]])  # P(flag | mode)
Z = np.random.default_rng(1).normal(size=(8, 1))


def claims(item, data):
    """Mean and variance of the first state after each measurement."""
    steps = follow(item, data)
    return np.column_stack([steps.mean[:, 0], steps.covariance[:, 0, 0]])


def test_arrival_that_is_certain_tells_nothing():
    certain = hg.markov_fading([hg.erasure(hg.hop(g, 0.05), 1.0) for g in (0.2, 1.0)], BURSTS)
    expected = claims(hg.linear_filter(PLANT, SENSOR, bursts()), Z)
    for channel in (certain, bursts()):
        np.testing.assert_allclose(claims(side_information_filter(PLANT, SENSOR, channel), Z), expected, rtol=1e-11)


def test_flags_that_tell_nothing_change_nothing():
    data = np.column_stack([Z, np.arange(8) % 3])
    result = claims(side_information_filter(PLANT, SENSOR, bursts(), [CLASSES[0]] * 2), data)
    np.testing.assert_allclose(result, claims(hg.linear_filter(PLANT, SENSOR, bursts()), Z), rtol=1e-11)


def test_flags_that_show_the_mode_make_it_the_kalman_filter_given_the_modes():
    modes = np.array([0, 0, 1, 1, 0, 1, 1, 0])
    given = hg.model.over_time([hg.hop((0.2, 1.0)[i], 0.05) for i in modes])
    result = claims(side_information_filter(PLANT, SENSOR, bursts(), np.eye(2)), np.column_stack([Z, modes]))
    expected = claims(hg.linear_filter(PLANT, SENSOR, given), Z)
    np.testing.assert_allclose(result, expected, rtol=1e-11)
    known = claims(known_filter(PLANT, SENSOR, bursts()), np.column_stack([Z, modes]))
    np.testing.assert_allclose(known, expected, rtol=1e-12)


def test_a_state_far_from_zero_keeps_its_digits():
    """Where modes differ in their losses alone, a mean of 1e8 deviations moves the estimate and no covariance."""
    channel = hg.markov_fading([hg.erasure(hg.hop(0.7, 0.05), a) for a in ARRIVAL], BURSTS)
    fixed = hg.LinearPlant(np.eye(2), 0.1 * np.eye(2), [0.0, 0.0], np.eye(2))
    far = hg.LinearPlant(np.eye(2), 0.1 * np.eye(2), [1e8, 0.0], np.eye(2))
    sensor = hg.LinearSensor([[1.0, 0.5]], 0.05)
    lost = np.where(np.arange(8)[:, None] % 3 == 1, np.nan, Z)
    result = claims(side_information_filter(far, sensor, channel), lost + 0.7e8)
    expected = claims(side_information_filter(fixed, sensor, channel), lost)
    np.testing.assert_allclose(result[:, 1], expected[:, 1], rtol=1e-12)
    np.testing.assert_allclose(result[:, 0] - 1e8, expected[:, 0], atol=1e-6)  # of 1e8, with rounding of 1e-8 a step


def test_a_state_that_is_known_stays_known():
    """Far from zero, growing, received with gains that the mode decides: nothing is left to find but its rounding."""
    plant = hg.LinearPlant([[-1.1468]], 0.0, [42.1271], 0.0)
    result = claims(side_information_filter(plant, hg.LinearSensor([[1e5]], 1e-12), LOSSY), Z)
    rounded = np.cumsum(1.1468 ** (2 * np.arange(8))) * (4 * np.finfo(float).eps * 42.1271) ** 2  # of each step
    assert np.all((result[:, 1] >= 0) & (result[:, 1] <= 1.001 * rounded))
    np.testing.assert_allclose(result[:, 0], 42.1271 * (-1.1468) ** np.arange(1, 9), rtol=1e-14)


@pytest.mark.parametrize("noise", [1e-8, 1e-14, 1e-20])
def test_a_precise_measurement_leaves_a_variance_that_is_right(noise):
    """Of x received in noise far below its own: the variance is the noise's, where a difference would be rounding."""
    plant = hg.LinearPlant([[0.9, 0.2], [0.0, 0.7]], np.eye(2), [3.0, 1.0], np.eye(2))
    sensor = hg.LinearSensor([[1.0, 0.0]], 0.0)
    data = np.column_stack([Z, Z[:, 0]])
    certain = hg.erasure(hg.hop(1.0, noise), 0.9)
    two = hg.markov_fading([hg.erasure(hg.hop(1.0, noise), a) for a in ARRIVAL], BURSTS)
    expected = claims(hg.linear_filter(plant, sensor, hg.hop(1.0, noise)), data[:, :1])
    np.testing.assert_allclose(expected[:, 1], noise, rtol=2 * noise, atol=1e-28)  # eps^2 of 1 and more
    np.testing.assert_allclose(
        claims(side_information_filter(plant, sensor, certain), data[:, :1]), expected, rtol=1e-9
    )
    result = claims(side_information_filter(plant, sensor, two), data[:, :1])
    np.testing.assert_allclose(result[:, 1], expected[:, 1], rtol=1e-6, atol=1e-15)  # rounding of the modes' own parts


DRIFTS = hg.amplify_and_forward([hg.model.autoregressive_fading(m, 0.4, r, 0.05) for m, r in ((1.0, 0.95), (0.8, 0.9))])


def test_a_drift_that_is_known():
    """Given (c_1, c_2) at each step it is the filter of the known gains."""
    known = np.random.default_rng(3).normal(size=(8, 2))
    hops = [[hg.hop(m + 0.4 * c, 0.05) for m, c in zip((1.0, 0.8), row, strict=True)] for row in known]
    given = hg.model.over_time([hg.amplify_and_forward(row) for row in hops])
    result = claims(known_filter(PLANT, SENSOR, DRIFTS), np.column_stack([Z, known]))
    np.testing.assert_allclose(result, claims(hg.linear_filter(PLANT, SENSOR, given), Z), rtol=1e-12)


def gains_by_hand(item, flags):
    """Gains and predictions of a filter for one pattern of flags, read off at unit measurements."""
    base = claims(item, np.column_stack([np.zeros(len(flags)), flags]))[:, 0]
    return base, [claims(item, np.column_stack([unit, flags]))[:, 0] - base for unit in np.eye(len(flags))]


@pytest.mark.parametrize("flags", [[0, 2, 1, 0], [2, 2, 0, 1]])
def test_its_covariance_is_its_error_over_all_paths_given_the_flags(flags):
    """E[(x_k - xhat_k)^2 | flags] of the gains that it uses, from all 16 paths weighed by the flags' probabilities."""
    steps, a, q, noise = len(flags), 0.98, 0.04, 0.05
    item = side_information_filter(PLANT, SENSOR, bursts(), CLASSES)
    base, columns = gains_by_hand(item, flags)
    claimed = claims(item, np.column_stack([np.zeros(steps), flags]))[:, 1]
    cov = np.array([[a ** abs(i - j) for j in range(steps)] for i in range(steps)]) * q / (1 - a**2)
    law = np.array([0.375, 0.625])
    for k in range(steps):  # given the flags up to step k
        weight, zz, xz = 0.0, 0.0, 0.0
        for path in product(range(2), repeat=k + 1):
            p = law[path[0]] * np.prod([BURSTS[i][j] for i, j in pairwise(path)])
            p *= np.prod([CLASSES[i, flags[m]] for m, i in enumerate(path)])
            g = np.array([(0.2, 1.0)[i] for i in path])
            second = np.outer(g, g) * (cov[: k + 1, : k + 1] + 0.05 * np.eye(k + 1)) + noise * np.eye(k + 1)
            weight, zz, xz = weight + p, zz + p * second, xz + p * g * cov[k, : k + 1]
        gain = np.array([columns[m][k] for m in range(k + 1)])
        error = cov[k, k] + (gain @ zz @ gain - 2 * gain @ xz) / weight
        assert base[k] == pytest.approx(0, abs=1e-12)
        assert claimed[k] == pytest.approx(error, rel=1e-10)


CHAIN = hg.random_affine.MarkovChain(BURSTS)
FADING_APART = hg.parallel(
    [hg.markov_fading([hg.erasure(hg.hop(g, 0.05), a) for g, a in ((0.2, 0.4), (1.0, p))], CHAIN) for p in (0.9, 0.8)]
)
TWICE = hg.LinearSensor([[1.0], [1.0]], 0.05 * np.eye(2))
RUNS, CONVERGED = 768, slice(30, 60)
MODES = np.eye(2, 3)  # P(flag | mode) of flags that are the mode; as many as in CLASSES, so that both are one kernel
WORLDS = {  # channel, filter, the mean variance in the long run
    "losses": (LOSSY, hg.linear_filter(PLANT, SENSOR, LOSSY), 0.1646),
    "mode by flag": (
        hg.model.with_flag(bursts(), MODES), side_information_filter(PLANT, SENSOR, bursts(), MODES), 0.0935
    ),
    "flags": (hg.model.with_flag(bursts(), CLASSES), side_information_filter(PLANT, SENSOR, bursts(), CLASSES), None),
    "mode one step late": (
        hg.model.with_flag(bursts(), late=True), late_filter(PLANT, SENSOR, bursts()), 0.0987
    ),
    "mode now": (hg.model.with_flag(bursts()), known_filter(PLANT, SENSOR, bursts()), 0.0935),
    "drifts one step late": (hg.model.with_flag(DRIFTS, late=True), late_filter(PLANT, SENSOR, DRIFTS), None),
    "two lossy links, each in its shadow": (FADING_APART, hg.linear_filter(PLANT, TWICE, FADING_APART), None),
}  # fmt: skip


# A few at a time are one program; what compiling all of them together costs grows faster than they.
TOGETHER = [
    ["losses", "mode now"],
    ["mode by flag", "flags"],
    ["mode one step late", "drifts one step late"],
    ["two lossy links, each in its shadow"],
]


@pytest.fixture(scope="module", params=TOGETHER, ids=" and ".join)
def record(request):
    """One plant, received in two ways at once."""
    nodes = {}
    for name in request.param:
        world, item, _ = WORLDS[name]
        nodes[name] = hg.Node(TWICE if world is FADING_APART else SENSOR, world, {"f": item})
    return hg.monte_carlo(hg.Network(PLANT, nodes), CONVERGED.stop, RUNS, 2)


@pytest.mark.slow
def test_claims_hold_in_simulation(record):
    """Mean claim and mean square error over the last 30 steps agree within four standard errors over runs."""
    for name in record.estimates:
        _, item, known = WORLDS[name]
        squares = record.errors(name, "f")[:, CONVERGED, 0] ** 2
        claimed = record.estimates[name]["f"].covariance[:, CONVERGED, 0, 0]
        apart = (squares - claimed).mean(axis=1)
        assert item.claim == "exact"
        assert abs(apart.mean()) < 4 * apart.std() / np.sqrt(RUNS), name
        spread = 5 * claimed.mean(axis=1).std() / np.sqrt(RUNS)
        assert known is None or claimed.mean() == pytest.approx(known, abs=spread), name


def test_arrival_that_varies_and_is_certain_at_some_steps():
    """At a step where everything arrives, a packet lost for another reason tells nothing of the mode."""
    chain = hg.random_affine.MarkovChain(BURSTS)
    steps = []
    for sure in (True, False, True):
        hops = zip((0.2, 1.0), (1.0, 1.0) if sure else ARRIVAL, strict=True)
        steps.append(hg.markov_fading([hg.erasure(hg.hop(g, 0.05), a) for g, a in hops], chain))
    item = hg.linear_filter(PLANT, SENSOR, hg.model.over_time(steps))
    result = claims(item, [[0.3], [np.nan], [np.nan]])
    state = item.predict(item.init(), (), 0)
    for k, z in enumerate([[0.3], [np.nan]]):
        state = item.predict(item.correct(state, z, k)[0], (), k + 1)
    expected = item.estimate(state)
    assert np.all(np.isfinite(result))
    np.testing.assert_allclose(result[2], [expected.mean[0], expected.covariance[0, 0]], rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "item",
    [
        side_information_filter(PLANT, SENSOR, bursts(), CLASSES),
        hg.linear_filter(PLANT, SENSOR, LOSSY),
        late_filter(PLANT, SENSOR, bursts()),
        known_filter(PLANT, SENSOR, DRIFTS),
    ],
    ids=["flags", "losses", "late", "known"],
)
def test_they_keep_the_contract_of_filters(item):
    hg.testing.check_filter(item)


BAD_INPUT = {
    "flags of a mode": (
        lambda: side_information_filter(PLANT, SENSOR, bursts(), [[0.5, 0.4], [0, 1]]), "flags in mode 0: expected"
    ),
    "too few modes": (lambda: side_information_filter(PLANT, SENSOR, bursts(), [[1.0]]), "flags: expected shape"),
    "no chain": (lambda: hg.model.with_flag(hg.hop(1.0, 0.1)), "chain: expected one that the flag tells of"),
    "update": (
        lambda: hg.linear_filter(PLANT, SENSOR, bursts(), hg.filters.Polytope()), "update: expected none behind"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_INPUT)
def test_bad_input_gets_one_clear_line(name):
    make, words = BAD_INPUT[name]
    with pytest.raises(ValueError, match=f"^{words}"):
        make()
