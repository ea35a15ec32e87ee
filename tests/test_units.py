"""Units do not decide: what is known, singular or indefinite is so in any units, and a limit is a number."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.model import silent
from tests.draws import draw
from tests.follow import last

CART = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0)
FILTERS = {
    "linear": hg.linear_filter,
    "cubature": hg.cubature_filter,
    "extended": hg.extended_filter,
    "zero_mean": lambda *parts: hg.cubature_filter(*parts, hg.filters.ZeroMean()),
    "mixture": hg.filters.mixture_filter,
    "polynomial": lambda *parts: hg.polynomial_filter(*parts, 2, degree=1),
}


def test_a_spread_far_below_the_others_is_neither_dropped_by_a_filter_nor_by_a_draw():
    plant = hg.Plant(lambda x, u: x, np.diag([1, 1e-14]), np.zeros(2), np.diag([1e6, 1e-9]))
    open_loop = hg.filters.open_loop_filter(plant)
    result = open_loop.estimate(open_loop.predict(open_loop.init())).covariance
    np.testing.assert_allclose(np.diag(result), [1e6 + 1, 1e-9 + 1e-14], rtol=1e-13)
    drawn = draw(plant.sample_initial, 4000)
    np.testing.assert_allclose(drawn.var(axis=0), [1e6, 1e-9], rtol=0.1)  # 4.5 standard errors


def test_an_exact_filter_of_states_in_very_different_units_has_the_scalar_filters_numbers():
    plant = hg.LinearPlant(np.eye(2), np.diag([0.1, 1e-17]), np.zeros(2), np.diag([1e2, 1e-16]))
    sensor = hg.LinearSensor(np.eye(2), np.diag([1.0, 1e-16]))
    estimate = last(hg.cubature_filter(plant, sensor, hg.perfect(2)), [[1.0, 1e-8]])
    prior = np.array([100.1, 1.1e-16])
    noise, z = np.array([1.0, 1e-16]), np.array([1.0, 1e-8])
    expected = prior / (1 + prior / noise)
    np.testing.assert_allclose(np.diag(estimate.covariance), expected, rtol=1e-12)  # roundings of a prior 100 times it
    np.testing.assert_allclose(estimate.mean, prior / (prior + noise) * z, rtol=1e-13)


RULES = [
    hg.fusion.EqualIntersection(),
    hg.CovarianceIntersection(),
    hg.fusion.FixedIntersection([0.3, 0.7]),
    hg.fusion.InverseCovarianceIntersection(),
]


@pytest.mark.parametrize("rule", RULES, ids=lambda r: type(r).__name__)
def test_fusion_in_very_different_units(rule):
    p = np.diag([1e6, 1e-9])
    result = hg.fusion.fuse(rule, [hg.model.Estimate(np.array([1.0, 1e-6]), p, "upper")] * 2)
    np.testing.assert_allclose(np.diag(result.covariance), [1e6, 1e-9], rtol=1e-7)
    np.testing.assert_allclose(result.mean, [1.0, 1e-6], rtol=1e-7)


@pytest.mark.parametrize("rule", RULES, ids=lambda r: type(r).__name__)
def test_what_one_estimate_knows_exactly_the_fused_one_knows(rule):
    """The limit p -> 0 of diag(p, 1) fused with P: what is known stays known, and the rest is as for a small p."""
    other = np.array([[2.0, 0.5], [0.5, 1.5]])
    means = np.array([1.0, 2.0]), np.array([1.5, 1.0])

    def fused(p):
        return hg.fusion.fuse(
            rule, [hg.model.Estimate(means[0], np.diag([p, 1.0]), "upper"), hg.model.Estimate(means[1], other, "upper")]
        )

    result, near = fused(0.0), fused(1e-7)
    np.testing.assert_array_equal(np.asarray(result.covariance)[0], 0.0)
    np.testing.assert_allclose(result.mean, near.mean, atol=3e-4)  # weights move with the root of p
    np.testing.assert_allclose(result.covariance, near.covariance, atol=3e-4)
    nothing = hg.fusion.fuse(rule, [hg.model.Estimate(means[0], np.zeros((2, 2)), "upper")] * 2)
    np.testing.assert_array_equal(nothing.covariance, 0.0)
    np.testing.assert_allclose(nothing.mean, means[0], rtol=1e-12)


@pytest.mark.parametrize("name", FILTERS)
def test_a_silent_component_is_as_if_it_were_not_there(name):
    received = last(FILTERS[name](CART, hg.LinearSensor([[1.0]], 0.1), hg.perfect()), [[1.0], [1.0]])
    pair = hg.LinearSensor([[1.0], [1.0]], 0.1)
    estimate = last(FILTERS[name](CART, pair, hg.parallel([hg.perfect(), silent()])), [[1.0, 0.0]] * 2)
    np.testing.assert_allclose(
        [estimate.mean[0], estimate.covariance[0, 0]], [received.mean[0], received.covariance[0, 0]]
    )


@pytest.mark.parametrize("channel", [silent(), hg.dropout(hg.perfect(), 0.0)], ids=["silent", "never arrives"])
@pytest.mark.parametrize("name", FILTERS)
def test_behind_a_silent_channel_a_filter_predicts(name, channel):
    estimate = last(FILTERS[name](CART, hg.LinearSensor([[1.0]], 0.1), channel), [[0.0], [0.0]])
    np.testing.assert_allclose(
        [estimate.mean[0], estimate.covariance[0, 0]], [0.0, 0.81**2 + 0.1 * (1 + 0.81)], atol=1e-12
    )


@pytest.mark.parametrize("name", FILTERS)
def test_noise_free_hops_and_a_position_known_exactly(name):
    twice = hg.LinearSensor([[1.0], [1.0]], 0.0)
    estimate = last(FILTERS[name](CART, twice, hg.perfect(2)), [[1.0, 1.0], [0.5, 0.5]])
    assert estimate.mean[0] == pytest.approx(0.5, abs=1e-14) and 0 <= estimate.covariance[0, 0] < 1e-14
    assert estimate.claims == estimate.claim != "none"
    plant = hg.LinearPlant(np.eye(2), np.diag([0.0, 0.1]), [3.0, 0.0], np.diag([0.0, 1.0]))
    known = last(FILTERS[name](plant, hg.LinearSensor(np.eye(2), np.diag([0.0, 0.1])), hg.perfect(2)), [[3.0, 1.0]])
    np.testing.assert_allclose(known.mean, [3.0, 1.1 / 1.2], rtol=1e-13)
    np.testing.assert_allclose(known.covariance, np.diag([0.0, 0.11 / 1.2]), atol=1e-14)


UNCERTAIN = hg.hop(hg.Discrete([0.5, 1.0], [0.5, 0.5], 0.1), noise=0.1)


@pytest.mark.parametrize("c, p", [(0.0, 1.0), (1.0, 0.0)], ids=["C = 0", "P = 0"])
def test_the_bound_of_a_zero_mean_error_where_nothing_can_be_learned(c, p):
    plant = hg.LinearPlant(np.eye(2), 0.0, [3.0, 0.0], p)
    item = hg.cubature_filter(plant, hg.LinearSensor([[c, 0.0]], 0.1), UNCERTAIN, hg.filters.ZeroMean())
    estimate = last(item, [[1.0], [1.0]])
    np.testing.assert_allclose(estimate.covariance, p * np.eye(2), atol=1e-11)
    np.testing.assert_allclose(estimate.mean, [3.0, 0.0], atol=1e-11)


def test_a_zero_mean_bound_skips_missing_components_as_the_filter_built_without_them():
    plant = hg.LinearPlant(0.9 * np.eye(4), 0.1, np.zeros(4), np.eye(4) + 0.3)
    rule = hg.filters.ZeroMean()
    channel = hg.parallel([UNCERTAIN] * 4)
    full = hg.cubature_filter(plant, hg.LinearSensor(np.eye(4), 0.1), channel, rule)
    z = np.array([0.7, np.nan, np.nan, np.nan])
    item = hg.cubature_filter(plant, hg.LinearSensor(np.eye(4)[:1], 0.1), UNCERTAIN, rule)
    result, expected = last(full, [z, z]), last(item, [z[:1], z[:1]])
    np.testing.assert_allclose(result.covariance, expected.covariance, rtol=1e-9)
    np.testing.assert_allclose(result.mean, expected.mean, rtol=1e-9)


def test_an_indefinite_matrix_is_one_in_any_units():
    with pytest.raises(ValueError, match="positive semidefinite"):
        hg.Gaussian(np.diag([1e6, -1e-9]))
    units = np.array([1e9, 1e-9])
    with pytest.raises(ValueError, match="positive semidefinite"):
        hg.Gaussian(np.array([[1.0, 1.1], [1.1, 1.0]]) * np.outer(units, units))
    hg.Gaussian(np.array([[1.0, 1.0], [1.0, 1.0]]) * np.outer(units, units))
    assert hg.model.Estimate(np.zeros(2), np.diag([1e6, -1e-9]), "exact").claims == "none"
    assert hg.model.Estimate(np.zeros(2), np.diag([1e6, 0.0]), "exact").claims == "exact"


def test_of_several_covariances_each_is_judged_by_itself():
    several = np.array([np.eye(2), [[1.0, 1.1], [1.1, 1.0]], [[1.0, 1.0], [1.0, 1.0]], np.diag([1e6, np.nan])])
    estimates = hg.model.Estimate(np.zeros((4, 2)), several, "exact")
    assert estimates.claims.tolist() == ["exact", "none", "exact", "none"]


def test_the_root_that_draws_a_noise_keeps_every_components_digits():
    units = np.array([1e6, 1e-6, 1.0])
    shape = np.array([[1.0, 0.5, 0.2], [0.5, 1.0, -0.3], [0.2, -0.3, 1.0]]) * np.outer(units, units)
    factor = hg.Gaussian(shape).factor
    np.testing.assert_allclose(factor @ factor.T / np.outer(units, units), shape / np.outer(units, units), atol=1e-10)


def test_statistics_of_a_state_known_exactly_are_numbers():
    plant = hg.LinearPlant(np.eye(2), np.diag([0.0, 0.1]), [3.0, 0.0], np.diag([0.0, 1.0]))
    sensor = hg.LinearSensor(np.eye(2), np.diag([0.0, 0.1]))
    nodes = {"node": hg.Node(sensor, hg.perfect(2), {"kalman": hg.kalman_filter(plant, sensor)})}
    result = hg.monte_carlo(hg.Network(plant, nodes), 5, 200, 0, keep=hg.Statistics())["node"]["kalman"]
    mean, low, high = result.nees_per_dimension(0.999)
    assert low <= 1.0 <= high and np.isfinite(mean)
    assert abs(result.worst_direction().z) < 4


def test_a_known_state_that_is_not_where_it_is_said_to_be_is_infinitely_far():
    covariance = np.diag([0.0, 4.0])
    assert hg.nees([0.0, 2.0], [0.0, 0.0], covariance) == 2.0  # 1 in expectation, and 2^2 / 4
    assert hg.nees([1e-3, 2.0], [0.0, 0.0], covariance) == np.inf
