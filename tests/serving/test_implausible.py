"""Absurd messages among good ones: outputs are those of a service without them, bit for bit; they are counted."""

import json
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import heliograph as hg
from heliograph.serving import Fleet, InMemoryStore, NetworkProgram, Options, Service
from tests.serving.test_service import finals, served
from tests.serving.worlds import HOP, SENSOR, fleet, lines, messages, moving, stepping

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from absurd_soak import stained


def refused_good(outputs):
    """Which messages that are not absurd were refused, and why."""
    refused = [output for output in outputs if output["kind"] == "refused" and output["sequence"] < 1_000_000]
    return sorted((item["plant"], item["node"], item["sequence"], item["reason"]) for item in refused)


@pytest.mark.parametrize("whole", [True, False])
@pytest.mark.parametrize("size", [1, 16, 400])
def test_absurd_messages_leave_no_trace(whole, size):
    network = stepping() if whole else moving()
    good = messages(3, 60, seed=5, whole=whole)
    bad, _ = stained(good, 0.1, np.random.default_rng(1))
    _, expected = served(network, lines(good), size)
    service, known = served(network, lines(bad), size)
    refused = Counter(item["reason"] for item in known if item["kind"] == "refused")
    assert refused["implausible"] > 10 and service.malformed == 0
    assert refused_good(known) == refused_good(expected)
    for plant in ("p0", "p1", "p2"):
        assert finals(known, plant) == finals(expected, plant) != []
    counted = [link.implausible for plant in service.plants.values() for link in plant.links.values()]
    began = [item for item in known if item["kind"] == "refused" and item["reason"] == "implausible"]
    assert len(began) - 6 <= sum(counted) <= len(began)  # a message that would have begun a plant has no link


def test_a_plant_does_not_begin_with_an_absurd_value():
    first = {"plant": "p", "node": "a", "sequence": 0, "time": 1.0, "values": [1e20]}
    service, known = served(moving(), lines([first]), 1)
    assert [item["reason"] for item in known] == ["implausible"] and not service.plants
    assert "1e6 deviations" in known[0]["detail"]
    service, known = served(moving(), lines([first, first | {"sequence": 1, "time": 0.5, "values": [0.3]}]), 2)
    assert [item["time"] for item in known if item["kind"] == "final"] == [0.5]


def test_of_a_message_its_inputs_or_its_values_are_refused_alone():
    push = {"plant": "p", "node": "a", "sequence": 0, "time": 0, "values": [0.3], "inputs": [0.1]}
    after = push | {"sequence": 1, "time": 1}
    cases = {
        "values": (after | {"values": [1e20]}, after | {"values": [None]}),
        "inputs": (after | {"inputs": [1e200]}, after | {"inputs": [None]}),
    }
    last = push | {"sequence": 2, "time": 2}
    for which, (bad, like) in cases.items():
        service, known = served(stepping(), lines([push, bad, last]), 3)
        _, expected = served(stepping(), lines([push, like, last]), 3)
        assert finals(known, "p")[-1] == finals(expected, "p")[-1]
        (refused,) = [item for item in known if item["kind"] == "refused"]
        assert refused["reason"] == "implausible" and refused["sequence"] == 1
        assert ("; the rest is used" in refused["detail"]) == (which == "inputs")
        assert service.plants["p"].links["inputs" if which == "inputs" else "a"].implausible == 1


def test_inputs_that_are_dropped_are_said_beside_a_measurement_that_is_used():
    """Two nodes that say the same inputs of a step say nothing new; other inputs are a conflict, and the first stay."""
    first = {"plant": "p", "node": "a", "sequence": 7, "time": 0, "values": [0.3], "inputs": [0.1]}
    second = first | {"node": "b", "sequence": 3}
    for inputs, reasons in (([0.1], []), ([None], []), ([0.2], ["conflict"])):
        service, known = served(stepping(), lines([first, second | {"inputs": inputs}]), 1)
        refused = [item for item in known if item["kind"] == "refused"]
        assert [item["reason"] for item in refused] == reasons, inputs
        counts = service.plants["p"].links
        assert counts["b"].used == 1 and (counts["inputs"].conflict if reasons else 0) == len(reasons)
    assert refused[0]["node"] == "b"
    assert refused[0]["detail"] == "inputs [0.2]: held already with other values, which stay; the rest is used"
    # In continuous time inputs stand before the measurements of their moment, of which one is final here.
    late = [first, first | {"sequence": 8, "time": 9.0}, second | {"inputs": [0.4]}]
    _, known = served(moving(), lines(late), 1)
    refused = [item for item in known if item["kind"] == "refused"]
    assert [(item["reason"], item["detail"][:12]) for item in refused] == [("late", "inputs [0.4]")]


