"""A service says what silence of senders that decide means: silent for good, not final yet, or dead."""

import json

import pytest
from heliograph.serving.storage.in_memory_store import InMemoryStore

import heliograph as hg
from heliograph.serving.fleet import Fleet, Options
from heliograph.serving.lanes import Lanes
from heliograph.serving.output import Estimates
from heliograph.serving.service import Service

PLANT, SENSOR, LINK = hg.LinearPlant([[0.98]], 0.04, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.01), hg.perfect()


@pytest.mark.slow
def test_a_silent_sender_is_reported_and_one_that_misses_its_heartbeat_is_dead():
    trigger = hg.SendOnDelta(0.6, heartbeat=5)
    item = hg.event_filter(PLANT, SENSOR, LINK, trigger)
    deciding, plain = hg.Node(SENSOR, LINK, {"f": item}, trigger=trigger), {"f": hg.kalman_filter(PLANT, SENSOR)}
    network = hg.Network(PLANT, {"a": deciding, "b": hg.Node(SENSOR, LINK, plain)})
    service = Service(Fleet(Lanes(network), Options(window=2.0)), InMemoryStore())

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
