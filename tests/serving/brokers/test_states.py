"""States on topics of their own: flat JSON that telegraf reads, what Home Assistant is told, and online and offline."""

import asyncio
import json
import subprocess
import sys
import time

import pytest

pytest.importorskip("paho")
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from heliograph import cli
from heliograph.serving import Output, StatePublishing, StateTopics
from tests.serving.broker_servers import at, running

NETWORK = """
import heliograph as hg

plant, sensor = hg.LinearPlant([[1.0]], 0.01, [20.0], 1.0), hg.LinearSensor([[1.0]], 0.04)
network = hg.Network(plant, {"n": hg.Node(sensor, hg.perfect(), {"k": hg.kalman_filter(plant, sensor)})})
"""
STATES = ["level", "flow"]
ESTIMATE = {
    "kind": "provisional",
    "plant": "shed 1",
    "time": "2026-11-29T10:00:00.5Z",
    "estimates": {
        "gate": {
            "kalman": {"mean": [1.5, None], "covariance": [[0.04, 0.0], [0.0, None]], "claim": "exact"},
            "bare": {"mean": [1.0, 2.0], "covariance": None, "claim": "none"},
        }
    },
    "senders": {"gate": {"dead": True}},
}


class Kept:
    """A client that keeps the last message of each topic, and whether the broker had it stored."""

    def __init__(self, where):
        self.messages = {}
        self.client = Client(CallbackAPIVersion.VERSION2)
        self.client.on_message = self._keep
        self.client.on_connect = lambda client, *_: client.subscribe("#", 1)
        self.client.connect(where.host, where.port)
        self.client.loop_start()

    def _keep(self, client, data, message):
        self.messages[message.topic] = (bytes(message.payload), bool(message.retain))

    def wait(self, condition):
        last = time.monotonic() + 60  # a service has to compile first
        while not condition(self.messages):
            assert time.monotonic() < last, self.messages
            time.sleep(0.01)
        return dict(self.messages)

    def close(self):
        self.client.disconnect()
        self.client.loop_stop()


class Nothing:
    """A transport of nothing."""

    def __init__(self):
        self.published = []

    async def receive(self):
        return None

    async def publish(self, outputs):
        self.published += outputs

    async def close(self):
        pass


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    yield from running(tmp_path_factory.mktemp("server"))


@pytest.mark.real("MQTT")
def test_states_are_kept_by_the_broker_for_whoever_comes_later(server):
    where = at(server, "mqtt", "garden/tank")
    outputs = [
        Output(None, "shed 1", "provisional", json.dumps(ESTIMATE | {"time": 1.0}).encode()),
        Output(None, "shed 1", "provisional", json.dumps(ESTIMATE).encode()),
        Output(3, "shed 1", "final", b"{}"),
    ]
    inner = Nothing()

    async def work():
        transport = StatePublishing(inner, StateTopics(where, "homeassistant"), STATES)
        early = Kept(where)
        early.wait(lambda got: got.get("garden/tank/availability", (b"",))[0] == b"online")
        await transport.publish(outputs)
        last = "garden/tank/state/shed%201/gate/bare/flow"
        early.wait(lambda got: last in got)
        late = Kept(where)
        kept = late.wait(lambda got: len(got) >= 15)
        await transport.close()
        early.wait(lambda got: got["garden/tank/availability"][0] == b"offline")
        early.close()
        late.close()
        return kept

    kept = asyncio.run(work())
    assert inner.published == outputs and all(retained for _, retained in kept.values())
    flat = {topic.rpartition("gate/")[2]: json.loads(body) for topic, (body, _) in kept.items() if "/state/" in topic}
    moment = 1795946400.5
    assert flat == {
        "kalman/level": {"value": 1.5, "deviation": 0.2, "dead": 1, "time": moment},
        "kalman/flow": {"value": None, "deviation": None, "dead": 1, "time": moment},
        "bare/level": {"value": 1.0, "deviation": None, "dead": 1, "time": moment},
        "bare/flow": {"value": 2.0, "deviation": None, "dead": 1, "time": moment},
    }
    # What Home Assistant is told: three entities a state, of one device.
    told = {topic: json.loads(body) for topic, (body, _) in kept.items() if topic.startswith("homeassistant/")}
    assert len(told) == 12 and len({said["unique_id"] for said in told.values()}) == 12
    said = told["homeassistant/sensor/garden-tank-state-shed_201-gate-kalman-level-value/config"]
    assert said["state_topic"] == "garden/tank/state/shed%201/gate/kalman/level" and said["state_topic"] in kept
    assert said["value_template"] == "{{ value_json.value }}" and said["state_class"] == "measurement"
    assert said["availability_topic"] == "garden/tank/availability" and said["device"]["name"] == "shed 1"
    dead = told["homeassistant/binary_sensor/garden-tank-state-shed_201-gate-bare-flow-dead/config"]
    assert (dead["payload_on"], dead["device_class"], dead["value_template"]) == (
        "1",
        "problem",
        "{{ value_json.dead }}",
    )


@pytest.mark.real("MQTT")
def test_a_service_that_is_killed_is_offline(server, tmp_path):
    where = at(server, "mqtt", "well")
    (tmp_path / "net.py").write_text(NETWORK)
    states = f"mqtt://{where.host}:{where.port}/well"
    command = [sys.executable, "-m", "heliograph", "serve", "net.py", "--store", "none", "--states", states]
    process = subprocess.Popen(command, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
    kept = Kept(where)
    try:
        process.stdin.write(b'{"node": "n", "sequence": 0, "time": 0, "values": [20.5]}\n')
        process.stdin.flush()
        topic = "well/state/_/n/k/x0"
        got = kept.wait(lambda got: {topic, "well/availability"} <= got.keys())  # in either order
        message = json.loads(got[topic][0])
        assert 20 < message["value"] < 20.5 and 0 < message["deviation"] < 0.2 and message["dead"] == 0
        assert got["well/availability"][0] == b"online"
    finally:
        process.kill()
        process.wait()
        process.stdin.close()
    kept.wait(lambda got: got["well/availability"][0] == b"offline")
    kept.close()


def test_options_that_do_not_fit_are_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "net.py").write_text(NETWORK)
    for options, said in {
        ("--states", "nats://host/t"): "--states: expected mqtt:// or mqtts://host:port/topic, got nats://host:4222/t",
        ("--discovery", "homeassistant"): "--discovery: expected a broker for the states",
        ("--states", "mqtt://host", "--discovery", "a/#"): "--discovery: expected words between slashes",
        ("--states", "mqtt://host", "--parts", "2"): "--states: expected one process, whose end says offline",
    }.items():
        assert cli.main(["serve", "net.py", *options]) == 2
        assert said in capsys.readouterr().err