def test_what_is_late_is_late_whatever_its_value():
    """As on a timeline: the first verdict that holds."""
    plant = hg.LinearPlant([[0.95]], 0.04, [1.0], 0.5)
    node = hg.Node(SENSOR, HOP, {"linear": hg.linear_filter(plant, SENSOR, HOP)}, limits=(-5, 5))
    network = hg.Network(plant, {"a": node})
    pushes = [(0, 0.0, 1.0), (1, 3.0, 1.0), (2, 20.0, 1.0), (3, 21.0, 7.0), (4, 1.0, 7.0), (2, 20.0, 7.0)]
    timeline = hg.Timeline(network, 5.0)
    verdicts = [timeline.push("a", sequence, time, [value]) for sequence, time, value in pushes]
    assert verdicts == ["used", "used", "used", "implausible", "late", "conflict"]
    service = Service(Fleet(NetworkProgram(network), Options(5.0)), InMemoryStore())
    sent = [{"node": "a", "sequence": sequence, "time": time, "values": [value]} for sequence, time, value in pushes]
    known = [json.loads(output.body) for output in service.take(lines(sent))]
    assert [item["reason"] for item in known if item["kind"] == "refused"] == verdicts[3:]
    assert {verdict: getattr(service.plants[""].links["a"], verdict) for verdict in verdicts} == {
        verdict: timeline.counts["a"][verdict] for verdict in verdicts
    }


def test_limits_hold_here_too_and_it_is_said_once():
    plant = hg.LinearPlant([[0.95]], 0.04, [1.0], 0.5)
    item = hg.linear_filter(plant, SENSOR, HOP)
    network = hg.Network(plant, {"a": hg.Node(SENSOR, HOP, {"f": item}, limits=(-5, 5), invalid=-999)})
    said = []
    from heliograph.live.fleet import Fleet
    from heliograph.live.fleet_options import Options
    from heliograph.live.network_step_program import NetworkProgram

    service = Service(Fleet(NetworkProgram(network), Options(5.0)), InMemoryStore(), said.append)
    sent = [{"node": "a", "sequence": k, "time": k, "values": [v]} for k, v in enumerate([0.3, -999, 6.0, 1e20, 0.4])]
    outputs = [json.loads(single.body) for single in service.take(lines(sent))]
    details = [single["detail"] for single in outputs if single["kind"] == "refused"]
    assert details == ["y0 -999 is a code", "y0 6 is outside -5 to 5", "y0 1e+20 is outside -5 to 5"]
    link = service.plants[""].links["a"]
    assert (link.used, link.implausible, link.lost) == (2, 3, 0)
    assert link.refused == {"limits": 2, "code": 1}
    assert len(said) == 1 and said[0].startswith("warning: message 1 of 'a' is implausible: y0 -999 is a code; ")
    hidden = fleet(stepping())  # the identity of a store knows the limits
    assert hidden.program.network is not network


@pytest.mark.slow
def test_a_filter_that_alone_leaves_a_value_out_says_so():
    plant = hg.LinearPlant([[0.95]], 0.04, [1.0], 0.5)
    lost = hg.linear_filter(
        hg.LinearPlant([[0.95]], 1e-16, [0.0], 1e-16), hg.LinearSensor([[1.0]], 1e-16), hg.perfect()
    )
    filters = {"lost": lost, "fine": hg.linear_filter(plant, SENSOR, HOP)}
    network = hg.Network(plant, {"a": hg.Node(SENSOR, HOP, filters)})
    from heliograph.live.fleet import Fleet
    from heliograph.live.fleet_options import Options
    from heliograph.live.network_step_program import NetworkProgram

    service = Service(Fleet(NetworkProgram(network), Options(5.0)), InMemoryStore())
    (known,) = service.take(lines([{"node": "a", "sequence": 0, "time": 0, "values": [1.0]}]))
    result = json.loads(known.body)["estimates"]["a"]
    assert result["lost"]["mean"] == [0.0] and result["lost"]["nis"] is None and result["lost"]["received"] == 0
    assert "1e6 deviations" in result["lost"]["implausible"] and "implausible" not in result["fine"]
