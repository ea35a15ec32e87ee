"""A service against timelines: the same verdicts and estimates, whatever the batches; and what it refuses."""

import json
import warnings
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter

import heliograph as hg
from heliograph.live import LinkCounts
from heliograph.live.fleet import Fleet
from heliograph.live.fleet_options import Options
from heliograph.live.network_step_program import NetworkProgram
from heliograph.serving.observation import watch_of
from heliograph.serving.output import Estimates, Refused
from heliograph.serving.service import Service
from heliograph.serving.storage import InMemoryStore
from tests.losing import Losing
from tests.serving.watched import metrics_of
from tests.serving.worlds import WINDOW, fleet, lines, messages, moving, stepping

READER = TypeAdapter(Estimates | Refused)


def served(network, sent, size, **options):
    """All that is published, as JSON, of messages in batches of this size."""
    service = Service(fleet(network, **options), InMemoryStore())
    outputs = []
    for begin in range(0, len(sent), size):
        outputs += service.take(sent[begin : begin + size])
    outputs += service.finish(ended=True)
    for item in outputs:
        READER.validate_json(item.body)
    return service, [json.loads(item.body) for item in outputs]


def finals(known, plant):
    return [
        {k: v for k, v in item.items() if k != "id"}
        for item in known
        if item["kind"] == "final" and item["plant"] == plant
    ]


def test_an_output_claims_nothing_where_covariances_are_no_numbers_and_refuses_where_they_are_negative():
    """Saved gains lose their covariance (NaN) where data are missing.

    The other filter predicts a negative variance from step 2 on: no value can be judged by it, and each is refused.
    """
    plant, sensor = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
    saved = hg.filters.scheduled_polynomial_filter(plant, sensor, hg.perfect(), 6, 1)
    pair = hg.LinearPlant(0.9 * np.eye(2), 0.1, [0.0, 0.0], 1.0, states=["p", "v"])
    row = hg.LinearSensor([[1.0, 0.0]], 0.1)
    cases = (
        (hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"f": saved})}), (0.1, None, 0.2),
         {0.0: "exact", 1.0: "none", 2.0: "none"}),
        (hg.Network(pair, {"a": hg.Node(row, hg.perfect(), {"f": Losing()})}), (0.1, 0.2, 0.3, 0.4),
         {0.0: "nominal", 1.0: "nominal"}),
    )  # fmt: skip
    for network, values, expected in cases:
        sent = [{"node": "a", "sequence": k, "time": k, "values": [z]} for k, z in enumerate(values)]
        service = Service(Fleet(NetworkProgram(network), Options(WINDOW)), InMemoryStore())
        outputs = [json.loads(item.body) for item in [*service.take(lines(sent)), *service.finish(ended=True)]]
        claims = {item["time"]: item["estimates"]["a"]["f"]["claim"] for item in outputs if item["kind"] == "final"}
        assert claims == expected
        refused = [item["reason"] for item in outputs if item["kind"] == "refused"]
        assert refused == ["implausible"] * (len(values) - len(expected))


@pytest.mark.slow
@pytest.mark.parametrize("whole", [True, False])
def test_verdicts_and_estimates_are_those_of_a_timeline(whole):
    """Within 1e-12: two programs that are compiled apart; the estimates are of order one."""
    network = stepping() if whole else moving()
    result = messages(3, 60, seed=1, whole=whole, longest=9.0)  # some later than the window
    result += result[-20:]
    service, known = served(network, lines(result), 17)
    for plant in ("p0", "p1", "p2"):
        mine = [item for item in result if item["plant"] == plant]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            timeline = hg.Timeline(network, WINDOW, start=0.0 if whole else mine[0]["time"])
        for item in mine:
            if "inputs" in item:
                timeline.push("inputs", item["sequence"], item["time"], item["inputs"], item["arrival"])
            values = [np.nan if z is None else z for z in item["values"]]
            timeline.push(item["node"], item["sequence"], item["time"], values, item["arrival"])
        links = service.plants[plant].links
        for node in "ab":
            assert {v: getattr(links[node], v) for v in timeline.counts[node]} == timeline.counts[node]
        assert sum(links[node].late for node in "ab") > 0
        assert sum(links[node].duplicate for node in "ab") > 0
        timeline.advance(1e3)
        record, mine = timeline.final(), finals(known, plant)
        np.testing.assert_array_equal(record.time, [item["time"] for item in mine])
        for node, filters in record.estimates.items():
            for name, estimate in filters.items():
                got = [item["estimates"][node][name] for item in mine]
                np.testing.assert_allclose([item["mean"] for item in got], estimate.mean, atol=1e-12, rtol=0)
                np.testing.assert_allclose(
                    [item["covariance"] for item in got], estimate.covariance, atol=1e-12, rtol=0
                )
                assert {item["claim"] for item in got} == {estimate.claim}


