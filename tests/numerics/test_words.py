"""Errors in words that say what to write."""

import math
import re

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.serving.message import read_message


def unpacking(x):
    position, speed = x
    return jnp.stack([position, speed])


SENSOR = hg.LinearSensor([[1.0]], 0.1)


def single(x):
    return x[0]


@pytest.mark.parametrize(
    ("make", "line"),
    [
        (
            lambda: hg.LinearSensor([1, 0, 0, 0], 1.0),
            "sensor matrix: expected shape (outputs, states), such as [[1, 0]], got shape (4,)",
        ),
        (
            lambda: hg.random_affine.Shaped(np.ones((2, 2, 2)), hg.Gaussian(np.eye(3))),
            "noise matrix: expected shape (rows, 3), got shape (2, 2, 2)",
        ),
        (
            lambda: hg.Contaminated(np.eye(2), 0.1, [[1.0]], 1.0),
            "covariance of the outliers: expected shape (2, 2), got shape (1, 1)",
        ),
        (lambda: hg.random_affine.Rician(1.0, 0.0), "Rician scale: expected a positive number, got 0"),
        (lambda: hg.hop(1.0, 0.1, power=-1.0), "hop power: expected a number of at least 0, got -1"),
        (lambda: hg.erasure(hg.perfect(), 2.0), "arrival probability: expected a number from 0 to 1, got 2"),
        (
            lambda: hg.adaptive_filter(hg.kalman_filter(hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), SENSOR), memory=0.0),
            "memory of an adaptive filter: expected a positive number up to 1, got 0",
        ),
    ],
)
def test_a_line_says_what_to_write(make, line):
    with pytest.raises(hg.InputError) as error:
        make()
    assert str(error.value) == line


@pytest.mark.parametrize(
    ("name", "offered"),
    [("UKF", "unscented_filter"), ("ekf", "extended_filter"), ("KF", "kalman_filter"), ("batch", "run"),
     ("KalmanFilter", "kalman_filter"), ("filter", "kalman_filter")],
)  # fmt: skip
def test_what_others_call_it_is_offered_by_its_name_here(name, offered):
    with pytest.raises(AttributeError, match=rf"no attribute '{name}'; closest: {offered}\b"):
        getattr(hg, name)


def test_a_sensor_in_numpy_is_said_to_be_in_jax():
    plant = hg.LinearPlant(np.eye(2), 0.1, [0.0, 0.0], 1.0)
    sensor = hg.Sensor(lambda x: np.array([np.sin(x[0])]), 0.1)
    with pytest.raises(ValueError, match=r"of length 2, got one that calls NumPy or math: write it with jax\.numpy$"):
        hg.cubature_filter(plant, sensor, hg.perfect())
    with pytest.raises(ValueError, match=r"got one that calls NumPy or math: write it with jax\.numpy$"):
        hg.Plant(lambda x, u: np.sin(x), 0.1, [0.0, 0.0], np.eye(2))


def plant_of(function):
    return lambda: hg.Plant(function, 0.1, [0.0, 0.0], np.eye(2))


def assigning(x, u):
    result = np.zeros(2)
    result[0] = x[0]
    return result


def assigning_in_place(x, u):
    x[0] = 0.0
    return x


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (plant_of(lambda x, u: [math.sin(x[0]), x[1]]), "one that calls NumPy or math: write it with jax.numpy"),
        (plant_of(assigning), "one that calls NumPy or math: write it with jax.numpy"),
        (plant_of(lambda x, u: x if x[0] > 0 else -x), "one that decides by a value: write jnp.where"),
        (
            plant_of(assigning_in_place),
            "one that assigns to a part of x: write jnp.stack, or x.at[i].set(value)",
        ),
    ],
)
def test_what_jax_cannot_trace_is_named_with_what_to_write(make, words):
    with pytest.raises(hg.InputError, match=re.escape(f"got {words}")):
        make()


def test_a_node_of_two_outputs_and_a_hop_of_one_is_refused():
    sensor = hg.LinearSensor([[1.0], [2.0]], 0.1)
    for link in (hg.hop(1.0, 0.1), hg.perfect()):
        line = "channel: expected one for the sensor's 2 outputs, such as perfect(2), got one that takes 1"
        with pytest.raises(ValueError, match=f"^{re.escape(line)}$"):
            hg.Node(sensor, link, {})


@pytest.mark.parametrize(
    "measure", [lambda x: x[:2], lambda x: jnp.stack([x[0], x[1]]), lambda x: np.ones((2, 3)) @ x, unpacking, single]
)
def test_a_sensor_of_one_variance_whose_function_gives_two_numbers_is_refused_where_it_is_made(measure):
    with pytest.raises(ValueError, match=r"measure of a sensor: expected one output.*outputs=.*, got shape \((2,)?\)$"):
        hg.Sensor(measure, 0.25)


