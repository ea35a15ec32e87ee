"""Relays in the plane: ways and errors against the paths they stand for, and the bound of all sites."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from heliograph.numerics.check import InputError
from heliograph.planning import split_power
from heliograph.planning.paths.model import path_information
from heliograph.report.figures import png
from heliograph_studies.network_design.theory import Radio, RelayScene, choose_relays, relay_line, relay_map, site_map
from tests.planning.example import NOISES, PLANT, ROWS

POWER = 100.0
SENSORS = np.stack([np.linspace(0.0, 1.0, 6), [0.1, 1.9, 0.7, 2.6, 1.2, 0.4]], axis=1)
SCENE = RelayScene(*PLANT, ROWS, NOISES, SENSORS, [4.0, 1.5], Radio(3.0, 1.0, 1.02))
LINE = RelayScene([[0.9]], [[0.3]], [[1.0]], [0.1], [[0.0, 0.0]], [1.0, 0.0], Radio(3.0, nearest=1e-3))


def test_the_error_is_that_of_the_paths_that_are_taken():
    """Each path's power is split between its hops; the error comes from SciPy's Riccati solver."""
    sites = [[2.2, 1.5], [2.5, 0.8]]
    paths, taken = SCENE.paths(sites, POWER), SCENE.ways(sites, POWER)[1]
    assert set(taken) >= {0, 1}
    powers = np.concatenate([split_power(alpha, POWER / 6) for alpha in paths.alpha.reshape(6, 2)])
    noise = 1 / path_information(paths, powers[None]).information[0]
    a, q = PLANT
    predicted = solve_discrete_are(a.T, ROWS.T, q, np.diag(noise))
    after = np.linalg.inv(np.linalg.inv(predicted) + ROWS.T @ (ROWS / noise[:, None]))
    assert SCENE.error(sites, POWER) == pytest.approx(np.trace(after), rel=1e-10)


@pytest.mark.parametrize("power", [1.0, 0.2])
def test_one_sensor_has_its_relay_on_the_line(power):
    result = relay_map(LINE, power, np.linspace(0, 1, 11), np.linspace(-0.3, 0.3, 3), starts=2)
    site = relay_line(1 / power, 3.0).sites[0]
    assert min(abs(result.sites[0, 0] - site), abs(1 - result.sites[0, 0] - site)) < 1e-4  # flat at the minimum
    assert abs(result.sites[0, 1]) < 1e-4
    assert result.bound <= result.error <= result.bound * (1 + 1e-7)


def test_relays_only_help_and_never_more_than_the_bound_allows():
    item = relay_map(SCENE, POWER, np.linspace(0, 4, 9), np.linspace(0, 3, 7))
    two = relay_map(SCENE, POWER, np.linspace(0, 4, 9), np.linspace(0, 3, 7), relays=2, starts=1)
    assert item.bound == two.bound < two.error < item.error <= item.errors.min() < item.direct
    assert item.errors.shape == (7, 9) and np.all(item.errors <= item.direct)
    draws = np.random.default_rng(0).uniform([0, 0], [4, 3], (50, 3, 2))
    assert min(SCENE.error(sites, POWER) for sites in draws) > item.bound
    assert SCENE.error(np.zeros((0, 2)), POWER) == pytest.approx(item.direct, rel=1e-14)
    assert "no sites can be better" in item.words


def test_relays_are_chosen_among_sites():
    sites = np.random.default_rng(1).uniform([1, 0], [4, 3], (6, 2))
    result, searched = choose_relays(SCENE, POWER, sites, 2), choose_relays(SCENE, POWER, sites, 2, compared=0)
    errors = [SCENE.error(sites[[i, k]], POWER) for i in range(6) for k in range(i)]
    assert result.error == min(errors) and result.exact and not searched.exact
    assert result.bound == SCENE.error(sites, POWER) < result.error <= searched.error
    with pytest.raises(InputError, match="relays to choose: expected at most the 6 sites there are, got 7"):
        choose_relays(SCENE, POWER, sites, 7)


def test_the_map_is_drawn():
    result = relay_map(LINE, 0.2, np.linspace(0, 1, 5), np.linspace(-0.3, 0.3, 3), starts=1)
    figure = site_map(result)
    labels = figure.axes[0].get_legend_handles_labels()[1]
    assert labels == ["sensors", "receiver", "relay"] and "without" in figure.axes[0].get_title(loc="left")
    assert png(figure).startswith(b"\x89PNG")


def test_what_cannot_be_is_refused():
    with pytest.raises(InputError, match="nearest of a radio: expected a positive number"):
        Radio(3.0, nearest=0.0)
    with pytest.raises(InputError, match="kappa of a radio: expected a number of at least 1"):
        Radio(3.0, kappa=0.9)
    with pytest.raises(InputError, match="sensors of a scene: expected shape"):
        RelayScene([[0.9]], [[0.3]], [[1.0]], [0.1], [[0.0, 0.0, 0.0]], [1.0, 0.0], Radio(3.0))
    with pytest.raises(InputError, match="steady power: expected a stable plant"):
        RelayScene([[1.1]], [[0.3]], [[1.0]], [0.1], [[0.0, 0.0]], [1.0, 0.0], Radio(3.0))
    with pytest.raises(InputError, match="grid of a map: expected at least one site"):
        relay_map(LINE, 1.0, [], [0.0])
