"""A sensor that is silent for longer than its timeout is named and counted, and no estimate depends on it."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.report import examine

PLANT = hg.LinearPlant([[0.98]], 0.04, [0.0], 1.0)
MOVING = hg.LinearPlant(lambda u: [[1.0]], lambda u: [[0.1 * u[0]]], [0.0], [[1.0]], inputs=["dt"])


def network(plant=PLANT, **timeouts):
    sensor = hg.LinearSensor(np.eye(1, len(plant.states)), 0.01)
    filters = {"f": hg.kalman_filter(plant, sensor)}
    nodes = {name: hg.Node(sensor, hg.perfect(), filters, timeout=timeouts.get(name)) for name in "ab"}
    return hg.Network(plant, nodes)


def test_a_timeline_names_who_is_silent_for_longer_than_its_timeout():
    line = hg.Timeline(network(a=5), window=2)
    line.push("b", 0, 0.0, [0.1])
    assert not line.senders()["a"].dead and list(line.senders()) == ["a"]
    line.push("b", 1, 5.0, [0.1])
    assert not line.senders()["a"].dead  # five steps since the plant began, and not longer than five
    line.push("b", 2, 6.0, [0.1])
    status = line.senders()["a"]
    assert status.dead and status.last is None and status.silent + status.provisional == 6
    assert status.reason == "nothing came for 6 steps, and its timeout is 5 steps"
    line.push("a", 0, 6.0, [0.1])
    assert not line.senders()["a"].dead and line.timeouts == {"a": 1, "b": 0}
    for k in (10, 16):
        line.push("a", k, float(k), [0.1])
    assert line.timeouts["a"] == 2  # of the silences of 4 and of 6 steps the second


def test_time_may_be_continuous_and_may_begin_below_zero():
    line = hg.Timeline(network(MOVING, a=1.5), window=1, start=-10.0)
    line.push("b", 0, -8.6, [0.1])
    assert not line.senders()["a"].dead
    line.push("b", 1, -8.4, [0.1])
    assert line.senders()["a"].dead and line.senders()["a"].reason.startswith("nothing came for 1.6,")
    line.push("a", 0, -8.3, [0.1])
    line.push("a", 1, -7.0, [0.1])
    status = line.senders()["a"]
    assert (status.last, status.dead, line.timeouts["a"]) == (-7.0, False, 1)
    line.advance(-5.4)
    assert line.senders()["a"].dead and line.senders()["a"].silent == pytest.approx(0.6)  # of 1.6, one is not final


def test_a_timeout_changes_no_estimate_and_no_claim_and_is_saved():
    plain, watched = hg.Timeline(network(), window=2), hg.Timeline(network(a=3), window=2)
    for k in (0, 1, 9):
        for line in (plain, watched):
            line.push("a", k, float(k), [0.1 * k])
    one, other = plain.estimates()["a"]["f"], watched.estimates()["a"]["f"]
    assert np.array_equal(one.mean, other.mean) and one.claim == other.claim
    again = hg.Timeline.restore(network(a=3), watched.save())
    again.advance(13)
    watched.advance(13)
    assert again.senders() == watched.senders() and again.timeouts == watched.timeouts == {"a": 1, "b": 0}
    hg.Timeline.restore(network(a=4), watched.save())  # another timeout is the same network
    with pytest.raises(ValueError, match="senders: expected a node with a trigger or a timeout"):
        plain.senders()


@pytest.mark.parametrize("timeout", [0.0, -1.0, np.nan, np.inf, "soon", True])
def test_a_timeout_is_a_positive_number(timeout):
    with pytest.raises((ValueError, TypeError), match="timeout: expected"):
        network(a=timeout)


def test_a_recording_names_silences_with_their_rows():
    z = np.full((30, 1), 0.1)
    z[4:8], z[12:25] = np.nan, np.nan
    said = "node 'a': nothing came for 14 steps, and its timeout is 4 steps: 2 times, the longest after row 12$"
    with pytest.warns(UserWarning, match=said):
        record = hg.run(network(a=4), {"a": z, "b": np.full((30, 1), 0.1)})
    health = examine(network(a=4), record)
    assert [line for line in health.warnings() if "timeout" in line] == [
        "a: nothing came for 14 steps, and its timeout is 4 steps: 2 times, the longest after row 12"
    ]


def test_silence_at_the_ends_of_a_recording_counts_and_time_may_be_continuous():
    z = {"a": np.full((5, 1), np.nan), "b": np.zeros((5, 1))}
    z["a"][2] = 0.0
    dt = np.array([[0.0], [1.0], [1.0], [0.5], [0.5]])
    with pytest.warns(UserWarning, match="node 'a': nothing came for 2, and its timeout is 1.5: after row 1$"):
        hg.run(network(MOVING, a=1.5), z, dt)
