"""Plants as bytes, also as they were written before."""

import json

import numpy as np
import pytest

import heliograph as hg
from heliograph.live.stored import pack_snapshot, unpack_snapshot
from heliograph.live.stored.plant_codec import HEAD

SENSOR = hg.LinearSensor([[1.0]], 0.5)
PLANT = hg.LinearPlant([[1.0]], 0.1, [0.0], 1.0)


@pytest.fixture(scope="module")
def network():
    node = hg.Node(SENSOR, hg.perfect(), {"k": hg.kalman_filter(PLANT, SENSOR)})
    return hg.Network(PLANT, {"a": node, "b": node})


def written_before(data):
    """A saved timeline as versions before 0.3.0 wrote it: the leap is a list.

    Its time, the newest arrival before it, and of each node's count then the first, the newest, its time, what was lost
    and the newest time.
    """
    head, arrays = unpack_snapshot(data)
    plant = arrays["plant"].tobytes()
    length, *counts = HEAD.unpack_from(plant)
    of_plant = json.loads(plant[HEAD.size : HEAD.size + length])
    leap = of_plant["leap"]
    nodes = {node: [0, 9, at, 0, latest] for node, (at, latest) in leap["moments"].items()}
    text = json.dumps(of_plant | {"leap": [leap["time"], leap["now"], nodes]}).encode()
    again = HEAD.pack(len(text), *counts) + text + plant[HEAD.size + length :]
    return pack_snapshot(head, arrays | {"plant": np.frombuffer(again, np.uint8)})


@pytest.mark.parametrize("time", [6, 10**9 + 1], ids=["taken back", "confirmed"])
def test_a_leap_that_was_written_as_a_list_is_taken_back_or_confirmed(network, time):
    """The next event, of the other node, says which; the estimates are those of a timeline that was never saved."""
    line = hg.Timeline(network, window=3)
    for k in range(5):
        line.push("a", k, k, [0.1 * k])
        line.push("b", k, k, [0.1 * k])
    assert line.push("a", 5, 10**9, [0.5]) == "used"
    again = hg.Timeline.restore(network, written_before(line.save()))
    for one in (line, again):
        assert one.push("b", 5, time, [0.5]) == "used"
    assert again.now == line.now == time and again.counts == line.counts
    assert again.counts["a"]["future"] == (time == 6)
    for node in "ab":
        one, other = line.estimates()[node]["k"], again.estimates()[node]["k"]
        np.testing.assert_array_equal(one.mean, other.mean)
        np.testing.assert_array_equal(one.covariance, other.covariance)
    np.testing.assert_array_equal(line.final().time, again.final().time)
