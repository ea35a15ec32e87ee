"""A service says what silence of senders that decide means: silent for good, not final yet, or dead."""

import json
from datetime import UTC, datetime, timedelta

import pytest

import heliograph as hg
from heliograph.live.fleet import Fleet
from heliograph.live.fleet_options import Options
from heliograph.live.network_step_program import NetworkProgram
from heliograph.serving.output import Estimates
from heliograph.serving.service import Service
from heliograph.serving.storage import InMemoryStore

PLANT, SENSOR, LINK = hg.LinearPlant([[0.98]], 0.04, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.01), hg.perfect()


@pytest.mark.slow
def test_a_silent_sender_is_reported_and_one_that_misses_its_heartbeat_is_dead():
    trigger = hg.SendOnDelta(0.6, heartbeat=5)
    item = hg.event_filter(PLANT, SENSOR, LINK, trigger)
    deciding, plain = hg.Node(SENSOR, LINK, {"f": item}, trigger=trigger), {"f": hg.kalman_filter(PLANT, SENSOR)}
    network = hg.Network(PLANT, {"a": deciding, "b": hg.Node(SENSOR, LINK, plain)})
    service = Service(Fleet(NetworkProgram(network), Options(window=2.0)), InMemoryStore())

    def status(node, time):
        message = {"plant": "p", "node": node, "sequence": time, "time": time, "values": [0.2]}
        outputs = [json.loads(output.body) for output in service.take([json.dumps(message).encode()])]
        assert all("senders" not in output for output in outputs if output["kind"] == "final")
        newest = Estimates.model_validate(next(output for output in outputs if output["kind"] == "provisional"))
        assert set(newest.senders) == {"a"}
        return newest.senders["a"]

    assert (status("b", 0).last, status("a", 0).last) == (None, 0)
    quiet = status("b", 5)
    assert (quiet.silent, quiet.provisional) == (2, 3)  # steps 1, 2; 3, 4, 5 are not final
    later = status("b", 8)
    assert (later.silent, later.missed, later.chance, later.dead) == (5, 1, 0.0, True)
    assert service.dead_senders() == {"a": 1}
    assert not status("a", 9).dead and service.dead_senders() == {"a": 0}


@pytest.mark.slow
def test_dates_are_steps_and_a_sender_that_falls_silent_is_dead_once_the_clock_says_so(monkeypatch):
    """Steps of half a second from the first message on; no other message has to come for its silence to be used."""
    trigger = hg.SendOnDelta(0.6, heartbeat=5)
    item = hg.event_filter(PLANT, SENSOR, LINK, trigger)
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, LINK, {"f": item}, trigger=trigger)})
    service = Service(Fleet(NetworkProgram(network), Options(window=2.0, step=0.5)), InMemoryStore())
    begun = datetime(2026, 11, 25, 12, 0, 0, tzinfo=UTC)

    def taken(payloads):
        return [json.loads(output.body) for output in service.take(payloads)]

    def at(seconds, value):
        time = (begun + timedelta(seconds=seconds)).isoformat()
        return json.dumps({"node": "a", "sequence": 0, "time": time, "values": [value]}).encode()

    class Clock(datetime):
        seconds = 0.0

        @classmethod
        def now(cls, zone):
            return begun + timedelta(seconds=cls.seconds)

    monkeypatch.setattr("heliograph.serving.service.datetime", Clock)
    first, second = taken([at(0.0, 0.2)])[-1], taken([at(0.9, 1.2)])[-1]
    assert first["time"] == begun.isoformat() and second["time"] == (begun + timedelta(seconds=1)).isoformat()
    assert second["senders"]["a"]["last"] == 2
    # Not yet another step; then six steps of silence, of which the last two are not final.
    Clock.seconds = 1.4
    assert taken([]) == []
    Clock.seconds = 4.0
    quiet = taken([])[-1]
    assert (quiet["kind"], quiet["time"]) == ("provisional", (begun + timedelta(seconds=4)).isoformat())
    assert [quiet["senders"]["a"][name] for name in ("silent", "provisional", "dead")] == [3, 3, False]
    # What silence says, as a timeline that is given the same steps says it.
    line = hg.Timeline(network, window=2.0)
    line.push("a", 0, 0, [0.2])
    line.push("a", 0, 2, [1.2])
    line.advance(8)
    expected, result = line.estimates()["a"]["f"], quiet["estimates"]["a"]["f"]
    assert result["mean"] == pytest.approx(expected.mean, rel=1e-9)  # compiled apart
    assert result["covariance"][0] == pytest.approx(expected.covariance[0], rel=1e-9)
    Clock.seconds = 6.0
    late = taken([])[-1]
    assert late["senders"]["a"]["missed"] == 1 and late["senders"]["a"]["dead"] and service.dead_senders() == {"a": 1}
    assert not taken([at(6.1, 1.0)])[-1]["senders"]["a"]["dead"]
