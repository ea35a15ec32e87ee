"""The best linear filter behind links that remember: numbers known beforehand, limits, and simulation."""

import jax
import numpy as np
import pytest

import heliograph as hg
from heliograph.engine.choice import compute_once
from tests.filters.modal_problems import BURSTS, PLANT, RELAY, SENSOR, bursts, variances

STEPS = 200  # after which no variance changes any more


def test_fading_in_bursts():
    """P_1, P_2, P_10, P_inf to the digits given."""
    result = variances(PLANT, SENSOR, bursts(), STEPS)[[0, 1, 9, -1], 0]
    np.testing.assert_allclose(result, [0.323796, 0.283304, 0.248939, 0.238689], atol=6e-7)


@pytest.mark.slow
@pytest.mark.parametrize(("shared", "limit"), [(True, 0.227110), (False, 0.148447)])
def test_two_sensors_with_shared_fading_or_in_two(shared, limit):
    two = hg.LinearSensor([[1.0], [1.0]], 0.05 * np.eye(2))
    links = hg.parallel([hg.shared(bursts(), "road") if shared else bursts()] * 2)
    assert variances(PLANT, two, links, STEPS)[-1, 0] == pytest.approx(limit, abs=6e-7)


def test_two_drifting_hops():
    plant = hg.LinearPlant([[0.98, 0.1], [0, 0.95]], np.diag([0.002, 0.02]), [1.0, 0.0], np.diag([1.0, 0.2]))
    first, second = (hg.model.autoregressive_fading(m, s, r, 0.05) for m, s, r in ((1.0, 0.4, 0.95), (0.8, 0.3, 0.9)))
    result = variances(plant, hg.LinearSensor([[1.0, 0.0]], 0.05), hg.amplify_and_forward([first, second]), 100)
    known = [[0.444130, 0.200298], [0.393069, 0.199766], [0.293346, 0.179459], [0.299861, 0.158136]]
    np.testing.assert_allclose(result[[0, 1, 9, 99]], known, atol=6e-7)


