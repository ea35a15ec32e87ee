"""Smoothers by moments around an update: as the best where that is known, better than the filter elsewhere."""

import numpy as np
import pytest

import heliograph as hg

PLANT = hg.LinearPlant([[0.95, 0.2], [-0.2, 0.9]], 0.05, [1.0, -0.5], [[0.5, 0.1], [0.1, 0.4]])
SENSOR = hg.LinearSensor([[1.0, 0.0]], 0.05)
INTERVAL = hg.smoothing.FixedInterval()
HORIZON, RUNS = 15, 200


def test_a_central_filter_without_random_gains_smooths_as_one_that_receives_all_at_once():
    links = [hg.hop(0.8, 0.1), hg.hop(1.1, 0.3)]
    central = hg.filters.sequential_filter([hg.cubature_filter(PLANT, SENSOR, link) for link in links])
    both = hg.LinearSensor([[1.0, 0.0], [1.0, 0.0]], 0.05 * np.eye(2))
    joint = hg.linear_filter(PLANT, both, hg.parallel(links))
    z = 0.5 * np.sin(np.arange(2.0 * HORIZON)).reshape(HORIZON, 2)
    z[3, 0] = z[5] = np.nan
    result, known = (INTERVAL.estimates(hg.smoothing.smoother_steps(item, z)[1]) for item in (central, joint))
    assert result.claim == known.claim == "exact"
    np.testing.assert_allclose(result.mean, known.mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(result.covariance, known.covariance, rtol=0, atol=1e-12)


REMEMBERING = {"uncertain chain": (0.02, hg.linear_filter), "multiple models": (0.0, hg.filters.imm_filter)}


@pytest.mark.parametrize("kind", REMEMBERING)
def test_behind_links_that_remember_it_is_nominal_and_better_than_the_filter(kind):
    radius, make = REMEMBERING[kind]
    road = hg.random_affine.MarkovChain([[0.95, 0.05], [0.1, 0.9]], radius=radius)
    link = hg.markov_fading([1.0, 0.3], road, 0.05)
    network = hg.Network(PLANT, {kind: hg.Node(SENSOR, link, {"one": make(PLANT, SENSOR, link)})})
    result = hg.monte_carlo(network, HORIZON, RUNS, 1, keep=hg.Statistics(), smooth=INTERVAL)
    filtered, smoothed = result[kind]["one"], result.smoothed[kind]["one"]
    assert smoothed.claim == "nominal"
    assert smoothed.rmse()[0] < 0.95 * filtered.rmse()[0]
    assert smoothed.nees_per_dimension()[0] < 1.2
