"""A sensor that repeats for longer than its noise allows is found live though nobody said when it is stuck."""

import json
import warnings

import numpy as np
import pytest

import heliograph as hg
from heliograph.live.fleet import Fleet
from heliograph.live.fleet_options import Options
from heliograph.live.network_step_program import NetworkProgram
from heliograph.serving import Service
from heliograph.serving.observation import watch_of
from heliograph.serving.storage import InMemoryStore
from tests.laws import LAWS

PLANT = hg.LinearPlant([[1.0]], 0.01, [0.0], 1.0)
SENSOR = hg.LinearSensor([[1.0]], 0.25, outputs=["v"])
DECLARED = hg.LinearSensor([[1.0]], 0.25, outputs=["v"], resolution=0.1)


def walk(steps=400, first=300):
    """Readings of a walk of deviation .1 to a tenth, all equal from the first on."""
    rng = np.random.default_rng(0)
    z = np.cumsum(0.1 * rng.standard_normal(steps)) + 0.5 * rng.standard_normal(steps)
    z = np.round(z / 0.1) * 0.1
    z[first:] = z[first]
    return z


def network(sensor=SENSOR, **options):
    return hg.Network(PLANT, {"a": hg.Node(sensor, hg.perfect(), {"k": hg.kalman_filter(PLANT, sensor)}, **options)})


def count_runs(sensor, z):
    """How many runs a stream finds among these readings."""
    stream = hg.Stream(hg.kalman_filter(PLANT, sensor))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for value in z:
            stream.push([value])
    return int(stream.held[0])


@pytest.mark.slow
@pytest.mark.parametrize("sensor", [SENSOR, DECLARED])
def test_a_stream_and_a_timeline_name_it_once_and_go_on(sensor):
    """A tenth of q is a fifth of s: p = .080 by the law, so that ten equal readings are one in 10^9; no claim falls."""
    z, item = walk(), hg.kalman_filter(PLANT, sensor)
    stream, line = hg.Stream(item), hg.Timeline(network(sensor), window=0.0)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for k in range(400):
            if k == 305:  # saved in the midst of the run, both go on
                stream = hg.Stream.restore(item, stream.save())
                line = hg.Timeline.restore(network(sensor), line.save())
            stream.push([z[k]])
            line.push("a", k, k, [z[k]])
    told = [str(warning.message) for warning in said]
    assert told == [
        f"{begin} is stuck, or has no noise: 10 equal readings in a row ({z[-1]:g}), of which its noise makes 10 less "
        "than once in 1,000,000,000 readings; stuck=10 refuses such"
        for begin in ("stream, step 309: received number 0", "timeline, a: v")
    ]
    assert line.held == {"a": 1} and stream.held.tolist() == [1] and not any(line.refused["a"].values())
    assert line.estimates()["a"]["k"].claim == "exact"


def test_who_refuses_what_is_stuck_is_not_watched_and_a_run_is_counted_once():
    z = walk()
    line = hg.Timeline(network(DECLARED, stuck=True), window=0.0)
    for k in range(330):
        line.push("a", k, k, [z[k]])
    assert line.held == {"a": 0} and line.refused["a"]["stuck"] > 0
    line = hg.Timeline(network(), window=0.0)
    with pytest.warns(UserWarning, match="a: v is stuck, or has no noise"):
        for k, value in enumerate(np.concatenate([z[:330], z[:100], z[300:330]])):
            line.push("a", k, k, [value])
    assert line.held == {"a": 2}


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_right_sensors_are_not_named(law):
    """Twelve recordings, four resolutions and three walks, of 1,500 readings: none, undeclared."""
    rng, (noise, draw) = np.random.default_rng(2), LAWS[law]
    sensor, named = hg.LinearSensor([[1.0]], noise), 0
    for q in (0.1, 1.0, 2.0, 4.0):
        for walks in (0.0, 0.01, 0.3):
            x = np.cumsum(walks * rng.standard_normal(1500)) + rng.uniform(-5, 5)
            named += count_runs(sensor, np.round((x + draw(rng, 1500)) / q) * q)
    assert named == 0


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("declared", [True, False])
def test_false_alarms_are_as_rare_as_stated(law, declared, monkeypatch):
    """By a larger rate: one in 200 readings; of 20,000 at the worst place, where p is largest, by four deviations.

    The law's bound is reached there by Gaussian noise, to the whole numbers of readings: the watch is not idle.
    """
    monkeypatch.setattr("heliograph.live.health.stuck_sensor_watch.SELDOM", 1 / 200)
    noise, draw = LAWS[law]
    rng, q, n = np.random.default_rng(3), 1.0, 20_000
    sensor = hg.LinearSensor([[1.0]], noise, **({"resolution": q} if declared else {}))
    alarms = count_runs(sensor, np.round(draw(rng, n) / q) * q)
    assert n / 200 / 20 < alarms < n / 200 + 4 * np.sqrt(n / 200)


def test_of_equal_readings_from_the_first_on_only_a_declared_resolution_tells():
    for sensor, found in ((SENSOR, 0), (DECLARED, 1)):
        line = hg.Timeline(network(sensor), window=0.0)
        with warnings.catch_warnings(record=True):
            warnings.simplefilter("always")
            for k in range(100):
                line.push("a", k, k, [1.5])
        assert line.held == {"a": found}


def test_a_service_says_it_once_and_its_page_and_metrics_name_each_plant():
    program, said = NetworkProgram(network()), []
    service = Service(Fleet(program, Options(window=0.0)), InMemoryStore(), said.append)
    watch = watch_of(program.network, "")
    watched = watch.wrap(service)
    for plant in ("p", "q"):
        bodies = [{"plant": plant, "node": "a", "sequence": k, "time": k, "values": [z]} for k, z in enumerate(walk())]
        watched.take([json.dumps(body).encode() for body in bodies])
    assert len(said) == 1 and said[0].startswith("warning: plant 'p', a: v is stuck, or has no noise: 100 equal")
    assert said[0].endswith("stuck=10 refuses such; not said again, nor of other plants")
    words = "a: 1 times equal for longer than its noise allows: it is stuck, or has no noise"
    assert watch.make_page_data("q")["warnings"][-1] == words and watch.links()["a"]["held"] == 2


def test_a_sensor_with_modes_is_not_watched():
    """One of its modes may be that it is stuck."""
    sensor = hg.markov_sensor([SENSOR, hg.LinearSensor([[0.0]], 4.0, outputs=["v"])], [[0.9, 0.1], [0.5, 0.5]])
    item = hg.filters.imm_filter(PLANT, sensor, hg.perfect())
    stream, line = (
        hg.Stream(item),
        hg.Timeline(hg.Network(PLANT, {"a": hg.Node(sensor, hg.perfect(), {"k": item})}), window=0.0),
    )
    for k in range(40):
        stream.push([0.5])
        line.push("a", k, k, [0.5])
    assert stream.held.tolist() == [0] and not line.held.get("a")