@pytest.mark.parametrize("whole", [True, False])
def test_no_bit_depends_on_batches_or_on_other_plants(whole):
    network = stepping() if whole else moving()
    result = messages(5, 30, seed=2, whole=whole)
    _, together = served(network, lines(result), len(result))
    _, one_by_one = served(network, lines(result), 1)
    alone = served(network, lines([item for item in result if item["plant"] == "p3"]), 7)[1]
    for i in range(5):
        assert finals(together, f"p{i}") == finals(one_by_one, f"p{i}") != []
    assert finals(together, "p3") == finals(alone, "p3")


def test_any_order_and_twice_is_the_same(tmp_path):
    result = messages(2, 30, seed=3, whole=True)
    again = [result[i] for i in np.random.default_rng(0).permutation(len(result))]
    item, two = (served(stepping(), lines(item), 8, window=100.0)[1] for item in (result, again + result))
    for plant in ("p0", "p1"):
        assert finals(item, plant) == finals(two, plant)


def test_nis_is_that_of_the_innovation():
    """e^2 / S of the filter stepped by itself; 1e-12, two programs that are compiled apart."""
    network = stepping()
    alone = network.nodes["a"].filters["linear"]
    z = [0.3, 1.9, None, 0.7, -0.4]
    sent = [{"node": "a", "sequence": k, "time": k, "values": [value]} for k, value in enumerate(z)]
    _, known = served(network, lines(sent), 2)
    mine = [item["estimates"]["a"]["linear"] for item in known if item["kind"] == "final"]
    assert [item["received"] for item in mine] == [1, 1, 0, 1, 1] and mine[2]["nis"] is None
    state = alone.init()
    for k, (value, item) in enumerate(zip(z, mine, strict=True)):
        state, said = alone.correct(alone.predict(state, [0.0], k), [np.nan if value is None else value], k)
        if value is not None:
            np.testing.assert_allclose(item["nis"], said.value[0] ** 2 / said.covariance[0, 0], rtol=1e-12)


BAD = {
    b"no json": "expected a JSON object with no fields but plant, node",
    b"[1]": "expected a JSON object with no fields but plant, node",
    b'{"node": "a"}': "sequence: expected a whole number from 0 to 2^63 - 1, got no such field",
    b'{"node": "a", "sequence": 0, "time": "0.1", "values": [1]}': "time: expected a finite number, not in quotes, or",
    b'{"node": "a", "sequence": 0, "time": 1, "arrival": "2", "values": [1]}': "arrival: expected a finite number, not",
    b'{"node": "a", "sequence": 0, "time": 1, "values": ["1"]}': "values: expected a list of finite numbers, not",
    b'{"node": "a", "sequence": 0, "time": 1, "values": [1], "inputs": ["1"]}': "inputs: expected a list of finite",
    b'{"node": "a", "sequence": "0", "time": 1, "values": [1]}': "sequence: expected a whole number",
    b'{"node": "a", "sequence": 0.5, "time": 1, "values": [1]}': "sequence: expected a whole number",
    b'{"node": "a", "sequence": 0, "time": true, "values": [1]}': "time: expected a finite number",
    b'{"node": "a", "sequence": 0, "time": "0001-01-01T00:00:00+10:00", "values": [1]}': "got '0001",
    b'{"node": "a\\u0000", "sequence": 0, "time": 1, "values": [1]}': "node: expected a name of at most 200 characters",
    b'{"node": "c", "sequence": 0, "time": 1, "values": [1]}': "one of a, b, inputs",
    b'{"node": "a", "sequence": 0, "time": 1, "values": [1, 2]}': "1 numbers",
    b'{"node": "a", "sequence": 0, "time": 1, "values": [NaN]}': "values",
    b'{"node": "a", "sequence": 0, "time": 1, "values": [1e999]}': "values",
    b'{"node": "a", "sequence": 0, "time": Infinity, "values": [1]}': "time",
    b'{"node": "a", "sequence": 0, "time": 1.5, "values": [1]}': "a step",
    b'{"node": "a", "sequence": 0, "time": -1, "values": [1]}': "a step",
    b'{"node": "a", "sequence": 0, "time": 1e300, "values": [1]}': "future",
    b'{"node": "a", "sequence": -1, "time": 1, "values": [1]}': "sequence",
    b'{"node": "a", "sequence": 99999999999999999999, "time": 1, "values": [1]}': "sequence",
    b'{"node": "a", "sequence": 0, "time": "2026-11-21T10:00:00", "values": [1]}': "with a zone, got '2026",
    b'{"node": "a", "sequence": 0, "time": "2026-11-21T10:00:00Z", "values": [1]}': "a number",
    b'{"node": "a", "sequence": 0, "time": 1, "values": [1], "more": 1}': "more",
    b'{"node": "a", "sequence": 0, "time": 1, "values": [1], "inputs": []}': "1 numbers",
    b"\xff\xfe": "",
    b"[" * 5000: "",
}


