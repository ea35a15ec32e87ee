"""What a timeline says of senders that decide: silent, not final yet, or dead."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.live.health.sender_status import LossChain

PLANT, SENSOR = hg.LinearPlant([[0.98]], 0.04, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.01)
LOSSY = hg.erasure(hg.perfect(), 0.8)


def network(channel=LOSSY, heartbeat=5):
    trigger = hg.SendOnDelta(0.6, heartbeat=heartbeat)
    item = hg.event_filter(PLANT, SENSOR, channel, trigger)
    return hg.Network(PLANT, {"a": hg.Node(SENSOR, channel, {"f": item}, trigger=trigger)})


def test_steps_are_silent_once_the_watermark_has_passed_them():
    line = hg.Timeline(network(), window=3)
    line.push("a", 0, 0.0, [0.2])
    line.advance(6)
    status = line.senders()["a"]
    assert status.last == 0 and status.silent == 2 and status.provisional == 4  # steps 1, 2; 3 to 6
    assert status.missed == 0 and not status.dead
    before = line.estimates()["a"]["f"]
    assert line.push("a", 1, 4.0, [1.1], arrival=6.0) == "used"  # late, and all steps from 4 on are made anew
    assert line.senders()["a"].last == 4 and line.senders()["a"].silent == 0 and line.senders()["a"].provisional == 2
    assert abs(line.estimates()["a"]["f"].mean[0] - before.mean[0]) > 0.3


def test_the_timeline_is_the_filter_on_all_steps_with_their_silences():
    line, rows = hg.Timeline(network(), window=0), [0.2, np.nan, np.nan, 1.0, np.nan, np.nan]
    for k, value in enumerate(rows):
        if not np.isnan(value):
            line.push("a", k, float(k), [value])
    line.advance(len(rows) - 1)
    stream = hg.Stream(network().nodes["a"].filters["f"])
    for value in rows:
        last = stream.push([value])
    result = line.estimates()["a"]["f"]
    np.testing.assert_allclose(result.mean, last.mean, rtol=1e-12)
    np.testing.assert_allclose(result.covariance, last.covariance, rtol=1e-12)


def test_a_sender_that_misses_its_heartbeat_is_dead_not_constant():
    line = hg.Timeline(network(hg.perfect()), window=0)
    line.push("a", 0, 0.0, [0.2])
    line.advance(5)  # step 5, at which it was due, is not final before time has passed it
    assert not line.senders()["a"].dead
    line.advance(6)
    assert line.senders()["a"].missed == 1 and line.senders()["a"].dead
    lossy = hg.Timeline(network(), window=0)
    lossy.push("a", 0, 0.0, [0.2])
    lossy.advance(6)
    status = lossy.senders()["a"]
    assert status.missed == 1 and status.chance == pytest.approx(0.2) and not status.dead
    lossy.advance(26)
    assert lossy.senders()["a"].missed == 5 and lossy.senders()["a"].dead  # .2^5 = 3e-4


@pytest.mark.slow
def test_what_is_known_of_a_sender_is_saved():
    line = hg.Timeline(network(), window=1)
    line.push("a", 0, 0.0, [0.2])
    line.advance(9)
    again = hg.Timeline.restore(network(), line.save())
    assert again.senders() == line.senders() and again.senders()["a"].last == 0


def chain(channel):
    """Losses of a link, of which a node and an event filter say the same."""
    node = network(channel).nodes["a"]
    filter = node.filters["f"]
    result, known = LossChain.of_channel(node.channel), hg.model.at(filter.channel, 0)
    lost = np.asarray(known.chance) @ ~np.any(np.asarray(known.present), axis=1)
    for part, same in zip(result, (lost, known.transition, filter.initial), strict=True):
        np.testing.assert_allclose(part, same, rtol=1e-12)
    return result


def test_a_stream_says_which_steps_are_silent_and_whether_its_sender_is_dead():
    stream = hg.Stream(network(hg.perfect()).nodes["a"].filters["f"])
    for value in (0.2, np.nan, 1.0, np.nan, np.nan, np.nan, np.nan):
        stream.push([value])
    status = stream.sender()
    assert (status.last, status.silent, status.provisional, status.missed, status.dead) == (2, 4, 0, 0, False)
    again = hg.Stream.restore(stream.filter, stream.save())
    again.push([np.nan])
    assert again.sender().missed == 1 and again.sender().dead and not stream.sender().dead
    with pytest.raises(ValueError, match="filter of a stream: expected one of event_filter, whose sender decides"):
        hg.Stream(hg.kalman_filter(PLANT, SENSOR)).sender()


def test_losses_in_a_row_by_modes():
    """Down with probability .2 and for 5 steps on average: h steps later still (or again) down with p + (1-p) r^h."""
    bursts = hg.gilbert_elliott(LOSSY.base, LOSSY.base, 0.05, 0.2)
    link = hg.gilbert_elliott(hg.erasure(hg.perfect(), 1.0), hg.erasure(hg.perfect(), 0.0), 0.05, 0.2)
    assert chain(bursts).probability_all_lost(3, 2) == 0.0
    assert chain(link).probability_all_lost(4, 2) == pytest.approx(0.2 * (0.2 + 0.8 * 0.75**4))


def test_a_trigger_in_continuous_time_and_no_trigger_are_refused_in_one_line():
    plant = hg.Plant(lambda x, u: x, 0.1, [0.0], 1.0, inputs=["dt"])
    node = hg.Node(SENSOR, hg.perfect(), {}, trigger=hg.SendOnDelta(1.0))
    with pytest.raises(ValueError, match="timeline: expected no part that goes by steps"):
        hg.Timeline(hg.Network(plant, {"a": node}), window=1)
    plain = hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.perfect(), {"k": hg.kalman_filter(PLANT, SENSOR)})})
    with pytest.raises(ValueError, match="senders: expected a node with a trigger"):
        hg.Timeline(plain, window=1).senders()
