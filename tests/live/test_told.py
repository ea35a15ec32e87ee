"""Timelines of nodes that are told numbers: late messages with their own numbers, and numbers that give no law."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.model import told

PLANT = hg.LinearPlant([[0.95, 0.1], [0.0, 0.9]], 0.1 * np.eye(2), [0.5, 0.0], np.eye(2))
SENSOR = hg.LinearSensor([[1.0, 0.3]], 0.05, outputs=["y"])
LINK = told(lambda a: hg.hop(1.0, a[0]), ["variance"], typical=[0.1])
NETWORK = hg.Network(PLANT, {"a": hg.Node(SENSOR, LINK, {"f": hg.linear_filter(PLANT, SENSOR, LINK)})})
LATE = [0, 1, 3, 2, 4, 6, 5, 8, 7, 9, 11, 10]


def rows():
    random = np.random.default_rng(0)
    return np.column_stack([random.normal(size=12), random.uniform(0.1, 1.0, 12)])


def test_late_messages_keep_their_own_numbers():
    timeline, z = hg.Timeline(NETWORK, 20.0), rows()
    assert {timeline.push("a", k, float(k), z[k]) for k in LATE} == {"used"}
    expected = hg.run(NETWORK, {"a": z}).estimates["a"]["f"].mean[-1]
    estimate = timeline.estimates()["a"]["f"]
    np.testing.assert_allclose(estimate.mean, expected, rtol=1e-13)
    assert estimate.received == 1 and estimate.nis > 0  # what is told is not tested


def test_numbers_that_give_no_law_are_refused_and_named():
    timeline, z = hg.Timeline(NETWORK, 20.0), rows()
    z[4, 1] = -1.0
    with pytest.warns(UserWarning, match="row 5 is implausible"):
        expected = hg.run(NETWORK, {"a": z}).estimates["a"]["f"].mean[-1]
    verdicts = {k: timeline.push("a", k, float(k), z[k]) for k in LATE}
    assert [k for k, verdict in verdicts.items() if verdict != "used"] == [4] and verdicts[4] == "implausible"
    np.testing.assert_allclose(timeline.estimates()["a"]["f"].mean, expected, rtol=1e-13)


def test_events_of_a_sender_that_is_silent_are_refused():
    """A silent step says no numbers, and the chance of silence needs them."""
    with pytest.raises(ValueError, match="expected a filter that takes what a message tells"):
        hg.event_filter(PLANT, SENSOR, LINK, hg.SendOnDelta(0.5))
