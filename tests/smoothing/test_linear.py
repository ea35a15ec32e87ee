"""Smoothers of linear filters against the best linear estimate of the whole trajectory, by brute force."""

import numpy as np
import pytest

import heliograph as hg
from tests.oracles.stacked_estimate import Step, estimate, stacked

PLANT = hg.LinearPlant([[1.0]], 1.0, [0.0], 1.0)
N, M, TIME, LAG, POINT = 3, 2, 9, 3, 2
VALUES = np.array([0.2, 1.1, 1.4])
CLOSE = 1e-11  # of numbers of size one; the worst of 60 such problems is 4e-12, in one where P- is nearly singular


def of_rank(rng, n, rank):
    root = rng.normal(size=(n, rank))
    return root @ root.T


def problem(seed):
    """Everything varies: gains random, A, Q and P0 singular, a third of the components missing."""
    rng = np.random.default_rng(seed)
    mean, covariance = rng.normal(size=N), of_rank(rng, N, 2)
    plants, sensors, channels, steps = [], [], [], []
    for _ in range(TIME):
        a, c, chances = 0.6 * rng.normal(size=(N, N)), rng.normal(size=(M, N)), rng.dirichlet(np.ones(3))
        a[:, 0] = a[:, 1]
        q, r, n = of_rank(rng, N, 1), 0.1 * of_rank(rng, M, 2), 0.1 * of_rank(rng, M, 2)
        plants.append(hg.LinearPlant(a, q, mean, covariance))
        sensors.append(hg.LinearSensor(c, r))
        channels.append(hg.hop(hg.Discrete(VALUES, chances), n))
        gains = VALUES[:, None, None] * np.eye(M)
        steps.append(Step(a, np.zeros(N), q, c, np.zeros(M), r, gains, chances, np.zeros(M), n))
    z = rng.normal(size=(TIME, M))
    z[rng.random((TIME, M)) < 0.3] = np.nan
    item = hg.linear_filter(hg.model.over_time(plants), hg.model.over_time(sensors), hg.model.over_time(channels))
    return item, stacked(mean, covariance, steps), z


@pytest.mark.parametrize("seed", range(6))
def test_smoothers_are_the_stacked_linear_estimate(seed):
    item, whole, z = problem(seed)
    _, steps = hg.smoothing.smoother_steps(item, z)
    given = {upto: estimate(whole, z, upto) for upto in range(1, TIME + 1)}
    interval = hg.smoothing.FixedInterval().estimates(steps)
    lagged = hg.smoothing.FixedLag(LAG).estimates(steps)
    point = hg.smoothing.FixedPoint(POINT).estimates(steps)
    assert {e.claim for e in (interval, lagged, point)} == {"exact"}
    for k in range(TIME):
        compared = [(interval, k, k, TIME), (lagged, k, k, min(k + 1 + LAG, TIME))]
        for single, at, about, upto in [*compared, (point, k - POINT, POINT, k + 1)][: 2 + (k >= POINT)]:
            mean, covariance = given[upto]
            np.testing.assert_allclose(single.mean[at], mean[about], atol=CLOSE, rtol=0)
            np.testing.assert_allclose(single.covariance[at], covariance[about], atol=CLOSE, rtol=0)


@pytest.mark.slow
def test_planned_before_data_it_maps_data_to_the_same_means():
    item, _, z = problem(0)
    z = 0.1 * np.nan_to_num(z)  # larger data would not be such as the filter expects, and warn
    for smoothing in (hg.smoothing.FixedInterval(), hg.smoothing.FixedLag(LAG)):
        planned = hg.smoothing.planned_smoother(item, TIME, smoothing)
        _, steps = hg.smoothing.smoother_steps(item, z)
        known = smoothing.estimates(steps)
        means = hg.simulation.over_runs(planned.means, np.stack([z, 2 * z]))
        np.testing.assert_allclose(means[0], known.mean, atol=CLOSE, rtol=0)
        np.testing.assert_allclose(planned.means(z), known.mean, atol=CLOSE, rtol=0)
        np.testing.assert_allclose(planned.estimate.covariance, known.covariance, atol=CLOSE, rtol=0)
        assert planned.estimate.claim == "exact"
    with pytest.raises(ValueError, match=r"filter: expected one whose gains depend on no data, got OpenLoop"):
        hg.smoothing.planned_smoother(hg.filters.open_loop_filter(PLANT), 3, hg.smoothing.FixedInterval())


