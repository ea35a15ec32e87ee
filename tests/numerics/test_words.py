"""Errors in words that say what to write."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.numerics.check import InputError, array, scalar

TINY = np.finfo(float).tiny


@pytest.mark.parametrize(
    ("make", "line"),
    [
        (
            lambda: hg.LinearSensor([1, 0, 0, 0], 1.0),
            "sensor matrix: expected shape (outputs, states), such as [[1, 0]], got shape (4,)",
        ),
        (lambda: array("table", np.ones((2, 2, 2)), (None, 3)), "table: expected shape (any, 3), got shape (2, 2, 2)"),
        (lambda: array("list", [[1.0]], (2,)), "list: expected shape (2), got shape (1, 1)"),
        (lambda: hg.random_affine.Rician(1.0, 0.0), "Rician scale: expected a positive number, got 0"),
        (lambda: scalar("x", -1.0, 0.0), "x: expected a number of at least 0, got -1"),
        (lambda: scalar("x", 2.0, -np.inf, 1.0), "x: expected a number of at most 1, got 2"),
        (lambda: scalar("x", 2.0, 0.0, 1.0), "x: expected a number from 0 to 1, got 2"),
    ],
)
def test_a_line_says_what_to_write(make, line):
    with pytest.raises(InputError) as error:
        make()
    assert str(error.value) == line


def test_a_sensor_in_numpy_is_told_to_be_in_jax():
    plant = hg.LinearPlant(np.eye(2), 0.1, [0.0, 0.0], 1.0)
    sensor = hg.Sensor(lambda x: np.array([np.sin(x[0])]), 0.1)
    with pytest.raises(ValueError, match=r"of length 2, got one that calls NumPy: write it with jax\.numpy$"):
        hg.cubature_filter(plant, sensor, hg.perfect())
    with pytest.raises(ValueError, match=r"got one that calls NumPy: write it with jax\.numpy$"):
        hg.Plant(lambda x, u: np.sin(x), 0.1, [0.0, 0.0], np.eye(2))


def test_a_node_of_two_outputs_and_a_hop_of_one_is_refused():
    sensor = hg.LinearSensor([[1.0], [2.0]], 0.1)
    with pytest.raises(ValueError, match="channel: expected one that takes the sensor's 2 outputs, got 1 inputs"):
        hg.Node(sensor, hg.hop(1.0, 0.1), {})
