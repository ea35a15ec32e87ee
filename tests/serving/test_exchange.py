"""Nodes of a fusion without a centre, each a service of its own: what they tell, what gets lost, and one is killed."""

import json
from functools import cache

import numpy as np
import pytest

import heliograph as hg
from heliograph.serving.exchange import Exchange
from heliograph.serving.fleet import Fleet, Options
from heliograph.serving.lanes import Lanes
from heliograph.serving.output import Output
from heliograph.serving.service import Service
from heliograph.serving.storage.store_protocol import InMemoryStore
from heliograph.simulation.centres.node_filter import node_network

PLANT = hg.LinearPlant([[1.0, 0.3], [0.0, 0.95]], 0.1 * np.eye(2), [1.0, 0.0], np.eye(2))
NEAR = {"a": ["b"], "b": ["a", "c"], "c": ["b"]}
STEPS = 12


def chain(rule: hg.fusion.AbstractFusion | None = None, **options: object) -> hg.Network:
    """Two nodes that measure one state each, and one between them that has no sensor."""
    parts: dict[str, hg.Node | None] = {"b": None}
    for name, row in (("a", [1.0, 0.0]), ("c", [0.0, 1.0])):
        sensor = hg.LinearSensor([row], 0.3)
        parts[name] = hg.Node(sensor, hg.perfect(), {"alone": hg.kalman_filter(PLANT, sensor)})
    item = hg.Fusion("alone", rule or hg.fusion.TraceIntersection(), neighbours=NEAR, **options)  # type: ignore[arg-type]
    return hg.Network(PLANT, {name: parts[name] for name in "abc"}, {"mesh": item})


@cache
def services() -> dict[str, Fleet]:
    network = chain(link=hg.erasure(hg.perfect(), 0.7))
    return {name: Fleet(Lanes(node_network(network, name)), Options()) for name in "abc"}


def exchanged(lost: np.ndarray, dead: dict[str, range]) -> dict[str, dict[int, dict[str, list]]]:
    """Estimates of the nodes by step; `lost` (step, edge) of the edges "ab", "ba", "bc", "cb"."""
    nodes = {name: Service(item, InMemoryStore()) for name, item in services().items()}
    results: dict[str, dict[int, dict[str, list]]] = {name: {} for name in nodes}
    z = measured()
    for k in range(STEPS):
        waiting: list[tuple[str, bytes]] = [
            (name, json.dumps({"node": name, "sequence": k, "time": k, "values": z[name][k].tolist()}).encode())
            for name in "ac"
        ]
        while waiting:
            to, body = waiting.pop(0)
            if k in dead.get(to, ()):
                continue
            for output in nodes[to].take([body]):
                content = json.loads(output.body)
                if output.kind == "message" and not lost[k, ["ab", "ba", "bc", "cb"].index(to + output.to)]:
                    waiting.append((output.to, output.body))
                elif output.kind == "provisional":
                    results[to][content["time"]] = content["estimates"]["fused"]["mesh"]
                assert output.kind != "refused", content
    return results


@cache
def measured() -> dict[str, np.ndarray]:
    record = hg.simulate(chain(), STEPS, key=3)
    return {name: np.asarray(record.measurements[name]) for name in "abc"}


@pytest.mark.parametrize("loss", [0.0, 0.4])
def test_services_that_exchange_messages_tell_what_one_run_tells(loss: float):
    lost = np.random.default_rng(1).random((STEPS, 4)) < loss
    lost[:, 0] &= ~lost[:, 3]  # a node without a sensor sends once anything of the step came
    flags = np.where(lost, np.nan, 1.0)
    reports = {"a": flags[:, 1:2], "b": flags[:, [0, 3]], "c": flags[:, 2:3]}
    network = chain(link=hg.erasure(hg.perfect(), 0.7))
    record = hg.run(network, measured(), reports={"mesh": reports})
    result = exchanged(lost, {})
    for name in "abc":
        expected = record.estimates[name]["mesh"]
        for k in range(STEPS):
            item = result[name][k]
            assert item["claim"] == "upper"
            # The same operations but for the order of sums.
            np.testing.assert_allclose(item["mean"], expected.mean[k], atol=1e-12)
            np.testing.assert_allclose(item["covariance"], expected.covariance[k], atol=1e-12)
