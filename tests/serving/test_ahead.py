"""Forecasts beside provisional estimates: those of a timeline, by the clock of the messages."""

import json
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

import heliograph as hg
from heliograph.numerics.times.dates import horizons_in
from heliograph.serving import Fleet, InMemoryStore, NetworkProgram, Options, Service
from heliograph.serving.output import Estimates

BEGUN = datetime(2026, 11, 25, 12, 0, 0, tzinfo=UTC)


def network():
    plant = hg.LinearPlant([[0.9]], 0.5, [0.0], 2.0, states=["x"])
    sensor = hg.LinearSensor([[2.0]], 0.3, outputs=["y"])
    return hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(1), {"f": hg.kalman_filter(plant, sensor)})})


@pytest.fixture(scope="module")
def program():
    return NetworkProgram(network())


def service(program, forecast):
    return Service(Fleet(program, Options(window=5.0, step=2.0)), InMemoryStore(), forecast=horizons_in(forecast))


def test_a_service_publishes_what_a_timeline_forecasts(program):
    served, timeline = service(program, "2s,1min"), hg.Timeline(network(), 5.0)
    for k, value in enumerate((1.0, -0.5, 0.7)):
        time = (BEGUN + timedelta(seconds=2 * k)).isoformat()
        body = {"plant": "p", "node": "a", "sequence": k, "time": time, "values": [value]}
        *_, output = served.take([json.dumps(body).encode()])
        timeline.push("a", k, k, [value])
    told = json.loads(output.body)
    assert Estimates.model_validate(told).forecast[1].time == (BEGUN + timedelta(seconds=64)).isoformat()
    expected = hg.forecast(timeline, [1, 30])["a"]["f"]
    for i, horizon in enumerate(told["forecast"]):
        found = horizon["estimates"]["a"]["f"]
        np.testing.assert_allclose(found["mean"], expected.states.mean[i], rtol=1e-12)
        np.testing.assert_allclose(found["covariance"], expected.states.covariance[i], rtol=1e-12)
        assert found["outputs"]["y"]["deviation"] == pytest.approx(expected.outputs.deviation[i, 0], rel=1e-12)


@pytest.mark.parametrize("text", ["3s", "2026-12-01", "4s,2s", "0s"])
def test_horizons_that_a_service_cannot_keep_are_refused(program, text):
    with pytest.raises(ValueError, match="--forecast: expected"):
        service(program, text)