LIMITS = {  # a channel that remembers, and the same without memory or in other words
    "equal rows": (
        hg.markov_fading([0.2, 1.0], [[0.4, 0.6], [0.4, 0.6]], 0.05),
        hg.hop(hg.Discrete([0.2, 1.0], [0.4, 0.6]), 0.05),
    ),
    "one mode": (hg.markov_fading([hg.hop(hg.Rayleigh(1.0), 0.1)], [[1.0]]), hg.hop(hg.Rayleigh(1.0), 0.1)),
    "equal maps": (hg.markov_fading([RELAY, RELAY], BURSTS), RELAY),
    "no correlation": (
        hg.model.autoregressive_fading(1.0, 0.4, 0.0, 0.1),
        hg.hop(hg.random_affine.GivenMoments([1, 1.16]), 0.1),
    ),
    "modes in another order": (bursts(), hg.markov_fading([1.0, 0.2], np.array(BURSTS)[::-1, ::-1], 0.05)),
    "a chain with the mean, deviation and correlation of a drift": (
        bursts(),
        hg.model.autoregressive_fading(0.7, 0.8 * np.sqrt(0.375 * 0.625), 0.92, 0.05),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LIMITS)
def test_limits(name):
    item, other = (variances(PLANT, SENSOR, channel, STEPS) for channel in LIMITS[name])
    np.testing.assert_allclose(item, other, rtol=1e-12)


def test_estimates_do_not_depend_on_the_order_of_modes_and_hold_in_simulation():
    """The claimed variance lies within four standard errors of the measured one at each of the last steps."""
    channel = hg.gilbert_elliott(hg.hop(1.0, 0.05), hg.hop(0.2, 0.05), 0.03, 0.05)
    filters = {"exact": hg.linear_filter(PLANT, SENSOR, channel), "turned": hg.linear_filter(PLANT, SENSOR, bursts())}
    record = hg.monte_carlo(hg.Network(PLANT, {"node": hg.Node(SENSOR, channel, filters)}), 40, 4000, 3)
    errors = {f: record.errors("node", f)[..., 0] for f in filters}
    np.testing.assert_allclose(errors["exact"], errors["turned"], atol=1e-10)
    squares = errors["exact"][:, 30:] ** 2
    claimed = record.estimates["node"]["exact"].covariance[0, 30:, 0, 0]
    assert np.all(np.abs(squares.mean(axis=0) - claimed) < 4 * squares.std(axis=0) / np.sqrt(4000))


def test_what_does_not_arrive_is_left_out():
    item = hg.linear_filter(PLANT, SENSOR, bursts())
    state = item.predict(item.init())
    after, innovation = item.correct(state, [np.nan])
    np.testing.assert_allclose(after.gaussian.mean, state.gaussian.mean, atol=0)
    np.testing.assert_allclose(after.gaussian.covariance, state.gaussian.covariance, rtol=1e-15)
    assert innovation.log_likelihood == 0


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.0, 0.01])
def test_a_mean_far_from_zero_costs_no_digits(radius):
    """Where modes differ in their noise alone, a mean of 1e8 deviations moves all estimates and no covariance."""
    chain = hg.random_affine.MarkovChain(BURSTS, radius=radius)
    channel = hg.markov_fading([hg.hop(0.7, noise) for noise in (0.05, 0.5)], chain)
    z, results = np.random.default_rng(1).normal(size=(8, 1)), []
    for far in (0.0, 1e8):
        plant = hg.LinearPlant(np.eye(2), 0.1 * np.eye(2), [far, 0.0], np.eye(2))
        item = hg.linear_filter(plant, hg.LinearSensor([[1.0, 0.5]], 0.05), channel)
        network = hg.Network(plant, {"node": hg.Node(item.sensor, channel, {"one": item})})
        data = {"node": np.where(np.arange(8)[:, None] == 3, np.nan, z + 0.7 * far)}
        record = hg.run(network, data, smooth=hg.smoothing.FixedInterval())
        items = record.estimates["node"]["one"], record.smoothed.estimates["node"]["one"]
        means, claimed = [single.mean - [far, 0.0] for single in items], [single.covariance for single in items]
        results.append((means, claimed, item.planned(np.zeros((8, 0))).covariances))
    np.testing.assert_allclose(results[1][0], results[0][0], atol=1e-6)  # of 1e8, with rounding of 1e-8 a step
    np.testing.assert_allclose(results[1][1], results[0][1], rtol=1e-12)
    np.testing.assert_allclose(results[1][2], results[0][2], rtol=1e-12)


def test_it_keeps_the_contract_of_filters():
    two = hg.LinearSensor([[1.0], [1.0]], 0.05 * np.eye(2))
    hg.testing.check_filter(hg.linear_filter(PLANT, two, hg.parallel([bursts(), bursts()])))


@pytest.mark.slow
def test_the_likelihood_has_a_gradient_in_what_the_links_remember():
    """Against central differences of relative error 1e-7."""
    z = np.random.default_rng(0).normal(size=(10, 1))

    def likelihood(p):
        link = hg.gilbert_elliott(hg.hop(p[2], 0.05), hg.hop(0.2, 0.05), p[0], p[1])
        channel = hg.amplify_and_forward([link, hg.model.autoregressive_fading(1.0, p[3], p[4], 0.05)])
        return hg.log_likelihood(hg.linear_filter(PLANT, SENSOR, channel), z)

    at, steps = np.array([0.05, 0.1, 1.0, 0.3, 0.8]), 1e-5 * np.eye(5)
    slope = jax.grad(likelihood)
    slopes = compute_once(slope, jax.jit(slope), (at,))  # a third of the time of XLA
    expected = [(likelihood(at + d) - likelihood(at - d)) / 2e-5 for d in steps]
    np.testing.assert_allclose(slopes, expected, rtol=1e-6, atol=1e-6)
