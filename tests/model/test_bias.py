"""Biases of a sensor as states: moments by hand, one model for a step that is a number and one that is an input."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg

DT, DEVIATION, TIME = 0.1, 0.5, 10.0
MOVE, NOISE = np.array([[1.0, DT], [0.0, 1.0]]), np.diag([0.01, 0.1])


def linear():
    plant = hg.LinearPlant(MOVE, NOISE, [0.0, 1.0], np.eye(2), states=["x", "v"])
    return plant, hg.LinearSensor([[1.0, 0.0], [0.0, 1.0]], np.eye(2), outputs=["radar", "speed"])


def test_a_bias_keeps_its_deviation_and_is_forgotten_in_its_time():
    plant, sensor = hg.model.with_bias(*linear(), [DEVIATION, 0.2], [TIME, np.inf], dt=DT)
    assert plant.states == ("x", "v", "radar_bias", "speed_bias")
    decay = np.exp(-DT / TIME)
    np.testing.assert_allclose(np.diag(plant.matrix), [1.0, 1.0, decay, 1.0])
    np.testing.assert_allclose(np.diag(plant.noise.covariance)[2:], [(1 - decay**2) * DEVIATION**2, 0.0], atol=1e-15)
    np.testing.assert_allclose(np.diag(plant.initial_covariance)[2:], [DEVIATION**2, 0.04])
    np.testing.assert_array_equal(sensor.matrix, np.hstack([np.eye(2), np.eye(2)]))


def test_steps_of_an_input_and_nonlinear_parts_give_the_same_filter():
    """Of one model in two ways: equal to rounding, which the factors of 20 updates enlarge little."""
    move = hg.Plant(
        lambda x, u: jnp.array([x[0] + u[0] * x[1], x[1]]), NOISE, [0.0, 1.0], np.eye(2), ["x", "v"], ["dt"]
    )
    seen = hg.Sensor(lambda x: x[:2], np.eye(2), outputs=["radar", "speed"])
    loading = [[1.0], [2.0]]
    biased = hg.model.with_bias(move, seen, DEVIATION, TIME, "dt", loading=loading)
    other = hg.model.with_bias(*linear(), DEVIATION, TIME, DT, loading=loading)
    assert biased[0].states == other[0].states == ("x", "v", "bias0")
    z = np.random.default_rng(0).normal(size=(20, 2))
    by_number = hg.kalman_filter(*other).run(z)
    # A linear plant whose matrix depends on the input stays one: its Kalman filter is exact.
    varying = hg.LinearPlant(
        lambda u: jnp.array([[1.0, u[0]], [0.0, 1.0]]), lambda u: jnp.asarray(NOISE), [0.0, 1.0], np.eye(2),
        states=["x", "v"], inputs=["dt"],
    )  # fmt: skip
    exact = hg.kalman_filter(*hg.model.with_bias(varying, linear()[1], DEVIATION, TIME, "dt", loading=loading))
    assert exact.claim == "exact"
    for by_input in (hg.extended_filter(*biased, hg.perfect(2)), exact):
        result = by_input.run(z, np.full((20, 1), DT))
        np.testing.assert_allclose(result.means, by_number.means, atol=1e-12)
        np.testing.assert_allclose(result.covariances, by_number.covariances, atol=1e-12)


@pytest.mark.parametrize(("change", "message"), [
    ({"bias": -1.0}, "deviation of a bias: expected a number of at least 0, got -1"),
    ({"time": 0.0}, "time of a bias: expected a positive number, got 0"),
    ({"dt": "t"}, "dt: expected a number, or one of the inputs"),
    ({"bias": [1.0, 2.0, 3.0]}, "deviation of a bias: expected one, or one for each of 2, got 3"),
])  # fmt: skip
def test_what_is_no_bias_is_refused_in_one_line(change, message):
    with pytest.raises(ValueError, match=message):
        hg.model.with_bias(*linear(), **({"bias": 1.0} | change))
