"""Live estimates say what was not expected; a filter that leaves out everything is named; one value is one node's."""

import warnings

import numpy as np
import pytest

import heliograph as hg
from heliograph.serving import Fleet, InMemoryStore, NetworkProgram, Options, Service
from tests.serving.worlds import lines

PLANT, SENSOR = hg.LinearPlant([[1.0]], 0.04, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.01)


def test_push_and_estimates_say_what_was_not_expected():
    """e^2 / S by hand: S = P + Q + R, after the first update P R / (P + R)."""
    item = hg.kalman_filter(PLANT, SENSOR)
    stream = hg.Stream(item)
    line = hg.Timeline(hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.perfect(), {"k": item})}), window=3)
    p, mean = 1.04, 0.0  # the first step is predicted too
    for k, value in enumerate((0.5, np.nan, -1.0)):
        s = p + 0.01
        pushed = stream.push([value])
        if not np.isnan(value):
            line.push("a", k, k, [value])
            now = line.estimates()["a"]["k"]
            assert (now.received, now.refused) == (pushed.received, "") == (1, "")
            assert pushed.nis == pytest.approx((value - mean) ** 2 / s, rel=1e-12)
            assert now.nis == pytest.approx(pushed.nis, rel=1e-12)  # compiled apart
            mean, p = mean + p / s * (value - mean), p * 0.01 / s
        else:
            assert np.isnan(pushed.nis) and pushed.received == 0
        p += 0.04
    assert isinstance(pushed, hg.model.Estimate)
    line.advance(9)
    later = line.estimates()["a"]["k"]
    assert np.isnan(later.nis) and later.received == 0


@pytest.mark.slow
def test_a_filter_that_weighs_says_how_much_of_each_number_it_used():
    """Both outputs of one, the second far off; what did not arrive has no weight, and other filters say none."""
    sensor = hg.LinearSensor([[1.0], [1.0]], 0.01 * np.eye(2))
    gate = hg.robust_filter(PLANT, sensor, hg.perfect(2), hg.filters.Gate(13.8))
    plain = hg.kalman_filter(PLANT, sensor)
    stream, node = hg.Stream(gate), hg.Node(sensor, hg.perfect(2), {"gate": gate, "plain": plain})
    line = hg.Timeline(hg.Network(PLANT, {"a": node}), window=3)
    for k, (value, weight) in enumerate([([0.1, 50.0], [1, 0]), ([np.nan, 0.2], [np.nan, 1])]):
        np.testing.assert_array_equal(stream.push(value).weight, weight)
        line.push("a", k, k, value)
        np.testing.assert_array_equal(line.estimates()["a"]["gate"].weight, weight)
        assert line.estimates()["a"]["plain"].weight is None
    assert hg.Stream(plain).push([0.1, 0.2]).weight is None


def test_a_gate_with_a_wrong_start_says_that_it_leaves_out_everything():
    still = hg.LinearPlant([[1.0]], 0.0, [0.0], 1e-4)
    gate = hg.robust_filter(still, SENSOR, hg.perfect(), hg.filters.Gate(13.8))
    stream = hg.Stream(gate)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(9):
            stream.push([1223.0])
    assert not stream.doubt
    with pytest.warns(UserWarning, match="the last 10 measurements were each further off than one in 10,000 should be"):
        stream.push([1223.0])
    with warnings.catch_warnings():  # said once
        warnings.simplefilter("error")
        stream.push([1223.0])
    again = hg.Stream.restore(gate, stream.save())
    assert "begins anew with a larger initial covariance" in again.doubt and abs(stream.push([np.nan]).mean[0]) < 1e-3
    again.push([0.01])
    assert not again.doubt


def fused():
    """Three nodes without filters of their own, and one filter of all."""
    parts = [hg.kalman_filter(PLANT, SENSOR)] * 3
    nodes = {name: hg.Node(SENSOR, hg.perfect(), {}) for name in "abc"}
    return hg.Network(PLANT, nodes, {"all": hg.filters.sequential_filter(parts)})


@pytest.mark.slow
def test_an_implausible_value_in_a_fused_filter_is_its_nodes_and_costs_that_value_alone():
    network = fused()
    service = Service(Fleet(NetworkProgram(network), Options(window=5.0)), InMemoryStore())
    clean = hg.Timeline(network, window=5)
    sent = [{"node": name, "sequence": 0, "time": 0, "values": [0.1 * i]} for i, name in enumerate("abc")]
    bad = [{"node": name, "sequence": 1, "time": 1, "values": [value]}
           for name, value in (("a", 0.3), ("b", 1e20), ("c", None))]  # fmt: skip
    service.take(lines(sent))
    service.take(lines(bad))
    counts = {name: (link.used, link.implausible) for name, link in service.plants[""].links.items()}
    assert counts == {"a": (2, 0), "b": (1, 1), "c": (2, 0)}
    for i, name in enumerate("abc"):
        clean.push(name, 0, 0, [0.1 * i])
    clean.push("a", 1, 1, [0.3])
    plant = service.plants[""]
    outputs = service.fleet.outputs([plant.rows.held[-1].slot])[0]
    expected = clean.estimates()["fused"]["all"]
    place = service.fleet.program.filter_columns[-1]
    assert outputs[place.mean] == pytest.approx(expected.mean[0], rel=1e-12)
    assert outputs[place.covariance] == pytest.approx(expected.covariance[0, 0], rel=1e-12)
    # Two bad ones in a row are each found.
    both = [{"node": name, "sequence": 2, "time": 2, "values": [value]}
            for name, value in (("a", 1e20), ("b", 0.2), ("c", -1e19))]  # fmt: skip
    service.take(lines(both))
    counts = {name: (link.used, link.implausible) for name, link in plant.links.items()}
    assert counts == {"a": (2, 1), "b": (2, 1), "c": (2, 1)}