@pytest.mark.slow
def test_simulations_of_nine_states_smooth_as_planned():
    """Native code of a simulation, whose matrices of 81 numbers are in memory, against the planned smoother."""
    rng = np.random.default_rng(1)
    plant = hg.LinearPlant(0.2 * rng.normal(size=(9, 9)), of_rank(rng, 9, 9) / 9, np.zeros(9), np.eye(9))
    item = hg.linear_filter(plant, hg.LinearSensor(rng.normal(size=(1, 9)), 0.1), hg.perfect())
    network = hg.Network(plant, {"a": hg.Node(item.sensor, hg.perfect(), {"linear": item})})
    simulated = hg.monte_carlo(network, 4, 2, key=0, smooth=hg.smoothing.FixedInterval()).smoothed
    planned = hg.smoothing.planned_smoother(item, 4, hg.smoothing.FixedInterval())
    smoothed = simulated.estimates["a"]["linear"]
    means = hg.simulation.over_runs(planned.means, simulated.measurements["a"])
    np.testing.assert_allclose(smoothed.mean, means, atol=CLOSE, rtol=0)
    np.testing.assert_allclose(smoothed.covariance[0], planned.estimate.covariance, atol=CLOSE, rtol=0)


def test_what_a_precise_future_leaves_keeps_its_digits():
    """Smoothed variances of a start that two precise positions pin down, against the limit R -> 0 of a straight line.

    With Q = 0 all is found from z by least squares: Var v = R 12 / (T^3 - T), Var x_T = R (4 T - 2) / (T^2 + T).
    P - P Lambda P is 1e-16 P wrong: more than the whole of the variance of v after the first step.
    """
    precise, steps = 1e-6, 6
    plant = hg.LinearPlant([[1, 1], [0, 1]], 0.0, [0.0, 0.0], [[1e4, 0.0], [0.0, 1e4]])
    item = hg.kalman_filter(plant, hg.LinearSensor([[1, 0]], [[precise]]))
    _, steps_ = hg.smoothing.smoother_steps(item, np.zeros((steps, 1)))
    result = hg.smoothing.FixedInterval().estimates(steps_).covariance
    velocity = precise * 12 / (steps**3 - steps)
    ends = precise * (4 * steps - 2) / (steps**2 + steps)
    np.testing.assert_allclose(result[:, 1, 1], velocity, rtol=1e-4)  # of a prior correlated by 1 - 1e-10: 1e-6 remain
    np.testing.assert_allclose(result[[0, -1], 0, 0], ends, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "smoothing", [hg.smoothing.FixedInterval(), hg.smoothing.FixedLag(3), hg.smoothing.FixedPoint(1)]
)
def test_a_state_that_later_data_tell_exactly_is_smoothed_to_its_rounding(smoothing):
    """Both states are a multiple of one number, at first unseen, then seen without noise, and known from there on.

    The innovations that follow are rounding, and so is their variance: an adjoint that divides by it is 1e15 too large
    when the update that gave the states is to take it off again.
    """
    plant = hg.LinearPlant([[0.8, 0.32], [-1.26, 0.88]], 0.0, [0.5, -0.7], np.outer([0.3, 0.03], [0.3, 0.03]))
    sensor, channel = hg.LinearSensor([[-0.16, -0.48], [0.6, 0.04]], 0.0), hg.erasure(hg.perfect(2), 0.7)
    items = {"linear": hg.linear_filter(plant, sensor, hg.perfect(2)), "kalman": hg.kalman_filter(plant, sensor)}
    network = hg.Network(plant, {"a": hg.Node(sensor, channel, items)})
    record = hg.monte_carlo(network, 12, 100, 1, smooth=smoothing)
    for name, item in record.smoothed.estimates["a"].items():
        assert (item.claims == "exact").all()
        squared, variance = record.smoothed.errors("a", name) ** 2, np.einsum("...ii->...i", item.covariance)
        assert (squared <= 60 * variance + 1e-30).all()  # 7.7 deviations, or (4 eps)^2 of states of size one
        seen = ~np.isnan(record.measurements["a"][:, 1]).any(axis=-1)  # at the second step
        if not isinstance(smoothing, hg.smoothing.FixedPoint):
            assert variance[seen, 0].max() < 1e-16  # rounding of P, where the first was unseen


@pytest.mark.slow
@pytest.mark.parametrize("smoothing", [hg.smoothing.FixedInterval(), hg.smoothing.FixedLag(3)])
def test_a_state_without_noise_is_smoothed_to_some_roundings(smoothing):
    """A plant and an output free of noise: from the first data on, the state is known.

    A gain A^-1, which is right without rounding, took that of a later state for news, 1e10 times in the mean square.
    """
    direction = np.array([0.1, 0.5, -1.0])
    matrix = [[0.6, 0.2, -0.9], [0.2, -0.1, -0.7], [-0.1, -0.3, -1.0]]
    plant = hg.LinearPlant(matrix, 0.0, [2000.0, -150.0, 1500.0], np.outer(direction, direction))
    sensor = hg.LinearSensor([[-0.1, -0.2, -1.3]], 0.0)
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"f": hg.kalman_filter(plant, sensor)})})
    record = hg.monte_carlo(network, 12, 20, 0, smooth=smoothing)
    squared = np.mean(record.smoothed.errors("a", "f") ** 2, axis=0)
    assert (squared <= (100 * np.finfo(float).eps * np.abs(record.truth).max(axis=(0, 1))) ** 2).all()
    assert (squared <= 10 * np.einsum("...ii->...i", record.smoothed.estimates["a"]["f"].covariance[0])).all()
