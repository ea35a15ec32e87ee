"""What a sensor measures fits the state, and a linear one shows it by its matrix."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg


def test_a_linear_sensor_shows_its_shape_without_a_trace(monkeypatch):
    """Of a thousand nodes each would be traced by itself."""
    nodes = {"a": hg.Node(hg.LinearSensor(np.ones((3, 2)), 1.0), hg.perfect(3), {})}
    plants = {n: hg.LinearPlant(np.eye(n), 0.1, np.zeros(n), 1.0) for n in (2, 4)}
    monkeypatch.setattr(jax, "eval_shape", None)
    hg.Network(plants[2], nodes)
    with pytest.raises(ValueError, match=r"measure a state of length 4.* a matrix of shape \(3, 2\)"):
        hg.Network(plants[4], nodes)


@pytest.mark.parametrize(
    ("measure", "message"),
    [
        (lambda x: jnp.stack([x[0], x[1], x[0]]), r"2 outputs \['y0', 'y1'\].*shape \(3,\)"),
        (lambda x: jnp.ones((2, 5)) @ x, "measure a state of length 2"),
    ],
)
def test_a_function_must_measure_what_its_noise_disturbs(measure, message):
    with pytest.raises(ValueError, match=message):
        nodes = {"a": hg.Node(hg.Sensor(measure, np.eye(2)), hg.perfect(2), {})}
        hg.Network(hg.LinearPlant(np.eye(2), 0.1, np.zeros(2), 1.0), nodes)


@pytest.mark.parametrize(("make", "thing", "got"), [
    (lambda: hg.Sensor(lambda x, u: x[:1] * u[0], 0.1, ["y"]), "measure of a sensor", r"one of \(x, u\)"),
    (lambda: hg.Sensor(lambda: 1.0, 0.1), "measure of a sensor", r"one of \(\)"),
    (lambda: hg.Sensor(lambda x: x[:1], lambda u: u[0], ["y"]), "sensor noise", "a function"),
    (lambda: hg.LinearSensor(lambda u: [[u[0]]], 0.1), "sensor matrix", "a function"),
    (lambda: hg.LinearSensor([[1.0]], lambda u: [[u[0]]]), "sensor noise", "a function"),
])  # fmt: skip
def test_a_sensor_of_inputs_needs_their_names_and_says_so_when_it_is_made(make, thing, got):
    with pytest.raises(ValueError, match=rf"^{thing}: expected .*, or inputs=\[\.\.\.\], the names of .*, got {got}$"):
        make()


def test_what_takes_more_by_default_is_a_function_of_the_state():
    for measure in (lambda x, place=2.0: x[:1] - place, lambda *parts: parts[0][:1], jnp.sin):
        hg.Sensor(measure, 0.1, ["y"])
