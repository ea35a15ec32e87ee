"""Paths and first times against a random walk's and the forecast's own numbers."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.forecasting import crossing, draw_paths

DRAWS = 20_000


def walk():
    """A random walk that is known at its start: x_h is N(0, h)."""
    return hg.state_space([[1.0]], [[1.0]], 1.0, 0.25, [0.0], 0.0)


def test_paths_have_the_moments_of_the_forecast():
    plant, sensor = hg.state_space([[0.9, 0.3], [0, 0.8]], [[1.0, 0.0]], np.diag([0.1, 0.5]), 0.2, [1, 2], np.eye(2))
    found = hg.kalman_filter(plant, sensor).run([[0.5], [0.1]])
    ahead, paths = hg.forecast(found, 4), draw_paths(found, 4, draws=DRAWS)
    # Five standard errors of means and covariances.
    spread = ahead.states.deviation[:, :, None] * ahead.states.deviation[:, None]
    covariance = np.stack([np.cov(x.T) for x in np.moveaxis(paths.x, 1, 0)])
    assert np.all(np.abs(paths.x.mean(axis=0) - ahead.states.mean) < 5 * ahead.states.deviation / np.sqrt(DRAWS))
    assert np.all(np.abs(covariance - ahead.states.covariance) < 5 * np.sqrt(2 / DRAWS) * spread)
    assert np.all(np.abs(paths.y.std(axis=0) / ahead.outputs.deviation - 1) < 5 / np.sqrt(2 * DRAWS))


def test_probabilities_of_a_random_walk():
    """P(x_h > c) of the normal law; P(max > 0) of a symmetric walk by Sparre Andersen: 1 - C(2 h, h) / 4^h."""
    plant, sensor = walk()
    stream = hg.Stream(hg.kalman_filter(plant, sensor))  # nothing has arrived
    found = crossing(stream, "x0", 0.0, 6, draws=DRAWS)
    never = np.array([1 / 2, 3 / 8, 5 / 16, 35 / 128, 63 / 256, 231 / 1024])
    assert np.all(np.abs(found.by - (1 - never)) < 4 * found.by_error)
    assert np.all(np.abs(found.beyond - 0.5) < 4 * found.beyond_error)
    assert found.beyond_error[0] == pytest.approx(np.sqrt(0.25 / DRAWS), rel=1e-3)
    assert found.first.sum() + found.never == pytest.approx(1)
    assert found.quantile(0.6) == 2  # by 1/2 after one step, 5/8 after two
    assert found.quantile(0.9) == np.inf
    below = crossing(stream, "y0", -1.0, [2], above=False, draws=DRAWS)
    expected = hg.forecast(stream, 2).outputs.below(-1.0)[1, 0]
    assert abs(below.beyond[0] - expected) < 4 * below.beyond_error[0]


LAWS = (0.9, 0.1), (1.1, 1.0)  # x+ = a x + w, w of variance q, in either mode
CHAIN = np.array([[0.9, 0.1], [0.3, 0.7]])


def switching(make, initial=(0.6, 0.4)):
    """A plant of two laws, and a sensor of which a chain of its own has one that is stuck at noise."""
    plant = hg.markov_plant([hg.LinearPlant([[a]], q, [0.5], 0.01) for a, q in LAWS], CHAIN, initial=initial)
    works, stuck = hg.LinearSensor([[1.0]], 0.1), hg.LinearSensor([[0.0]], 4.0)
    return make(plant, hg.markov_sensor([works, stuck], [[0.8, 0.2], [0.5, 0.5]], initial=[1.0, 0.0]), hg.perfect())


@pytest.mark.parametrize("make", [hg.filters.imm_filter, hg.filters.gpb2_filter])
def test_paths_of_a_plant_with_modes_are_those_of_all_mode_paths(make):
    """P(x_2 > 1.5) and moments of y_2 after three rows: the belief by mode, moved along all paths of two modes."""
    stream = hg.Stream(switching(make))
    for z in (1.0, 0.7, -0.4):
        stream.push([z])
    now = hg.forecast(stream, 1)  # its parts say which modes the belief has
    paths, found = draw_paths(stream, 2, draws=DRAWS), crossing(stream, "x0", 1.5, [2], draws=DRAWS)
    two = hg.forecast(stream, 2)
    deviation = two.states.deviation[1, 0]
    # A mixture of Gaussians merged at one step beside all paths of it: equal moments, five standard errors.
    assert abs(paths.x[:, 1, 0].mean() - two.states.mean[1, 0]) < 5 * deviation / np.sqrt(DRAWS)
    kurtosis = np.mean((paths.x[:, 1, 0] - paths.x[:, 1, 0].mean()) ** 4) / paths.x[:, 1, 0].var() ** 2
    assert abs(paths.x[:, 1, 0].var() / deviation**2 - 1) < 5 * np.sqrt((kurtosis - 1) / DRAWS)
    assert abs(paths.y[:, 1, 0].std() / two.outputs.deviation[1, 0] - 1) < 5 * np.sqrt(kurtosis / DRAWS) / 2
    assert abs(np.mean(paths.x[:, 0, 0] > 1.0) - (1 - now.states.below(1.0)[0, 0])) < 5 * np.sqrt(0.25 / DRAWS)
    assert found.beyond[0] == np.mean(paths.x[:, 1, 0] > 1.5)


def test_before_the_first_row_the_first_mode_is_that_of_the_start():
    """The chain does not move before the first step: x_1 of mode 1 has mean 1.1 * .5 and variance 1.1^2 * .01 + 1."""
    stream = hg.Stream(switching(hg.filters.imm_filter, (0.0, 1.0)))
    paths = draw_paths(stream, 1, draws=DRAWS)
    assert abs(paths.x.mean() - 0.55) < 5 * np.sqrt(1.0121 / DRAWS)
    assert abs(paths.x.var() / 1.0121 - 1) < 5 * np.sqrt(2 / DRAWS)


def test_a_filter_without_probabilities_of_modes_draws_no_paths():
    stream = hg.Stream(switching(hg.linear_filter))
    with pytest.raises(ValueError, match="paths of a plant or sensor with modes: expected a filter that has the modes"):
        draw_paths(stream, 1)


def test_a_network_says_which_filter():
    plant, sensor = walk()
    filters = {"one": hg.kalman_filter(plant, sensor), "two": hg.cubature_filter(plant, sensor)}
    found = hg.run(hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(1), filters)}), {"a": [1.0, 2.0]})
    assert crossing(found, "x0", 1.0, 2, draws=100, filter="one").draws == 100
    with pytest.raises(ValueError, match="node and filter: expected one of a/one, a/two, got none"):
        crossing(found, "x0", 1.0, 2)


@pytest.mark.parametrize(
    ("name", "level", "said"),
    [("level", 1.0, "threshold: expected a state or output: x0, y0, got 'level'"), ("x0", np.nan, "level")],
)
def test_what_is_no_threshold_is_refused(name, level, said):
    plant, sensor = walk()
    with pytest.raises(ValueError, match=said):
        crossing(hg.kalman_filter(plant, sensor).run([[1.0]]), name, level, 3)


def test_noise_of_a_sensor_does_not_depend_on_the_mode():
    """x_2 / x_1 is 1 or 2 by the mode, each with probability 1/2: y_2 - x_2 has the mean 0 in both, to five errors."""
    plant = hg.markov_plant([hg.LinearPlant([[a]], 1e-12, [1.0], 1e-12) for a in (1.0, 2.0)], np.full((2, 2), 0.5))
    stream = hg.Stream(hg.filters.imm_filter(plant, hg.LinearSensor([[1.0]], 1.0), hg.perfect()))
    paths = draw_paths(stream, 2, draws=DRAWS)
    noise, second = (paths.y - paths.x)[:, 1, 0], paths.x[:, 1, 0] / paths.x[:, 0, 0] > 1.5
    assert abs(second.mean() - 0.5) < 5 * np.sqrt(0.25 / DRAWS)
    assert abs(noise[second].mean() - noise[~second].mean()) < 5 * np.sqrt(4 / DRAWS)
