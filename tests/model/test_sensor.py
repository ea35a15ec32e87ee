"""What a sensor measures fits the state, and a linear one shows it by its matrix."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.model.sensor import check_sensor


def test_a_linear_sensor_shows_its_shape_without_a_trace(monkeypatch):
    """Of a thousand nodes each would be traced by itself."""
    monkeypatch.setattr(jax, "eval_shape", None)
    check_sensor(hg.LinearSensor(np.ones((3, 2)), 1.0), 2)
    with pytest.raises(ValueError, match=r"measure a state of length 4.* a matrix of shape \(3, 2\)"):
        check_sensor(hg.LinearSensor(np.ones((3, 2)), 1.0), 4)


@pytest.mark.parametrize(
    ("measure", "message"),
    [
        (lambda x: jnp.stack([x[0], x[1], x[0]]), r"2 outputs \['y0', 'y1'\].*shape \(3,\)"),
        (lambda x: jnp.ones((2, 5)) @ x, "measure a state of length 2"),
    ],
)
def test_a_function_must_measure_what_its_noise_disturbs(measure, message):
    with pytest.raises(ValueError, match=message):
        check_sensor(hg.Sensor(measure, np.eye(2)), 2)
