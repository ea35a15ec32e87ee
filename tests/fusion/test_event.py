"""Sending on event: what arrives, what is counted, what is claimed."""

import numpy as np
import pytest

import heliograph as hg

VALUES = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, -0.5], [np.nan, np.nan], [0.3, -0.5]])


@pytest.mark.parametrize("known", [True, False])
def test_a_value_is_sent_when_it_has_changed_by_more_than_the_threshold(known):
    """The first, and the third, whose second component moved by .5; one that is NaN is not there."""
    sends = hg.fusion.EventSending([0.25, 0.25], known)
    state, received, symbols = sends.init(2), [], []
    for value in VALUES:
        state, sent = sends.step(state, value)
        received.append(sent.value)
        symbols.append(sent.symbols.sum())
    assert symbols == [2, 0, 2, 0, 0]
    held = VALUES[[0, 0, 2, 3, 2]]
    expected = held if known else np.where((np.array(symbols) > 0)[:, None], held, np.nan)
    np.testing.assert_array_equal(received, expected)
    assert sends.claim("exact") == ("upper" if known else "nominal")
    np.testing.assert_array_equal(sends.error(2), [0.25, 0.25] if known else [0.0, 0.0])


def test_silence_taken_for_a_loss_needs_a_rule_that_receives_reports():
    plant, sensor = hg.LinearPlant([[0.9]], [[0.1]], [0.0], [[1.0]]), hg.LinearSensor([[1.0]], 0.1)
    nodes = {"a": hg.Node(sensor, hg.perfect(), {"local": hg.kalman_filter(plant, sensor)})}
    sends = hg.fusion.EventSending(0.1, announced=False)
    with pytest.raises(ValueError, match="a rule that uses reports"):
        hg.Network(plant, nodes, {"one": hg.Fusion("local", hg.fusion.EqualIntersection(), quantizer=sends)})
    with pytest.raises(ValueError, match="threshold: expected positive numbers"):
        hg.fusion.EventSending(0.0)


LINKS = {
    "lost": hg.fusion.ReportLink(hg.erasure(hg.perfect(), 0.5)),
    "noisy": hg.fusion.ReportLink(hg.hop(1.0, 0.1)),
    "late by chance": hg.fusion.ReportLink(delay=[0.5, 0.5]),
}


def centre(link, announced):
    plant, sensor = hg.LinearPlant([[0.9]], [[0.1]], [0.0], [[1.0]]), hg.LinearSensor([[1.0]], 0.1)
    nodes = {"a": hg.Node(sensor, hg.perfect(), {"local": hg.kalman_filter(plant, sensor)})}
    sends = hg.fusion.EventSending(0.1, announced)
    return hg.Network(plant, nodes, {"one": hg.Fusion("local", hg.fusion.AllReports(), quantizer=sends, uplink=link)})


@pytest.mark.parametrize("link", LINKS.values(), ids=LINKS)
def test_silence_is_understood_only_where_what_was_sent_has_arrived(link):
    """Else the receiver knows no last value: silence would bring it what was lost when it was sent."""
    with pytest.raises(ValueError, match="whose silence is understood: expected a report link"):
        centre(link, True)
    assert centre(link, False).claims()["fused"]["one"] == "nominal"


@pytest.mark.parametrize("link", [hg.fusion.ReportLink(hg.perfect()), hg.fusion.ReportLink(delay=2, every=3)])
def test_silence_is_understood_over_a_link_that_delivers(link):
    assert centre(link, True).claims()["fused"]["one"] == "upper"
