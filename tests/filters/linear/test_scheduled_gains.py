"""Saved gains against the recursion on-line, and what missing data do to either."""

from dataclasses import replace

import numpy as np
import pytest

import heliograph as hg
from heliograph.testing import check_filter
from tests.follow import follow
from tests.oracles import quadratic_bias as oracle
from tests.relay_bias import model, two_sensors

EXAMPLE = oracle.paper_example()
HORIZON = 10


def run(item, data, written_out=True):
    """Means and covariances after each measurement."""
    return follow(item, data, written_out=written_out)[:2]


def measurements(outputs, seed=0):
    return np.random.default_rng(seed).normal(size=(HORIZON, outputs))


@pytest.mark.slow
def test_estimates_are_the_papers():
    """(14), repaired, on the same measurements; the full form needs a pseudo-inverse for two sensors."""
    for system, outputs in ((EXAMPLE, 1), (two_sensors(), 2)):
        data = measurements(outputs)
        expected = oracle.quadratic(system, HORIZON, repaired=True)
        n = len(system.F) + system.C.shape[1]
        means, bounds = run(hg.polynomial_filter(*model(system, HORIZON), HORIZON), data)
        printed = oracle.estimates(system, expected, data, repaired=True)[1:, :n]
        np.testing.assert_allclose(means, printed, rtol=0, atol=1e-11 * np.abs(printed).max())
        scale = np.abs(expected.true).max()
        np.testing.assert_allclose(bounds, expected.true[1:, :n, :n], rtol=0, atol=1e-11 * scale)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_saved_gains_are_the_recursion(degree):
    s, data = model(EXAMPLE, HORIZON), measurements(1)
    saved = run(hg.filters.scheduled_polynomial_filter(*s, HORIZON, degree), data)
    online = run(hg.polynomial_filter(*s, HORIZON, degree), data, written_out=degree < 3)
    for a, b in zip(saved, online, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * max(np.abs(b).max(), 1))


def single(s, keep):
    """The same model with one of its measurements only."""
    row = np.eye(2)[[keep]]
    return s._replace(channel=hg.random_affine.Series([s.channel, hg.random_affine.known(row)]))


@pytest.mark.parametrize("missing", [0, 1])
def test_a_missing_component_is_a_channel_that_is_off(missing):
    """Every monomial with the component in it goes; what is left is the filter of the other component alone."""
    s, data = model(two_sensors(), HORIZON), measurements(2)
    holes = data.copy()
    holes[:, missing] = np.nan
    record = run(hg.polynomial_filter(*s, HORIZON), holes)
    expected = run(hg.polynomial_filter(*single(s, 1 - missing), HORIZON), data[:, [1 - missing]])
    for a, b in zip(record, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-11 * np.abs(b).max())


def test_nothing_arrives_for_a_while():
    """A gap is a stretch behind a silent channel, whose saved gains are then exact again."""
    horizon, gap = 8, range(3, 5)
    s, data = model(EXAMPLE, horizon), measurements(1)[:horizon]
    silent = hg.random_affine.Series([hg.random_affine.known(np.zeros((1, 1))), s.channel])
    live = hg.random_affine.Series([hg.random_affine.known(np.eye(1)), s.channel])
    varying = hg.model.over_time([silent if k in gap else live for k in range(horizon)])
    expected = hg.linear.lmmse(hg.linear.lifted_system(s.plant, s.sensor, varying, 2, horizon)).gains.covariance
    holes = data.copy()
    holes[list(gap)] = np.nan
    _, bounds = run(hg.polynomial_filter(*s, horizon), holes)
    np.testing.assert_allclose(bounds, expected, rtol=0, atol=1e-14)


def test_saved_gains_tell_that_their_covariance_is_lost():
    s, data = model(EXAMPLE, HORIZON), measurements(1)
    data[4] = np.nan
    for item in (hg.filters.scheduled_polynomial_filter(*s, HORIZON), hg.filters.memory_filter(*s, HORIZON)):
        means, bounds = run(item, data)
        assert np.all(np.isfinite(means))
        assert np.all(np.isfinite(bounds[:4])) and np.all(np.isnan(bounds[4:]))
        network = hg.Network(s.plant, {"node": hg.Node(s.sensor, s.channel, {"saved": item})})
        said = "node/saved: no valid covariance from step 4 in 1 of 1 runs"
        with pytest.warns(UserWarning, match=said):
            assert hg.run(network, {"node": data}).failures() == [said]


def test_a_missing_measurement_counts_as_expected():
    """Saved gains with a gap: the same state as if the filter's own prediction had arrived."""
    s, data = model(EXAMPLE, HORIZON), measurements(1)
    item = hg.filters.ScheduledFilter(hg.linear.lmmse(hg.linear.lifted_system(*s, 1, HORIZON)))
    state = item.init()
    for k in range(4):
        state, _ = item.step(state, data[k], (), k)
    g = item.gains.values
    expected = g.expected[4] @ np.asarray(state.value) + g.expected_offset[4]
    left, _ = item.step(state, np.array([np.nan]), (), 4)
    right, _ = item.step(state, expected, (), 4)
    np.testing.assert_allclose(left.value, right.value, rtol=0, atol=1e-15)


