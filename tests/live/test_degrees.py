"""A measured angle beyond a full turn is doubted live, once, and a model in degrees before any data."""

import json
import warnings

import numpy as np
import pytest

import heliograph as hg
from heliograph.serving import Fleet, InMemoryStore, NetworkProgram, Options, Service
from heliograph.simulation import doubts_before_data

SAID = "'compass', an angle in radians, is 42, beyond 2 pi: degrees\\?"


def turning(start=0.0, limits=None):
    """A heading, and beside a place the compass that measures it."""
    states = ["x", "heading"]
    plant = hg.LinearPlant(
        np.eye(2), 0.01 * np.eye(2), [0.0, start], 0.1 * np.eye(2), states=states, circular=["heading"]
    )
    sensor = hg.LinearSensor(np.eye(2), 0.1, outputs=["place", "compass"], circular=["compass"])
    node = hg.Node(sensor, hg.perfect(2), {"f": hg.kalman_filter(plant, sensor)}, limits=limits)
    return hg.Network(plant, {"a": node})


def test_a_stream_and_a_timeline_doubt_it_once():
    network = turning()
    stream, line = hg.Stream(network.nodes["a"].filters["f"]), hg.Timeline(network, 9)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        stream.push([50.0, 6.2])
        line.push("a", 0, 0, [50.0, np.nan])
    with pytest.warns(UserWarning, match=r"^stream, step 1: 'measurement\[1\]', an angle in radians, is 42"):
        stream.push([50.0, 42.0])
    with pytest.warns(UserWarning, match=f"^timeline, a: {SAID}"):
        line.push("a", 1, 1, [50.0, 42.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        stream.push([50.0, 43.0])
        line.push("a", 2, 2, [50.0, 43.0])


def test_a_service_says_it_once():
    said = []
    service = Service(Fleet(NetworkProgram(turning()), Options(0.0, 0.1)), InMemoryStore(), said.append)
    for k in range(3):
        message = {"plant": "p", "node": "a", "sequence": k, "time": k, "values": [0.0, 42.0]}
        service.take([json.dumps(message).encode()])
    (line,) = [line for line in said if "degrees" in line]
    assert line.startswith("warning: plant 'p', a: 'compass', an angle in radians, is 42")


def test_what_only_a_central_filter_hears_is_doubted():
    bare = turning()
    node = bare.nodes["a"]
    central = hg.kalman_filter(bare.plant, node.sensor)
    line = hg.Timeline(hg.Network(bare.plant, {"a": hg.Node(node.sensor, node.channel, {})}, {"all": central}), 9)
    with pytest.warns(UserWarning, match="^timeline, fused: 'a: compass', an angle in radians, is 42"):
        line.push("a", 0, 0, [50.0, 42.0])


@pytest.mark.parametrize(
    ("network", "expected"),
    [
        (turning(), []),
        (
            turning(start=90.0),
            ["the initial mean of 'heading'", "what a sensor measures at the initial mean of 'compass'"],
        ),
        (turning(limits=[(None, None), (0, 360)]), ["a limit at node 'a' of 'compass'"]),
        (turning(limits=[(0, 1000), (-np.pi, np.pi)]), []),
    ],
)
def test_a_model_in_degrees_is_doubted_before_data(network, expected):
    said = [doubt.words for doubt in doubts_before_data(network) if doubt.words.startswith("degrees: ")]
    assert [line.split(", an angle")[0].removeprefix("degrees: ") for line in said] == expected
