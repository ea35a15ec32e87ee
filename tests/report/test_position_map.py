"""Map of two states that are a position: the estimated paths, claimed ellipses along them, and the true path."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.report import examine, run_figures

STEPS = 30


def figures_of(states, truth=True):
    """Figures of a recording of four states, and its record; a place of which the two axes err together.

    `truth`: whether it is known, or what is known of it.
    """
    move = np.block([[np.eye(2), np.eye(2)], [np.zeros((2, 2)), np.eye(2)]])
    plant = hg.LinearPlant(move, 0.1 * np.eye(4), np.zeros(4), np.eye(4), states=states)
    sensor = hg.LinearSensor(np.eye(2, 4), [[1.0, 0.6], [0.6, 0.5]])
    item = hg.kalman_filter(plant, sensor)
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(2), {"k": item})})
    drawn = hg.simulate(network, STEPS, 0)
    known = truth if isinstance(truth, np.ndarray) else drawn.truth if truth else None
    record = hg.run(network, drawn.measurements, truth=known)
    return run_figures(examine(network, record, np.zeros((STEPS, 0)))), record


@pytest.mark.parametrize(
    ("states", "places"),
    [
        (["x", "y", "vx", "vy"], (0, 1)),
        pytest.param(["north", "east", "v", "w"], (1, 0), marks=pytest.mark.slow),
        pytest.param(["Lat", "Lon", "v", "w"], (1, 0), marks=pytest.mark.slow),
        pytest.param(["pos_x (m)", "pos_y (m)", "v", "w"], (0, 1), marks=pytest.mark.slow),
    ],
)
def test_paths_and_ellipses_are_those_of_the_estimates(states, places):
    figures, record = figures_of(states)
    (axes,) = figures["map"].axes
    estimate, places = record.estimates["a"]["k"], list(places)
    paths = {line.get_label(): line.get_xydata() for line in axes.lines}
    np.testing.assert_array_equal(paths["k"], np.asarray(estimate.mean)[:, places])
    np.testing.assert_array_equal(paths["truth"], np.asarray(record.truth)[:, places])
    assert axes.get_aspect() == 1.0
    # The last ellipse: two claimed deviations, (p - m)' P^-1 (p - m) = 4 all around.
    ellipse = axes.patches[-1]
    off = ellipse.get_patch_transform().transform([[np.cos(t), np.sin(t)] for t in np.linspace(0, 6, 9)])
    off = off - np.asarray(estimate.mean)[-1, places]
    P = np.asarray(estimate.covariance)[-1][np.ix_(places, places)]
    np.testing.assert_allclose(np.einsum("ki,ij,kj->k", off, np.linalg.inv(P), off), 4.0, rtol=1e-9)


def test_a_map_has_no_true_path_where_one_of_its_states_is_never_known():
    truth = np.random.default_rng(0).normal(size=(STEPS, 4))
    truth[:, 1] = np.nan
    figures, _ = figures_of(["x", "y", "vx", "vy"], truth)
    assert [line.get_label() for line in figures["map"].axes[0].lines] == ["k"]


@pytest.mark.slow
@pytest.mark.parametrize("states", [["x", "vx", "z", "vz"], ["level", "rate", "y", "w"]])
def test_states_that_are_no_position_have_no_map(states):
    assert "map" not in figures_of(states, truth=False)[0]