@pytest.mark.parametrize(
    "measure", [lambda x: x, lambda x: x[:1], lambda x: x[::2], lambda x: x[-1:], np.ones((1, 3)).dot]
)
def test_a_sensor_of_one_variance_is_not_refused_for_a_state_that_nobody_named(measure):
    assert hg.Sensor(measure, 0.25).outputs == ("y0",)


def test_matrices_in_place_of_a_plant_are_answered_with_the_call_that_takes_them():
    with pytest.raises(
        ValueError, match=r"of matrices kalman_filter\(\*hg.state_space\(F, H, Q, R, mean, covariance\)\)"
    ):
        hg.kalman_filter(np.eye(2), np.eye(2), np.eye(2), np.eye(2))


@pytest.mark.parametrize(
    ("name", "offered"),
    [
        ("neess", "closest: nees"),
        ("kalmanfilter", "closest: kalman_filter"),
        ("KalmanFilter", "closest: kalman_filter"),
        ("monte_carl", "closest: monte_carlo"),
        ("late_filter", "closest: filters.late_filter"),
        ("kalman", "closest: kalman_filter"),
    ],
)
def test_a_name_that_does_not_exist_offers_near_ones(name, offered):
    with pytest.raises(AttributeError, match=f"^heliograph has no attribute '{name}'; {offered}"):
        getattr(hg, name)


def test_a_name_like_no_other_is_refused_without_an_offer():
    with pytest.raises(AttributeError, match=r"^heliograph has no attribute 'xyzzy'$"):
        hg.xyzzy  # noqa: B018
    with pytest.raises(AttributeError, match=r"^heliograph.filters has no attribute 'cubature'; closest: "):
        hg.filters.cubature  # noqa: B018
    assert not hasattr(hg, "_xyzzy")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("update", r"write filter.correct\(state, z\), or filter.step\(state, z, u\)"),
        ("filter", r"write filter.run\(z, u\)"),
        ("smooth", r"write hg.rts_smoother\(filter, z, u\)"),
        ("estimat", "closest: estimate"),
        ("gain", r"write hg.steady_state\(plant, sensor\).gain"),
    ],
)
def test_an_attribute_that_a_filter_has_elsewhere_is_answered_with_the_call_to_write(name, words):
    plant, sensor = hg.LinearPlant(np.eye(2), 0.1, [0.0, 0.0], 1.0), hg.LinearSensor([[1.0, 0.0]], 0.1)
    for item in (hg.kalman_filter(plant, sensor), hg.linear_filter(plant, sensor, hg.perfect())):
        with pytest.raises(AttributeError, match=f"{type(item).__name__} has no attribute '{name}'; {words}"):
            getattr(item, name)


def test_any_object_of_ours_answers_a_wrong_attribute_with_near_ones_or_the_function_to_call():
    plant, sensor = hg.LinearPlant(np.eye(2), 0.1, [0.0, 0.0], 1.0), hg.LinearSensor([[1.0, 0.0]], 0.1)
    filtered = hg.extended_filter(plant, sensor).run(np.zeros((3, 1)))  # no link: all arrives as it is
    node = hg.Node(sensor, hg.perfect(), {})
    for item, name, words in (
        (filtered, "mean", "closest: means"),
        (filtered, "P", "closest: covariances"),
        (filtered, "nis", "write hg.nis"),
        (hg.Stream(hg.kalman_filter(plant, sensor)), "update", "closest: push"),
        (hg.Network(plant, {"a": node}), "run", "write hg.run"),
        (sensor, "R", "closest: noise"),
    ):
        with pytest.raises(AttributeError, match=f"^{type(item).__name__} has no attribute '{name}'; {words}"):
            getattr(item, name)
    with pytest.raises(AttributeError, match=r"closest: heliograph\.CovarianceIntersection"):
        hg.fusion.CovarianceIntersection  # noqa: B018


@pytest.mark.parametrize(
    ("payload", "came"),
    [
        (b"no json", "b'no json', which is no JSON from byte 1 on"),
        (b"[1]", "[1], which is no object"),
        (b'{"node": "a"', "which is no JSON from byte 13 on"),
        (b"time,a", "no JSON from byte 1 on; `heliograph replay` sends the rows of a table as messages"),
        (b"\xff", "which is no JSON"),
    ],
)
def test_no_word_of_the_library_that_reads_messages_is_in_an_error(payload, came):
    with pytest.raises(
        hg.InputError, match=r"^message: expected a JSON object with no fields but .*" + re.escape(came) + "$"
    ):
        read_message(payload)