@pytest.mark.slow
def test_robust_and_adaptive_filters_say_what_they_made_of_each_number():
    """Innovations and weights of a service are those of the filters over the same rows; the broken output is to blame.

    Equal to 1e-9 of numbers of order one, from two programs that are compiled apart.
    """
    plant = hg.LinearPlant(0.9 * np.eye(2), 0.1 * np.eye(2), [0.0, 0.0], np.eye(2), states=["x", "v"])
    sensor = hg.LinearSensor(np.eye(2), 0.1 * np.eye(2), outputs=["left", "right"])
    robust = hg.robust_filter(plant, sensor, hg.perfect(2), hg.filters.Gate(30.0))
    filters = {"robust": robust, "adaptive": hg.adaptive_filter(robust), "kalman": hg.kalman_filter(plant, sensor)}
    network = hg.Network(plant, {"radio": hg.Node(sensor, hg.perfect(2), filters)})
    z = 0.3 * np.random.default_rng(0).normal(size=(60, 2))
    z[::4, 0] += 15.0
    z[5, 1] = np.nan
    watch = watch_of(network, "tank")
    service = watch.wrap(Service(Fleet(NetworkProgram(network), Options(WINDOW)), InMemoryStore()))
    values = [[None if np.isnan(x) else x for x in row] for row in z.tolist()]
    sent = [{"node": "radio", "sequence": k, "time": k, "values": row} for k, row in enumerate(values)]
    outputs = service.take(lines(sent))
    known = finals([json.loads(item.body) for item in outputs], outputs[0].plant)
    assert len(known) > 40 and known[0]["estimates"]["radio"]["kalman"].get("outputs") is None
    for name in ("robust", "adaptive"):
        item = filters[name].run(z)
        rows = [message["estimates"]["radio"][name]["outputs"] for message in known]
        for part, expected in (("value", item.innovations), ("weight", item.weights)):
            got = np.array([row[part] for row in rows], dtype=float)
            np.testing.assert_allclose(got, expected[: len(got)], rtol=1e-9, atol=1e-9)
    said = {(row["filter"], row["output"]): row for row in watch.make_page_data(None)["outputs"]}
    assert set(said) == {(name, output) for name in ("robust", "adaptive") for output in ("left", "right")}
    assert said["robust", "left"]["to_blame"] and not said["robust", "right"]["to_blame"]
    assert "down-weighted" in said["robust", "left"]["words"]
    text = metrics_of(watch)
    assert 'heliograph_output_share{filter="robust",node="radio",output="left"}' in text


def test_what_is_bad_is_said_and_changes_nothing():
    good = lines(messages(1, len(BAD) + 1, seed=4, whole=True))
    bad = {payload.replace(b'{"node"', b'{"plant": "p0", "node"'): reason for payload, reason in BAD.items()}
    mixed = [good[0], *(line for i, item in enumerate(good[1:]) for line in (item, list(bad)[i % len(bad)]))]
    _, clean = served(stepping(), good, 6)
    service, known = served(stepping(), mixed, 6)
    assert finals(known, "p0") == finals(clean, "p0") and service.malformed == len(bad) - 1
    for payload, reason in bad.items():
        _, known = served(stepping(), [good[0], payload], 2)
        refused = [item for item in known if item["kind"] == "refused"]
        assert len(refused) == 1 and reason in refused[0]["reason"] + refused[0]["detail"], (payload, known)


