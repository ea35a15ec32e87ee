"""A column of time steps beside the times of its rows."""

import warnings

import numpy as np
import pytest

import heliograph as h
from heliograph.files import read_recording


@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_steps_of_a_table_from_which_rows_were_taken_are_doubted(unit):
    """The times say that 4.1 s have passed where dt says 0.1: the column is of the table before. Times may be in ms."""
    drift = h.LinearPlant([[1.0]], 0.1, [0.0], 1.0, [[0.0]], inputs=["dt"])
    sensor = h.LinearSensor([[1.0]], 0.1, outputs=["y"])
    net = h.Network(drift, {"a": h.Node(sensor, h.perfect(), {"k": h.kalman_filter(drift, sensor)})})
    time = np.arange(100)[np.r_[:30, 70:100]] * 0.1 * unit
    data = {"time": time, "y": np.zeros(60), "dt": np.full(60, 0.1)}
    with pytest.warns(UserWarning, match=r"row 31, column 'dt': 0.1, where 4.1 has passed .* so in 1 of 59 rows"):
        np.testing.assert_array_equal(read_recording(data, net, "data.csv").inputs[:, 0], 0.1)
    # Stamps that jitter by a fifth of a step, and a count of rows in place of times, are no reason.
    jitter = np.random.default_rng(0).uniform(-0.02, 0.02, 60) * unit
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_recording(data | {"time": np.arange(60) * 0.1 * unit + jitter}, net, "data.csv")
        read_recording(data | {"time": np.arange(60.0), "dt": np.geomspace(0.1, 9, 60)}, net, "data.csv")