@pytest.mark.slow
def test_filters_keep_the_contract():
    s = model(two_sensors(), HORIZON)
    check_filter(hg.polynomial_filter(*s, HORIZON))
    check_filter(hg.filters.LinearSystemFilter(hg.linear.lifted_system(*s, 1, HORIZON)))
    # A last hop without noise leaves 72 of 288 combinations of atoms: enough to be in memory in native code.
    quiet = replace(two_sensors(), sigma=oracle.Atoms(np.zeros((1, 2)), np.ones(1)))
    check_filter(hg.filters.mixture_filter(*model(quiet, HORIZON), resolution=0.1))


def test_horizon_beyond_the_schedule_is_refused_by_the_driver():
    s = model(EXAMPLE, HORIZON)
    item = hg.filters.scheduled_polynomial_filter(*s, 5)
    network = hg.Network(s.plant, {"node": hg.Node(s.sensor, s.channel, {"saved": item})})
    with pytest.raises(ValueError, match="horizon: expected at most 5 steps"):
        hg.monte_carlo(network, HORIZON, 1, 0)


def test_a_stream_beyond_the_horizon_keeps_the_last_matrices():
    """A model of constant matrices in steady state: designed for 60 steps, at step 80 as one designed for 80."""
    plant, sensor = hg.LinearPlant([[0.7]], 1.0, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.5)
    short, long = (hg.Stream(hg.polynomial_filter(plant, sensor, hg.hop(0.9, 0.1), steps)) for steps in (60, 80))
    for z in np.random.default_rng(0).normal(size=80):
        a, b = short.push(z), long.push(z)
    np.testing.assert_allclose(a.mean, b.mean, rtol=0, atol=1e-10)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=0, atol=1e-10)


def test_uncertain_probabilities_make_the_claim_nominal():
    plant, sensor = hg.LinearPlant([[0.9]], 1.0, [0.0], 1.0), hg.LinearSensor([[1.0]], 1.0)
    for radius, claim in ((0.0, "exact"), (0.1, "nominal")):
        assert (
            hg.polynomial_filter(plant, sensor, hg.hop(hg.random_affine.bernoulli(0.6, radius), 0.1), 3).claim == claim
        )


@pytest.mark.slow
def test_claims_hold_in_the_drivers_monte_carlo():
    """Exact claims of every degree and of memory, in one network on one data set: NEES and covariances."""
    horizon, s = 10, model(EXAMPLE, 10, initial=0.01 * np.eye(2))
    filters = {f"degree {d}": hg.filters.scheduled_polynomial_filter(*s, horizon, d) for d in (2, 3)}
    filters["memory"] = hg.filters.memory_filter(*s, horizon)
    network = hg.Network(s.plant, {"node": hg.Node(s.sensor, s.channel, filters)})
    result = hg.monte_carlo(network, horizon, 1024, 1, keep=hg.Statistics())["node"]
    for name, statistics in result.items():
        assert statistics.worst_direction().z < 4.0, name
        _, low, high = statistics.nees_per_dimension(0.999)
        assert low < 1 < high, name


def test_products_with_the_past_refuse_a_channel_that_remembers():
    s = model(EXAMPLE, HORIZON)
    burst = hg.gilbert_elliott(s.channel, s.channel, 0.2, 0.4)
    with pytest.raises(ValueError, match=r"^channel of a memory filter: expected one that forgets, got Modes"):
        hg.filters.memory_filter(s.plant, s.sensor, burst, HORIZON)


def test_far_from_zero_products_with_the_past_keep_their_digits():
    """Behind a known gain they are those of x - E[x]: the same covariances at a mean of 1,000 as at none."""
    sensor = hg.LinearSensor([[1.0], [0.5]], [[0.1, 0.0], [0.0, 0.2]])
    near, far = (
        hg.filters.memory_filter(hg.LinearPlant([[0.9]], 0.1, [mean], 1.0), sensor, hg.perfect(2), 6)
        for mean in (0.0, 1000.0)
    )
    assert near.claim == far.claim == "exact"
    np.testing.assert_allclose(far.products.covariances[1:], near.products.covariances[1:], rtol=1e-12)
    data = np.random.default_rng(0).normal(size=(6, 2))
    moved = 1000.0 * 0.9 ** np.arange(1, 7)
    a, b = run(near, data)[0], run(far, data + moved[:, None] * np.array([1.0, 0.5]))[0]
    np.testing.assert_allclose(b, a + moved[:, None], rtol=1e-12)


@pytest.mark.filterwarnings("ignore:lmmse")  # rounding is all that is left of these variances
def test_no_variance_is_negative_where_nothing_is_unknown():
    """A state seen without noise: zero, where the moments' rounding would leave less than nothing."""
    plant, sensor = hg.LinearPlant([[0.9]], 0.0, [300.0], 1.0), hg.LinearSensor([[0.35], [-0.64]], 0.0)
    item = hg.filters.memory_filter(plant, sensor, hg.hop(hg.Discrete([1.0], [1.0]), 0.0, dimension=2), 12)
    claimed = item.products.covariances[1:]
    assert claimed.min() >= 0 and claimed[1::2].max() < 1e-9
