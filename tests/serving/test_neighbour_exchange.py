"""Nodes of a fusion without a centre, each a service of its own: what they tell, what gets lost, and one is killed."""

import asyncio
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import heliograph as hg
from heliograph.live.fleet import Fleet
from heliograph.live.fleet_options import Options
from heliograph.live.network_step_program import NetworkProgram
from heliograph.serving.brokers.broker_address import parse_address
from heliograph.serving.brokers.source_translator import Translator
from heliograph.serving.message import Message
from heliograph.serving.service import Service
from heliograph.serving.settings import ServiceSettings, settings_of_node
from heliograph.serving.storage import InMemoryStore
from heliograph.simulation.mesh.node_filter import node_network
from tests.serving.neighbours import PLANT, chain

ROOT = Path(hg.__file__).parents[2]

STEPS = 12

LOSSY = hg.erasure(hg.perfect(), 0.7)
QUANTIZER = hg.fusion.UniformQuantizer(41, 0.7)
NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)


@cache
def services(quantized: bool = False, step: float | None = None) -> dict[str, Fleet]:
    network = chain(link=LOSSY, quantizer=QUANTIZER if quantized else None)
    return {name: Fleet(NetworkProgram(node_network(network, name)), Options(step=step)) for name in "abc"}


def in_steps(node: str, k: int, values: list[float]) -> bytes | Message | str:
    return json.dumps({"node": node, "sequence": k, "time": k, "values": values}).encode()


Measured = Callable[[str, int, list[float]], bytes | Message | str]


def exchanged(
    lost: np.ndarray, fleets: dict[str, Fleet], measurement: Measured = in_steps
) -> dict[str, dict[int, dict[str, list]]]:
    """Estimates of the nodes by step; `lost` (step, edge) of the edges "ab", "ba", "bc", "cb"."""
    nodes = {name: Service(item, InMemoryStore()) for name, item in fleets.items()}
    results: dict[str, dict[int, dict[str, list]]] = {name: {} for name in nodes}
    z = measured()
    for k in range(STEPS):
        waiting: list[tuple[str, bytes | Message | str]] = [(n, measurement(n, k, z[n][k].tolist())) for n in "ac"]
        while waiting:
            to, body = waiting.pop(0)
            for output in nodes[to].take([body]):
                content = json.loads(output.body)
                if output.kind == "message" and not lost[k, ["ab", "ba", "bc", "cb"].index(to + output.to)]:
                    waiting.append((output.to, output.body))
                elif output.kind == "provisional":
                    results[to][step_of(content["time"])] = content["estimates"]["fused"]["mesh"]
                assert output.kind != "refused", content
    return results


def step_of(time: float | str) -> int:
    """Step of an output; of dates those of a minute from noon on."""
    return int(time) if not isinstance(time, str) else round((datetime.fromisoformat(time) - NOON).total_seconds() / 60)


def simulated(steps: int, key: int) -> hg.Record:
    """Record of the nodes that measure: their draws depend on no fusion."""
    return hg.simulate(hg.Network(PLANT, {name: chain().nodes[name] for name in "ac"}), steps, key)


@cache
def measured() -> dict[str, np.ndarray]:
    record = simulated(STEPS, 3)
    return {"b": np.zeros((STEPS, 0))} | {name: np.asarray(record.measurements[name]) for name in "ac"}


def some_lost(loss: float) -> np.ndarray:
    lost = np.random.default_rng(1).random((STEPS, 4)) < loss
    lost[:, 0] &= ~lost[:, 3]  # a node without a sensor sends once anything of the step came
    return lost


