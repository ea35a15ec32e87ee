"""A gate that gives in says so live: a timeline warns, a service has a line and a count, each time and once."""

import json
import re
import warnings

import numpy as np
import pytest

import heliograph as hg
from heliograph.serving import Fleet, InMemoryStore, NetworkProgram, Options, Service
from heliograph.serving.observation import watch_of
from tests.serving.watched import metrics_of

SAID = r"a/gate: the gate gave in once, last in row 3, and moved place by \d"


@pytest.fixture(scope="module")
def network():
    """A place near 0, of which a gate hears 100 m more: refused twice, believed in the third row."""
    plant = hg.LinearPlant([[1.0]], [[0.01]], [0.0], [[1.0]], states=["place"], limits={"place": (-500, None)})
    sensor = hg.LinearSensor([[1.0]], 1.0)
    gate = hg.robust_filter(plant, sensor, hg.perfect(), hg.filters.Gate(9.0, after=3))
    return hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"gate": gate})})


def test_a_timeline_warns_in_the_row_where_it_does(network):
    line = hg.Timeline(network, 9)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for k in range(2):
            line.push("a", k, k, [100.0])
    with pytest.warns(UserWarning, match=f"^timeline, {SAID}"):
        line.push("a", 2, 2, [100.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        line.push("a", 3, 3, [100.0])
        again = hg.Timeline.restore(network, line.save())
        again.push("a", 4, 4, [100.0])
    assert abs(again.estimates()["a"]["gate"].mean[0] - 100) < 1


def test_a_late_event_by_which_rows_are_made_anew_is_not_said_again(network):
    """Of rows 0, 1, 2 the one between comes last: with it three are refused in a row."""
    line = hg.Timeline(network, 9)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        line.push("a", 0, 0, [100.0])
        line.push("a", 2, 2, [100.0])
    with pytest.warns(UserWarning, match=f"^timeline, {SAID}"):
        line.push("a", 1, 1, [100.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        line.push("a", 3, 3, [100.0])


def test_a_recording_and_a_stream_say_it_of_a_gate_behind_limits(network):
    z = np.full((4, 1), 100.0)
    with pytest.warns(UserWarning, match=SAID):
        hg.run(network, {"a": z})
    stream = hg.Stream(network.nodes["a"].filters["gate"])
    with pytest.warns(UserWarning, match="stream, the gate gave in once, last in row 3"):
        for row in z:
            stream.push(row)


def test_a_service_logs_and_counts_it_by_plant(network):
    said, store = [], InMemoryStore()
    service = Service(Fleet(NetworkProgram(network), Options(0.0, 0.1)), store, said.append)
    assert service.remarks() == {("a", "gate"): 0}

    def take(service, k):
        batch = [{"plant": p, "node": "a", "sequence": k, "time": k, "values": [100.0]} for p in ("first", "second")]
        service.take([json.dumps(message).encode() for message in batch])

    for k in range(5):
        take(service, k)
        assert service.remarks()["a", "gate"] == (2 if k >= 2 else 0)
    watch = watch_of(network, "places")
    watch.wrap(service)
    assert 'heliograph_gave_in_total{filter="gate",node="a"} 2.0' in metrics_of(watch)
    assert [re.match(f"warning: plant '(.*)', {SAID}", line)[1] for line in said] == ["first", "second"]


def test_where_warnings_are_errors_what_was_taken_counts(network):
    line, stream = hg.Timeline(network, 9), hg.Stream(network.nodes["a"].filters["gate"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for k in range(2):
            line.push("a", k, k, [100.0])
            stream.push([100.0])
        with pytest.raises(UserWarning, match=SAID):
            line.push("a", 2, 2, [100.0])
        with pytest.raises(UserWarning, match=r"^stream, the gate gave in once"):
            stream.push([100.0])
        assert line.counts["a"]["used"] == 3 and stream.steps == 3
        assert line.push("a", 2, 2, [100.0]) == "duplicate"
        np.testing.assert_array_equal(stream.push([100.0]).mean, _after_four(network))


def _after_four(network):
    """Mean after four readings, of a stream whose warnings are no errors."""
    stream = hg.Stream(network.nodes["a"].filters["gate"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return [stream.push([100.0]).mean for _ in range(4)][-1]
