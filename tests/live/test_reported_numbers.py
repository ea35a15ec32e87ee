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


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, hg.model.Pilot(0.04)])
def test_a_lagged_estimate_is_smoothed_by_what_was_told(known):
    """As `run` smooths the rows in order, with a value, a gain and whole rows missing, and messages that overtake."""
    link = hg.hop(hg.Rayleigh(0.8), 0.1, known=known)
    nodes = {
        "a": NETWORK.nodes["a"],
        "b": hg.Node(SENSOR, link, {"f": hg.linear_filter(PLANT, SENSOR, link)}),
    }
    network, z = hg.Network(PLANT, nodes), {"a": rows(), "b": rows()[::-1].copy()}
    z["a"][4], z["b"][2, 1], z["b"][7, 0] = np.nan, np.nan, np.nan
    timeline = hg.Timeline(network, 20.0)
    for k in LATE:
        for node in nodes:
            if not np.isnan(z[node][k]).all():
                timeline.push(node, k, float(k), z[node][k])
    for lag in (0, 3, 9):
        smoothed = hg.run(network, z, smooth=hg.smoothing.FixedInterval()).smoothed
        for node, filters in timeline.lagged(lag).items():
            expected = smoothed.estimates[node]["f"]
            np.testing.assert_allclose(filters["f"].mean, expected.mean[11 - lag], rtol=1e-11, atol=1e-13)
            np.testing.assert_allclose(filters["f"].covariance, expected.covariance[11 - lag], rtol=1e-11, atol=1e-13)
            assert filters["f"].claim == expected.claim