def agree(result: dict[str, dict[int, dict[str, list]]], lost: np.ndarray, network: hg.Network) -> None:
    """Compare with one run of all nodes in which the same got lost."""
    flags = np.where(lost, np.nan, 1.0)
    reports = {"a": flags[:, 1:2], "b": flags[:, [0, 3]], "c": flags[:, 2:3]}
    record = hg.run(network, measured(), reports={"mesh": reports})
    for name in "abc":
        expected = record.estimates[name]["mesh"]
        assert set(result[name]) == set(range(STEPS))
        for k in range(STEPS):
            item = result[name][k]
            assert item["claim"] == expected.claim
            # The same operations but for the order of sums.
            np.testing.assert_allclose(item["mean"], expected.mean[k], atol=1e-12)
            np.testing.assert_allclose(item["covariance"], expected.covariance[k], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("loss", [0.0, 0.4])
def test_services_that_exchange_messages_tell_what_one_run_tells(loss: float):
    lost = some_lost(loss)
    agree(exchanged(lost, services()), lost, chain(link=LOSSY))


@pytest.mark.slow
def test_means_that_nodes_quantize_themselves_are_those_of_one_run_also_where_some_are_beyond():
    lost = some_lost(0.3)
    result = exchanged(lost, services(quantized=True))
    agree(result, lost, chain(link=LOSSY, quantizer=QUANTIZER))
    beyond = [np.abs(np.array(item["mean"])).max() > 0.7 for item in result["a"].values()]
    assert 2 < sum(beyond) < STEPS - 2


@pytest.mark.slow
def test_times_may_be_dates_and_clocks_some_seconds_off():
    lost, off = some_lost(0.4), {"a": 0.0, "c": 7.3}

    def dated(node: str, k: int, values: list[float]) -> bytes:
        date = (NOON + timedelta(minutes=k, seconds=off[node] + (-1) ** k)).isoformat()
        return json.dumps({"node": node, "sequence": k, "time": date, "values": values}).encode()

    agree(exchanged(lost, services(step=60.0), dated), lost, chain(link=LOSSY))


@pytest.mark.slow
def test_each_node_reads_its_sensor_at_topics_of_others_and_a_node_without_one_counts_the_same_steps():
    sources = {
        "garden/a": hg.files.json_field("t", node="a", time="at", scale=0.1, step=60.0),
        "garden/c": [hg.files.json_field("t", node="c", time="at", step=60.0)],
    }
    settings = ServiceSettings(
        chain(link=LOSSY), Options(), sources=sources, broker=parse_address("mqtt://hub/rooms", {})
    )
    alone = {name: settings_of_node(settings, name) for name in "abc"}
    assert [sorted(item.sources or {}) for item in alone.values()] == [["garden/a"], [], ["garden/c"]]
    assert {item.options.step for item in alone.values()} == {60.0}
    fleets = {name: Fleet(NetworkProgram(item.network), item.options) for name, item in alone.items()}
    readers = {name: Translator(alone[name].sources, alone[name].network) for name in "ac"}

    def from_topic(node: str, k: int, values: list[float]) -> Message | str:
        scale = 10.0 if node == "a" else 1.0
        now = NOON + timedelta(minutes=k)
        content = {"t": scale * values[0], "at": now.isoformat()}
        (message,) = readers[node].read(f"garden/{node}", json.dumps(content).encode(), now)
        assert not readers[node].read(f"garden/{'ac'.replace(node, '')}", b'{"t": 1.0}', NOON)
        return message

    lost = some_lost(0.4)
    agree(exchanged(lost, fleets, from_topic), lost, chain(link=LOSSY))


@pytest.mark.slow
def test_a_node_whose_measurement_is_missing_sends_when_the_next_step_has_begun():
    nodes = {name: Service(item, InMemoryStore()) for name, item in services().items()}
    sent = []
    for k in range(4):
        waiting = [("a", json.dumps({"node": "a", "sequence": k, "time": k, "values": [0.1 * k]}).encode())]
        while waiting:
            to, body = waiting.pop(0)
            outputs = nodes[to].take([body])
            assert "refused" not in {output.kind for output in outputs}
            messages = [output for output in outputs if output.kind == "message"]
            sent += [(k, json.loads(output.body)) for output in messages if to == "c"]
            waiting += [(output.to, output.body) for output in messages]
    assert [(k, item["time"], item["values"][-1]) for k, item in sent] == [(k, k - 1, None) for k in (1, 2, 3)]


@pytest.mark.slow
def test_a_late_step_sends_its_own_message_and_none_again():
    """Steps of a node without measurements, heard from its neighbour: the third comes after the fourth."""
    node = Service(services()["c"], InMemoryStore())
    heard = [0.0] * (len(PLANT.states) * (len(PLANT.states) + 1))
    heard[len(PLANT.states) :: len(PLANT.states) + 1] = [1.0] * len(PLANT.states)
    sent = []
    for k in (0, 1, 3, 2, 4):
        body = json.dumps({"node": "b", "sequence": k, "time": k, "values": heard})
        outputs = node.take([body.encode()])
        assert "refused" not in {output.kind for output in outputs}
        sent.append([json.loads(output.body)["time"] for output in outputs if output.kind == "message"])
    assert sent == [[], [0], [1], [2], [3]]


@pytest.mark.parametrize(
    ("rule", "options", "message"),
    [
        (hg.fusion.MatrixWeights(), {}, "its neighbours' covariances alone .an intersection., got MatrixWeights"),
        (None, {"rounds": 2}, "one exchange a step, got several rounds"),
        (None, {"alpha": 0.5}, "one exchange a step, got events"),
    ],
)
def test_bad_input_what_no_node_can_do_by_itself_is_refused(rule, options, message):
    with pytest.raises(ValueError, match=message):
        node_network(chain(rule, **options), "a")


def test_bad_input_steps_of_any_length_are_no_steps_of_all_nodes():
    plant = hg.LinearPlant([[1.0]], lambda u: u[:1, None], [0.0], [[1.0]], input_matrix=[[0.0]], inputs=["dt"])
    sensor = hg.LinearSensor([[1.0]], 0.3)
    node = hg.Node(sensor, hg.perfect(), {"alone": hg.kalman_filter(plant, sensor)})
    item = hg.Fusion("alone", hg.fusion.TraceIntersection(), neighbours={"b": ["a"]})
    with pytest.raises(ValueError, match="a plant whose time counts steps, which all nodes share, got the input 'dt'"):
        node_network(hg.Network(plant, {"a": node, "b": None}, {"mesh": item}), "b")


def test_a_node_named_by_a_topic_or_a_field_is_read_by_its_own_process_alone():
    """Such sources were dropped without a word, and with them all measurements of the node."""
    sources = {
        "garden/+/t": hg.files.json_field("t", node=hg.files.Level(1), time="at", step=60.0),
        "house": hg.files.json_field("t", node=hg.files.Field("who", {"7": "c"}), time="at", step=60.0),
    }
    settings = ServiceSettings(
        chain(link=LOSSY), Options(), sources=sources, broker=parse_address("mqtt://hub/rooms", {})
    )
    alone = {name: settings_of_node(settings, name) for name in "abc"}
    assert [sorted(item.sources or {}) for item in alone.values()] == [list(sources), [], list(sources)]
    for name, other in ("ac", "ca"):
        reads = Translator(alone[name].sources, alone[name].network, alone[name].others)
        at = json.dumps({"t": 0.5, "at": NOON.isoformat(), "who": 7}).encode()
        (mine,) = reads.read(f"garden/{name}/t", at, NOON)
        assert mine.node == name and mine.values == [0.5]
        assert reads.read(f"garden/{other}/t", at, NOON) == []
        assert len(reads.read("house", at, NOON)) == (name == "c")
        (unknown,) = reads.read("garden/z/t", at, NOON)
        assert "expected one of" in unknown and "'z'" in unknown


def test_bad_input_no_node_no_broker():
    settings = ServiceSettings(chain(), Options())
    with pytest.raises(ValueError, match=r"--node: expected a broker between the nodes .* got none"):
        settings_of_node(settings, "a")
    settings = replace(settings, broker=parse_address("mqtt://hub/rooms", {}))
    with pytest.raises(ValueError, match="node: expected one of fusion 'mesh': a, b, c, got 'd'"):
        settings_of_node(settings, "d")
    assert str(settings_of_node(settings, "b").broker) == "mqtt://hub:1883/rooms/b"


class Process:
    """`heliograph serve --node NAME`, with a store of its own."""

    def __init__(self, folder: Path, node: str, broker: str):
        (folder / "network.py").write_text("from tests.serving.neighbours import chain\nnetwork = chain()\n")
        command = [sys.executable, "-m", "heliograph", "serve", "network.py", "--node", node, "--broker", broker]
        environment = os.environ | {"PYTHONPATH": f"{ROOT / 'src'}:{ROOT / 'studies'}:{ROOT}"}
        self.log = open(folder / f"{node}.log", "ab")  # noqa: SIM115
        self.process = subprocess.Popen(command, cwd=folder, env=environment, stdout=self.log, stderr=self.log)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        self.log.close()


@pytest.mark.parametrize("kind", [pytest.param(k, marks=pytest.mark.real(k.upper())) for k in ("mqtt", "nats")])
def test_of_three_processes_one_is_killed_and_catches_up(kind: str, tmp_path: Path):
    """Without the messages of the steps that it missed the node without a sensor would claim three times as much."""
    import nats

    from heliograph_studies.live.server import Server
    from tests.serving.broker_servers import at, published, sent

    steps, results = 500, dict[tuple[str, str], dict[int, dict[str, list]]]()
    record = simulated(steps, 5)

    async def taken(message: "nats.aio.msg.Msg") -> None:
        content, (_, node, _, what, _) = json.loads(message.data), message.subject.split(".")
        if what in ("provisional", "final"):
            results.setdefault((node, what), {})[int(content["time"])] = content["estimates"]["fused"]["mesh"]

    async def until(ready: Callable[[], bool]) -> None:
        async with asyncio.timeout(90):
            while not ready():
                await asyncio.sleep(0.05)

    def newest(node: str, what: str = "provisional") -> int:
        return max(results.get((node, what), {-1: {}}))

    async def measure(k: int) -> None:
        for node in "ac":
            z = np.asarray(record.measurements[node])[k].tolist()
            body = json.dumps({"node": node, "sequence": k, "time": k, "values": z}).encode()
            where = at(server, kind, f"chain/{node}")
            if kind == "mqtt":
                await asyncio.to_thread(published, where, [body], "_")
            else:
                await sent(replace(where, topic=f"chain.{node}"), [body], "")

    async def work() -> tuple[int, int]:
        client = await nats.connect(f"nats://127.0.0.1:{server.nats}")
        await client.subscribe("chain.*.out.*.*", cb=taken)
        if kind == "nats":  # its streams are there once the services are
            stream = client.jetstream()
            names = ["chain-a", "chain-b", "chain-c"]
            await until_async(lambda: all_there(stream, names))
        k = 0
        while min(map(newest, "abc")) < 3:
            await measure(k)
            await asyncio.sleep(0.25)
            k += 1
        # One is killed; the others go on.
        processes["b"].kill()
        gone = k
        for k in range(gone, gone + 6):
            await measure(k)
        await until(lambda: newest("a") == newest("c") == gone + 5)
        assert newest("b") < gone
        processes["b"] = Process(tmp_path, "b", broker)
        await until(lambda: newest("b") >= gone)
        for k in range(gone + 6, gone + 20):
            await measure(k)
            await asyncio.sleep(0.05)
        await until(lambda: newest("b") == gone + 19 and newest("b", "final") >= gone + 6)
        await client.close()
        return gone, gone + 20

    with Server(tmp_path) as server:
        broker = f"{kind}://127.0.0.1:{getattr(server, kind)}/chain"
        processes = {name: Process(tmp_path, name, broker) for name in "abc"}
        try:
            gone, end = asyncio.run(work())
        finally:
            for process in processes.values():
                process.kill()
    traces = {k: np.trace(item["covariance"]) for k, item in results["b", "final"].items()}
    missed = [traces[k] for k in range(gone, gone + 6)]
    assert max(missed) < 1.5 * traces[gone - 1], traces
    for (node, _), known in results.items():
        last = known[max(known)]
        assert {item["claim"] for item in known.values()} == {"upper"}
        off = record.truth[max(known)] - np.array(last["mean"])
        # Chi-squared of two degrees of freedom, beyond which one in a hundred thousand lies.
        assert off @ np.linalg.solve(last["covariance"], off) < 23, node
    assert end <= steps


async def all_there(stream: "nats.js.JetStreamContext", names: list[str]) -> bool:
    known = [item.config.name for item in await stream.streams_info()]
    return set(names) <= set(known)


async def until_async(ready: Callable[[], object]) -> None:
    async with asyncio.timeout(90):
        while not await ready():  # type: ignore[misc]
            await asyncio.sleep(0.1)
