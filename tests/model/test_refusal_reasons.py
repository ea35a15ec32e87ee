"""What is refused is counted by the same reasons in a recording, a stream, a timeline, a page and a service."""

import json

import numpy as np
import pytest

import heliograph as hg
from heliograph.live.fleet import Fleet
from heliograph.live.fleet_options import Options
from heliograph.live.network_step_program import NetworkProgram
from heliograph.report import examine, run_page, run_summary
from heliograph.serving.brokers.source_translator import Translator
from heliograph.serving.observation import watch_of
from heliograph.serving.service import Service
from heliograph.serving.storage import InMemoryStore
from tests.serving.watched import metrics_of

PLANT = hg.LinearPlant([[1.0]], 0.01, [0.0], 1.0)
SENSOR = hg.LinearSensor([[1.0]], 0.25, outputs=["v"])
GATE = hg.robust_filter(PLANT, SENSOR, hg.perfect(), hg.filters.Gate(9.0))
NETWORK = hg.Network(
    PLANT, {"a": hg.Node(SENSOR, hg.perfect(), {"g": GATE}, limits=(-100, 100), invalid=-999, stuck=3)}
)
# In turn: kept, a code, beyond the limits, equal three times, outside of the gate.
Z = np.array([0.1, -999.0, 150.0, 0.2, 0.2, 0.2, 30.0, 0.3])[:, None]
COUNTS = {"limits": 1, "code": 1, "stuck": 1, "gate": 1}


def serve_rows(rows):
    """A service that has taken these messages, which have a flag and a count modulo 4, and its observer."""
    field = hg.files.json_field("v", node="a", time="k", time_unit="step", valid="ok", sequence=hg.files.Count("n", 2))
    service = Service(Fleet(NetworkProgram(NETWORK), Options(0.0)), InMemoryStore())
    watch = watch_of(NETWORK, "")
    observed = watch.wrap(service)
    translator = Translator({"t": field}, NETWORK)
    for row in rows:
        observed.take(translator.read("t", json.dumps(row).encode(), None))
    return service, watch


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_recording_a_stream_and_a_timeline_count_the_same():
    record, stream, line = hg.run(NETWORK, {"a": Z}), hg.Stream(GATE, (-100, 100), -999, 3), hg.Timeline(NETWORK, 0.0)
    for k, z in enumerate(Z):
        stream.push(z)
        line.push("a", k, k, z)
    line.advance(100.0)
    assert {one.reason: one.count for one in record.refusals} == COUNTS
    assert [(one.node, one.filter, one.row) for one in record.refusals] == [
        ("a", "", 2), ("a", "", 1), ("a", "", 5), ("a", "g", 6)
    ]  # fmt: skip
    assert {reason: int(count[0]) for reason, count in stream.refused.items()} == COUNTS
    assert line.refused == {"a": {"limits": 1, "code": 1, "stuck": 1}} and line.gated == {("a", "g"): 1}
    # Saved, they go on.
    assert {r: c.tolist() for r, c in hg.Stream.restore(GATE, stream.save()).refused.items()} == {
        r: [c] for r, c in COUNTS.items()
    }
    again = hg.Timeline.restore(NETWORK, line.save())
    assert (again.refused, again.gated) == (line.refused, line.gated)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_page_of_a_recording_names_each_reason():
    health = examine(NETWORK, hg.run(NETWORK, {"a": Z}))
    assert {one["reason"]: one["count"] for one in run_summary(health)["refused"]} == COUNTS
    html = run_page(health, "mine", {}).html()
    for words in ("beyond the limits of its node", "a code, which is no reading", "left out by a filter"):
        assert words in html


def test_values_that_all_filters_find_implausible_are_among_them():
    z = Z.copy()
    z[1:3], z[6] = 0.4, 1e30
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.perfect(), {"k": hg.kalman_filter(PLANT, SENSOR)})})
    with pytest.warns(UserWarning, match="row 7 is implausible"):
        record = hg.run(network, {"a": z})
    assert [(one.reason, one.count, one.row) for one in record.refusals] == [("implausible", 1, 6)]


def test_a_service_counts_flags_and_counters_too():
    rows = [{"v": float(z), "k": k, "n": k % 4, "ok": True} for k, z in enumerate(Z[:, 0])]
    rows[7]["ok"] = False
    rows += [{"v": 0.1, "k": 8, "n": 9, "ok": True}, {"v": 0.1, "k": 9, "n": 1, "ok": True}]
    service, watch = serve_rows(rows)
    link = service.plants[""].links["a"]
    assert link.refused == {"limits": 1, "code": 1, "stuck": 1, "flag": 1, "counter": 1}
    assert service.malformed == 2 and watch.links()["a"]["flag"] == 1
    text = metrics_of(watch)
    for reason in ("limits", "code", "stuck", "flag", "counter"):
        assert f'heliograph_refused_total{{filter="",node="a",reason="{reason}"}} 1.0' in text
    assert 'heliograph_refused_total{filter="g",node="a",reason="gate"} 1.0' in text
    warnings = watch.make_page_data("")["warnings"]
    assert "a: 1 refused, of a message that says it cannot be trusted" in warnings
