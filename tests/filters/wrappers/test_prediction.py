"""A filter's prediction as its estimate."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.filters.wrappers.fed_back import prediction_of

PLANT = hg.LinearPlant([[0.9, 0.2], [0.0, 0.8]], 0.1 * np.eye(2), [1.0, -1.0], np.eye(2))
SENSOR = hg.LinearSensor([[1.0, 0.0]], 0.5)
CHANNEL = hg.hop(hg.random_affine.bernoulli(0.8), 0.1)


def filtered():
    return hg.cubature_filter(PLANT, SENSOR, CHANNEL)


def test_it_is_the_step_ahead_of_the_filtered_estimate():
    base, z = filtered(), [[0.7], [np.nan], [-0.2], [1.1]]
    predicting = prediction_of(base)
    state, local = predicting.init(), base.init()
    for k, value in enumerate(z):
        expected = PLANT.matrix @ local.mean, PLANT.matrix @ local.covariance @ PLANT.matrix.T + 0.1 * np.eye(2)
        state, ahead = predicting.step(state, value, (), k)
        local, _ = base.step(local, value, (), k)
        np.testing.assert_allclose(ahead.mean, expected[0], rtol=0, atol=1e-13)  # rounding of a few operations
        np.testing.assert_allclose(ahead.covariance, expected[1], rtol=0, atol=1e-13)
        np.testing.assert_array_equal(state.belief.mean, local.mean)
        np.testing.assert_array_equal(state.belief.covariance, local.covariance)


def test_it_does_not_see_the_present_measurement():
    item = prediction_of(filtered())
    estimates = [item.step(item.init(), z)[1].mean for z in ([0.0], [50.0])]
    np.testing.assert_array_equal(*estimates)
    states = [item.step(item.init(), z)[0].belief.mean for z in ([0.0], [50.0])]
    assert abs(states[0][0] - states[1][0]) > 1  # the next one does


def test_its_claim_is_the_filters_and_only_gaussian_filters_have_one():
    linear = hg.cubature_filter(PLANT, SENSOR, hg.perfect())
    assert (prediction_of(filtered()).claim, prediction_of(linear).claim) == ("nominal", "exact")
    with pytest.raises(ValueError, match="filter: expected a GaussianFilter, got OpenLoop"):
        prediction_of(hg.filters.open_loop_filter(PLANT))
