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