def test_a_clock_keeps_its_kind_and_the_refusal_says_how_to_mend_it():
    date = {"plant": "p q", "node": "a", "sequence": 0, "time": "2026-11-21T10:00:00Z", "values": [1.0]}
    number = date | {"sequence": 1, "time": 0.2}
    _, known = served(moving(), lines([date, number]), 2)
    (refused,) = (item for item in known if item["kind"] == "refused")
    assert "a date, as this plant's times are, got 0.2; if its first" in refused["detail"]
    assert "serve --anew 'p q' begins it anew" in refused["detail"]
    _, known = served(moving(), lines([number, date]), 2)
    (refused,) = (item for item in known if item["kind"] == "refused")
    assert "a number, as this plant's times are, got 2026-11-21T10:00:00+00:00; if its" in refused["detail"]


def test_a_number_in_quotes_begins_no_clock():
    quoted = {"node": "a", "sequence": 0, "time": "0.1", "values": [1.0]}
    right = quoted | {"sequence": 1, "time": 0.2}
    service, known = served(moving(), lines([quoted, right]), 1)
    assert service.malformed == 1 and [item["time"] for item in known if item["kind"] == "final"] == [0.2]


def test_no_plant_begins_with_a_wrong_clock():
    """Its time would start there, and all that is right would be late."""
    wrong = {"plant": "p", "node": "a", "sequence": 0, "time": 1e9, "values": [1.0], "arrival": 1.0}
    right = {"plant": "p", "node": "a", "sequence": 1, "time": 1.0, "values": [1.0], "arrival": 1.0}
    service, known = served(moving(), lines([wrong, right]), 2)
    assert [item["reason"] for item in known if item["kind"] == "refused"] == ["future"]
    assert len(finals(known, "p")) == 1 and service.plants["p"].links["a"].used == 1


@given(st.randoms(use_true_random=False), st.floats(0, 0.6))
def test_lost_is_what_never_came_in_whatever_order_the_rest_did(chance, loss):
    """Between the first and the last that were received; then the node is started again, and counts from 0."""
    link, lost = LinkCounts(), 0
    for boot in range(2):
        received = [k for k in range(1, 20) if chance.random() > loss]
        chance.shuffle(received)
        if boot and link.newest > 0:
            received.insert(0, 0)
        for k in received:
            link.count("used", k, float(100 * boot + k))
        lost += max(received) - min(received) + 1 - len(received) if received and (link.first in received) else 0
    assert link.lost == lost


def test_a_wrong_clock_or_a_copy_loses_nothing():
    link = LinkCounts()
    for verdict, sequence, time in [
        ("used", 0, 0.0), ("future", 1, 1e9), ("used", 2, 2.0), ("duplicate", 0, 0.0), ("used", 4, 4.0),
        ("conflict", 0, 0.0), ("late", 3, 3.0),
    ]:  # fmt: skip
        link.count(verdict, sequence, time)
    assert link.lost == 1  # what is late may have been counted when it first came, so it fills nothing


def test_lag_is_by_the_clock_on_the_wall_where_messages_carry_dates():
    service = Service(fleet(moving()), InMemoryStore())
    time = datetime.now(UTC) - timedelta(seconds=1000)
    service.take(lines([{"plant": "dated", "node": "a", "sequence": 0, "time": time.isoformat(), "values": [1.0]}]))
    assert 1000 < service.last.lag < 1600  # of a busy machine
    service.take(lines([{"plant": "counted", "node": "a", "sequence": 0, "time": 1.0, "values": [1.0]}]))
    assert service.last.lag == service.last.took


def test_memory_is_bounded_by_the_window():
    """One plant for 2,000 rows at a time: those of the window and of the batch are held, and no more."""
    service = Service(fleet(moving()), InMemoryStore())
    z = np.random.default_rng(0).normal(size=2000)
    sent = lines([{"node": "a", "sequence": k, "time": 0.1 * k, "values": [float(z[k])]} for k in range(2000)])
    for begin in range(0, 2000, 50):
        service.take(sent[begin : begin + 50])
        assert service.fleet.state_table.used <= WINDOW / 0.1 + 50 + 2
