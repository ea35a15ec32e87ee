"""Plants side by side: each moves as alone, names, inputs, units and angles stay, and a filter of both is exact."""

import jax
import numpy as np
import pytest

import heliograph as hg

m = hg.models


def test_joined_plants_move_as_alone():
    """A vehicle with inputs and dt, a wander with dt, and a constant: linear ones, and with one that is not."""
    cart = m.constant_velocity(0.1, axes={"track": "m"})
    wind = m.gauss_markov(2.0, 5.0, states=["wind"])
    still = hg.LinearPlant([[0.9]], 0.5, [1.0], 2.0, [[0.3]], ["still"], ["push"])
    whole = m.join([cart, wind, still])
    assert isinstance(whole, hg.LinearPlant)
    assert whole.states == ("track", "track_velocity", "wind", "still") and whole.inputs == ("dt", "push")
    assert whole.states[0].unit == "m"
    turning = m.join([cart, m.unicycle(0.1, [0, 0, 0], 0.1)])
    assert turning.circular == ("heading",) and turning.inputs == ("dt", "speed", "turn_rate")
    with jax.enable_x64(True):
        u, x = np.array([0.7, 2.0]), np.array([1.0, 2.0, 3.0, 4.0])
        apart = [cart.transition(x[:2], u[:1]), wind.transition(x[2:3], u[:1]), still.transition(x[3:], u[1:])]
        np.testing.assert_allclose(whole.transition(x, u), np.concatenate(apart), atol=1e-14)
        spread = np.asarray(whole.noise_covariance(u))
        np.testing.assert_allclose(spread[:2, :2], cart.noise_covariance(u[:1]), atol=1e-15)
        assert spread[3, 3] == 0.5 and spread[2, 3] == 0
        moved = turning.transition(np.zeros(5), np.array([1.0, 2.0, 0.0]))
    np.testing.assert_allclose(moved, [0, 0, 2, 0, 0], atol=1e-15)
    np.testing.assert_allclose(whole.initial_mean, [0, 0, 0, 1])


def test_a_filter_of_both_is_two_filters():
    """Independent plants, each with its own sensor: log-likelihoods add up."""
    first, second = m.gauss_markov(2.0, 5.0, states=["a"]), m.gauss_markov(1.0, 2.0, states=["b"])
    rng = np.random.default_rng(0)
    z, dt = rng.normal(size=(40, 2)), rng.exponential(1.0, (40, 1))
    both = hg.kalman_filter(m.join([first, second]), hg.LinearSensor(np.eye(2), 0.3)).run(z, dt)
    alone = [hg.kalman_filter(p, hg.LinearSensor([[1.0]], 0.3)).run(z[:, i], dt) for i, p in enumerate((first, second))]
    assert both.claim == "exact"
    assert abs(both.log_likelihood - sum(one.log_likelihood for one in alone)) < 1e-11


def test_what_cannot_be_joined_is_refused():
    with pytest.raises(hg.InputError, match=r"states of joined plants: expected each name once .* got \['position', "):
        m.join([m.constant_velocity(1.0), m.constant_velocity(1.0)])
    with pytest.raises(hg.InputError, match="plant to join: expected a plant that does not vary"):
        m.join([3])
