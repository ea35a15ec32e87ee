"""Models of motion against what is known of them: stationary laws, circles, and each other."""

import jax
import numpy as np
import pytest

import heliograph as hg


def test_names_of_states():
    assert hg.models.constant_velocity(1.0).states == ("position", "velocity")
    assert hg.models.constant_acceleration(1.0, axes=["x", "y"]).states == (
        "x", "x_velocity", "x_acceleration", "y", "y_velocity", "y_acceleration",
    )  # fmt: skip
    assert hg.models.constant_velocity(1.0).inputs == ("dt",) and hg.models.constant_velocity(1.0, 1.0).inputs == ()


def test_processes_are_stationary():
    """P = F P F' + Q of the law at the start."""
    plant = hg.models.gauss_markov(2.0, 5.0, dt=0.7, states=["wind", "drift"])
    p = plant.initial_covariance
    np.testing.assert_allclose(plant.matrix @ p @ plant.matrix.T + plant.noise.covariance, p, rtol=1e-14)
    assert abs(plant.matrix[0, 0] - np.exp(-0.7 / 5)) < 1e-15
    singer = hg.models.singer(2.0, 5.0, dt=0.7)
    a = singer.matrix[2, 2]
    assert abs(a**2 * 4 + singer.noise.covariance[2, 2] - 4) < 1e-14


def test_singer_goes_to_constant_acceleration():
    """T to infinity at a given intensity 2 s^2 / T: off by dt / T."""
    far = hg.models.singer(np.sqrt(0.1 * 1e9 / 2), 1e9, dt=0.5)
    near = hg.models.constant_acceleration(0.1, dt=0.5)
    np.testing.assert_allclose(far.matrix, near.matrix, atol=1e-8)
    np.testing.assert_allclose(far.noise.covariance, near.noise.covariance, atol=1e-8)


def test_a_turn_of_unknown_rate_is_that_of_known_rate():
    plant = hg.models.coordinated_turn(0.1, 0.01, [0, 1, 0, 0, 0.3], 0.1, dt=0.5)
    with jax.enable_x64(True):
        transition, slopes = jax.jit(plant.transition), jax.jit(jax.jacfwd(plant.transition))
        for rate in (0.3, -2.0, 1e-5, 0.0):
            known = hg.models.known_turn(0.1, rate, dt=0.5)
            x = np.array([1.0, 2.0, 3.0, 4.0, rate])
            np.testing.assert_allclose(transition(x, np.zeros(0))[:4], known.matrix @ x[:4], atol=1e-12)
            assert np.isfinite(slopes(x, np.zeros(0))).all()  # also at a rate of zero
        noise = np.asarray(plant.noise_covariance(np.zeros(0)))
    # It is that of constant velocity on each axis.
    np.testing.assert_allclose(noise[:2, :2], hg.models.constant_velocity(0.1, 0.5).noise.covariance, rtol=1e-6)
    assert abs(noise[4, 4] - 0.005) < 1e-9


def test_vehicles_drive_circles():
    """A unicycle at speed 1 and rate .2 for 10: (sin 2, 1 - cos 2) / .2; a bicycle of that curvature goes along."""
    unicycle = hg.models.unicycle(0.01, [0, 0, 0], 0.1)
    bicycle = hg.models.bicycle(2.5, 0.01, [0, 0, 0], 0.1)
    assert unicycle.inputs == ("speed", "turn_rate", "dt") and bicycle.inputs == ("speed", "steering", "dt")
    assert unicycle.circular == ("heading",)
    with jax.enable_x64(True):
        x, y = np.zeros(3), np.zeros(3)
        for dt in np.full(4, 2.5):
            x = np.asarray(unicycle.transition(x, np.array([1.0, 0.2, dt])))
            y = np.asarray(bicycle.transition(y, np.array([1.0, np.arctan(0.5), dt])))
    right = [np.sin(2.0) / 0.2, (1 - np.cos(2.0)) / 0.2, 2.0]
    np.testing.assert_allclose(x, right, atol=1e-14)
    np.testing.assert_allclose(y, right, atol=1e-14)


def test_a_unicycle_is_filtered():
    """The last of 60 steps in 200 runs: NEES of three states is 3 within four standard errors, sqrt(2 / 600) each."""
    unicycle = hg.models.unicycle(np.diag([0.01, 0.01, 0.001]), [0, 0, 0.5], np.diag([1, 1, 0.1]), dt=0.5)
    sensor = hg.LinearSensor([[1, 0, 0], [0, 1, 0]], 0.05)
    filters = {"f": hg.extended_filter(unicycle, sensor)}
    network = hg.Network(unicycle, {"gps": hg.Node(sensor, hg.perfect(2), filters)})
    runs = hg.monte_carlo(network, 60, 200, 1, inputs=np.tile([1.0, 0.2], (60, 1)))
    estimate = runs.estimates["gps"]["f"]
    nees = hg.nees(runs.truth[:, -1], estimate.mean[:, -1], estimate.covariance[:, -1], unicycle)
    assert abs(np.mean(nees) / 3 - 1) < 4 * np.sqrt(2 / 600)


@pytest.mark.parametrize("make", [hg.models.unicycle, lambda *law: hg.models.bicycle(1.0, *law)])
def test_vehicles_refuse_what_is_no_covariance(make):
    with pytest.raises(hg.InputError, match="noise intensity"):
        make(-1.0, [0, 0, 0], 0.1)
