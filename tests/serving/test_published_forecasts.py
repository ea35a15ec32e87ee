"""Forecasts beside provisional estimates: those of a timeline, by the clock of the messages."""

import json
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

import heliograph as hg
from heliograph.numerics import horizons_in
from heliograph.serving import Fleet, InMemoryStore, NetworkProgram, Options, Service, parse_threshold
from heliograph.serving.observation import watch_of
from heliograph.serving.output import Estimates
from heliograph.serving.settings import ServiceSettings
from tests.serving.watched import metrics_of

BEGUN = datetime(2026, 11, 25, 12, 0, 0, tzinfo=UTC)


def network():
    plant = hg.LinearPlant([[0.9]], 0.5, [0.0], 2.0, states=["x"])
    sensor = hg.LinearSensor([[2.0]], 0.3, outputs=["y"])
    return hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(1), {"f": hg.kalman_filter(plant, sensor)})})


@pytest.fixture(scope="module")
def program():
    return NetworkProgram(network())


def service(program, forecast, *thresholds):
    fleet, levels = Fleet(program, Options(window=5.0, step=2.0)), tuple(map(parse_threshold, thresholds))
    return Service(fleet, InMemoryStore(), forecast=horizons_in(forecast), thresholds=levels)


def message(k, value, plant="p"):
    time = (BEGUN + timedelta(seconds=2 * k)).isoformat()
    return json.dumps({"plant": plant, "node": "a", "sequence": k, "time": time, "values": [value]}).encode()


def test_a_service_publishes_what_a_timeline_forecasts(program):
    served, timeline = service(program, "2s,1min"), hg.Timeline(network(), 5.0)
    for k, value in enumerate((1.0, -0.5, 0.7)):
        *_, output = served.take([message(k, value)])
        timeline.push("a", k, k, [value])
    told = json.loads(output.body)
    assert Estimates.model_validate(told).forecast[1].time == (BEGUN + timedelta(seconds=64)).isoformat()
    expected = hg.forecast(timeline, [1, 30])["a"]["f"]
    for i, horizon in enumerate(told["forecast"]):
        found = horizon["estimates"]["a"]["f"]
        np.testing.assert_allclose(found["mean"], expected.states.mean[i], rtol=1e-12)
        np.testing.assert_allclose(found["covariance"], expected.states.covariance[i], rtol=1e-12)
        assert found["outputs"]["y"]["deviation"] == pytest.approx(expected.outputs.deviation[i, 0], rel=1e-12)


def test_plants_of_a_batch_are_forecast_as_each_alone(program):
    """Side by side, with their levels; each of its own row."""
    told = {"p": (0, 1.0), "q": (3, -2.0), "r": (1, 0.2)}
    together = service(program, "2s,1min", "x>1.5").take([message(*row, plant) for plant, row in told.items()])
    alone = [service(program, "2s,1min", "x>1.5").take([message(*row, plant)]) for plant, row in told.items()]
    bodies = {output.plant: output.body for output in together if output.kind == "provisional"}
    assert bodies == {
        output.plant: output.body for outputs in alone for output in outputs if output.kind == "provisional"
    }


def test_horizons_of_whole_steps_are_taken_where_no_binary_number_is_one(program):
    """0.3 s are three steps of 0.1 s, though 0.3 % 0.1 is 0.09999 in floating point."""
    fleet = Fleet(program, Options(window=5.0, step=0.1))
    *_, output = Service(fleet, InMemoryStore(), forecast=horizons_in("300ms,700ms")).take([message(0, 1.0)])
    assert [horizon["ahead"] for horizon in json.loads(output.body)["forecast"]] == pytest.approx([0.3, 0.7], rel=1e-12)


@pytest.mark.parametrize("text", ["3s", "2026-12-01", "4s,2s", "0s", "1.5"])
def test_horizons_that_a_service_cannot_keep_are_refused(program, text):
    with pytest.raises(ValueError, match="--forecast: expected"):
        service(program, text)


def test_the_probability_to_pass_a_level_is_published_and_a_metric(program):
    """Of a state above and an output below, as from a timeline; every step between horizons is looked at."""
    served, timeline = service(program, "2s,20s", "x>1.5", "y<-1"), hg.Timeline(network(), 5.0)
    watch = watch_of(network(), "")
    *_, output = watch.wrap(served).take([message(0, 0.4)])
    timeline.push("a", 0, 0, [0.4])
    told = [h["estimates"]["a"]["f"]["thresholds"] for h in json.loads(output.body)["forecast"]]
    assert Estimates.model_validate_json(output.body).forecast[1].ahead == 20
    for level, name, limit, above in (("x>1.5", "x", 1.5, True), ("y<-1", "y", -1.0, False)):
        expected = hg.forecasting.crossing(timeline, name, limit, 10, above, draws=2000)
        for said, row in zip(told, (0, 9), strict=True):
            found = said[level]
            assert (found["then"], found["by"]) == (expected.beyond[row], expected.by[row])
            assert found["by_error"] == pytest.approx(expected.by_error[row])
    # The exact probability one step ahead, from the claim of the forecast; within four errors of the drawing.
    exact = 1 - hg.forecast(timeline, 1)["a"]["f"].states.below(1.5)[0, 0]
    assert abs(told[0]["x>1.5"]["then"] - exact) < 4 * told[0]["x>1.5"]["by_error"]
    text = metrics_of(watch)
    assert f'{{ahead="20",filter="f",node="a",plant="p",threshold="x>1.5"}} {told[1]["x>1.5"]["by"]}' in text


def test_levels_that_a_service_cannot_keep_are_refused(program):
    with pytest.raises(ValueError, match="--threshold: expected a state or output: x, y, got 'z'"):
        service(program, "2s", "z>1")
    for typed in ("x", "x>", "x>high", ">3", "x=3"):
        with pytest.raises(ValueError, match="--threshold: expected a state or output and its level"):
            parse_threshold(typed)
    with pytest.raises(ValueError, match="--threshold: expected how far ahead"):
        ServiceSettings(network(), Options(), thresholds=(parse_threshold("x > -1e3"),))
    first = network().plant
    modes = hg.markov_plant([first, hg.LinearPlant([[0.5]], 2.0, [0.0], 2.0, states=["x"])], [[0.9, 0.1], [0.2, 0.8]])
    sensor = hg.LinearSensor([[2.0]], 0.3, outputs=["y"])
    imm = hg.filters.imm_filter(modes, sensor, hg.perfect(1))
    several = NetworkProgram(hg.Network(modes, {"a": hg.Node(sensor, hg.perfect(1), {"f": imm})}))
    with pytest.raises(ValueError, match="--threshold: expected a plant of one law of motion"):
        service(several, "2s", "x>1")
