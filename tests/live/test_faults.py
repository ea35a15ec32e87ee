"""A timeline and a service name the function of the model that returned no number, as a stream and a recording do."""

import json
import re

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.serving import Fleet, InMemoryStore, NetworkProgram, Options, Service


def network(by_time):
    """A plant whose motion is no number beyond 2, and a sensor that sees it."""
    move = (
        (lambda x, u: jnp.sqrt(2.0 - x) - jnp.sqrt(2.0) + u[0])
        if by_time
        else (lambda x, u: jnp.sqrt(2.0 - x) - jnp.sqrt(2.0))
    )
    plant = hg.Plant(move, [[0.01]], [0.0], [[0.01]], inputs=["dt"] if by_time else [])
    sensor = hg.LinearSensor([[1.0]], 0.01)
    return hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"f": hg.extended_filter(plant, sensor)})})


def test_a_timeline_names_the_function():
    line = hg.Timeline(network(False), 0)
    assert line.push("a", 0, 0, [5.0]) == "used" and line.reasons == {}
    assert line.push("a", 1, 1, [0.1]) == "implausible"
    assert line.reasons["a"].startswith("the prediction to its time is no finite number")
    assert "; transition(x, u) returned [nan] for x = [2." in line.reasons["a"]


def test_in_continuous_time_it_names_what_the_function_was_given():
    with pytest.warns(UserWarning, match="predictions depend on when others are asked for"):
        line = hg.Timeline(network(True), 0)
    assert line.push("a", 0, 0.5, [6.0]) == "used"
    assert line.push("a", 1, 0.75, [0.1]) == "implausible"
    assert "transition(x, u) returned [nan] for x = [" in line.reasons["a"]
    assert line.reasons["a"].endswith("u = [0.25]")


def test_limits_say_why():
    plant, sensor = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1, outputs=["height"])
    node = hg.Node(sensor, hg.perfect(), {"f": hg.kalman_filter(plant, sensor)}, limits=(0, 10))
    line = hg.Timeline(hg.Network(plant, {"a": node}), 0)
    assert line.push("a", 0, 0, [20.0]) == "implausible"
    assert "height" in line.reasons["a"]


def test_a_service_names_it_in_the_refusal():
    service = Service(Fleet(NetworkProgram(network(False)), Options(0.0, 0.1)), InMemoryStore())
    for k, value in enumerate((5.0, 0.1)):
        message = {"plant": "p", "node": "a", "sequence": k, "time": k, "values": [value]}
        outputs = service.take([json.dumps(message).encode()])
    (refused,) = [item for item in (json.loads(output.body) for output in outputs) if item["kind"] == "refused"]
    assert "; transition(x, u) returned [nan] for x = [2." in refused["detail"]


@pytest.fixture
def turning():
    """Without measurements the variance of a heading grows by 0.5 a step; a Gaussian may have 1 rad at most."""
    plant = hg.LinearPlant([[1.0]], [[0.5]], [0.0], [[0.1]], states=["heading"], circular=["heading"])
    sensor = hg.LinearSensor([[1.0]], 0.01, circular=["y0"])
    return hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"f": hg.kalman_filter(plant, sensor)})})


SAID = r"'heading' is known to \+- 1 rad; on the circle"


def test_an_angle_that_becomes_too_wide_is_said_once(turning):
    stream, line = hg.Stream(turning.nodes["a"].filters["f"]), hg.Timeline(turning, 9)
    stream.push([np.nan])
    with pytest.warns(UserWarning, match=f"^stream, step 1: {SAID}"):
        stream.push([np.nan])
    stream.push([np.nan])
    line.push("a", 0, 0, [np.nan])
    with pytest.warns(UserWarning, match=f"^timeline, a/f: {SAID}"):
        line.push("a", 1, 1, [np.nan])
    line.push("a", 2, 2, [np.nan])


@pytest.mark.slow
def test_a_service_says_it_once(turning):
    said = []
    service = Service(Fleet(NetworkProgram(turning), Options(0.0, 0.1)), InMemoryStore(), said.append)
    for k in range(4):
        batch = [{"plant": p, "node": "a", "sequence": k, "time": k, "values": [None]} for p in ("first", "second")]
        service.take([json.dumps(message).encode() for message in batch])
    assert len(said) == 1 and re.search(f"^warning: plant 'first', a/f: {SAID}", said[0])
