"""Topics that others make: zigbee2mqtt, The Things Network and mosquitto_pub, by the sources of a network's file."""

import asyncio
import json
import queue
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

pytest.importorskip("nats")
pytest.importorskip("paho")
import nats
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

import heliograph as hg
from heliograph import cli
from heliograph.serving import LineReader, make_transport
from heliograph.serving.brokers.source_translator import Translator
from heliograph.serving.message import Message
from heliograph_studies.live.server import Server, free_port
from tests.serving.broker_servers import KINDS, at, running

NETWORK = """
import jax.numpy as jnp
import heliograph as hg

plant = hg.Plant(
    lambda x, u: x, lambda u: 1e-4 * jnp.eye(1) * u[0], [20.0], [[25.0]], states=["temperature"], inputs=["dt"]
)
sensor = hg.Sensor(lambda x: x, noise=0.04, outputs=["temperature"])
node = hg.Node(sensor, hg.perfect(), {"filter": hg.cubature_filter(plant, sensor, hg.perfect())})
network = hg.Network(plant, {"garden": node})
sources = {
    "zigbee2mqtt/garden": hg.files.json_field("temperature", node="garden", output="temperature"),
    "v3/farm@ttn/devices/+/up": hg.files.json_field(
        "uplink_message.decoded_payload.temp_f", node="garden", scale=5 / 9, offset=-160 / 9,
        time="received_at", sequence="uplink_message.f_cnt", plant="end_device_ids.device_id",
    ),
    "shed/temperature": hg.files.json_field("", node="garden"),
}
"""
UPLINK = {
    "end_device_ids": {"device_id": "field-7"},
    "received_at": "2026-11-20T10:00:00.123456789Z",
    "uplink_message": {"f_cnt": 42, "decoded_payload": {"temp_f": 50.0}},
}
NOW = datetime(2026, 11, 24, 19, 0, tzinfo=UTC)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    yield from running(tmp_path_factory.mktemp("server"))


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("network") / "net.py"
    path.write_text(NETWORK)
    return path


@pytest.fixture
def translator(file: Path) -> Translator:
    from tests.files.module import load_module

    network, module = load_module(str(file))
    return Translator(module["sources"], network)


def test_arrival_dates_what_has_no_time_and_counts_it(translator):
    payload = b'{"temperature": 19.5, "battery": 100, "linkquality": 87}'
    first, second = (translator.read("zigbee2mqtt/garden", payload, NOW + timedelta(seconds=k))[0] for k in range(2))
    assert (first.node, first.sequence, first.time, first.values) == ("garden", 0, NOW, [19.5])
    assert (second.sequence, second.time) == (1, NOW + timedelta(seconds=1))
    assert translator.read("shed/temperature", b"21.5", NOW)[0].values == [21.5]


def test_an_uplink_keeps_its_time_count_and_device(translator):
    (message,) = translator.read("v3/farm@ttn/devices/field-7/up", json.dumps(UPLINK).encode(), NOW)
    assert isinstance(message, Message) and (message.plant, message.sequence) == ("field-7", 42)
    assert message.time == datetime(2026, 11, 20, 10, 0, 0, 123456, UTC)
    assert message.values == pytest.approx([10.0], rel=1e-14)  # rounding


@pytest.mark.parametrize("zone", ["", "Z"])
def test_dates_without_a_zone_are_said_once(zone, caplog):
    plant = hg.Plant(lambda x, u: x, lambda u: u[:1, None], [0.0], 1.0, states=["x"], inputs=["dt"])
    network = hg.Network(plant, {"a": hg.Node(hg.LinearSensor([[1.0]], 0.1), hg.perfect(), {})})
    line = f'{{"node":"a","sequence":0,"time":"2026-10-25T02:00:00{zone}","values":[1]}}'
    for lines in ([line], ["node,sequence,time,values", f"a,0,2026-10-25T02:00:00{zone},1"],
                  ["time,y0", f"2026-10-25T02:00:00{zone},1"]):  # fmt: skip
        caplog.clear()
        reader = LineReader(network)
        for _ in range(2):
            assert len(reader.read([text.encode() for text in lines])) <= 1
            lines = lines[-1:]
        assert ("standard input: dates without a zone are taken as UTC" in caplog.text) == (zone == "")
        assert len(caplog.records) == (zone == "")


def test_stored_and_unknown_messages_are_counted(translator):
    assert translator.read("zigbee2mqtt/garden", b'{"temperature": 1}', NOW, stored=True) == []
    assert len(translator.read("v3/farm@ttn/devices/a/up", json.dumps(UPLINK).encode(), NOW, stored=True)) == 1
    assert translator.read("zigbee2mqtt/attic", b'{"temperature": 1}', NOW) == []
    assert translator.left_out() == [
        "topics that are not among the sources: zigbee2mqtt/attic (1)",
        "1 stored messages were left out: without time= they have no date",
    ]


@pytest.mark.parametrize(
    ("payload", "line"),
    [
        (b"\xff", "zigbee2mqtt/garden: expected JSON, got b'\\xff'"),
        (b"{}", "zigbee2mqtt/garden: expected a field 'temperature', got no 'temperature' in an empty message"),
        (b'{"temperature": "warm"}', "zigbee2mqtt/garden, field 'temperature': expected a number"),
        (b"[" * 100_000, "zigbee2mqtt/garden: expected JSON"),
    ],
)
def test_what_cannot_be_read_is_one_line(translator, payload, line):
    (said,) = translator.read("zigbee2mqtt/garden", payload, NOW)
    assert isinstance(said, str) and said.startswith(line) and "\n" not in said


def test_lines_with_a_topic_are_those_of_mosquitto_sub(translator, file):
    from tests.files.module import load_module

    lines = LineReader(load_module(str(file))[0], translator)
    (message,) = lines.read([b'{"topic": "shed/temperature", "payload": "21.5", "retain": 0}'])
    (other,) = lines.read([b'{"topic": "zigbee2mqtt/garden", "payload": {"temperature": 3}}'])
    assert message.values == [21.5] and other.values == [3.0]
    (dated,) = lines.read([b"1700000000.25 shed/temperature 21.5"])  # mosquitto_sub -F "%U %t %p"
    assert isinstance(dated, Message) and dated.time == datetime(2023, 11, 14, 22, 13, 20, 250_000, UTC)
    (nobody, none) = lines.read([b'{"node": "garden"}', b"x"])
    assert (
        nobody == "standard input, line 4: expected a message in our own form, or a topic of the sources, got neither"
    )
    assert none.startswith("standard input, line 5: expected JSON, got 'x'")


def test_lines_without_a_topic_are_of_the_only_one(file):
    """`serve < lines.jsonl` reads what `run --measurements lines.jsonl` reads; with several topics none is guessed."""
    from tests.files.module import load_module

    network, _ = load_module(str(file))
    source = hg.files.json_field("t", node="garden", time="time", sequence=hg.files.Count("count", 8))
    alone = LineReader(network, Translator({"lines.jsonl": source}, network))
    (message,) = alone.read([b'{"t": 20.5, "time": 1700000000, "count": 255}'])
    assert isinstance(message, Message) and (message.sequence, message.values) == (255, [20.5])
    (bad,) = alone.read([b'{"t": "warm", "time": 1700000001}'])
    assert isinstance(bad, str) and bad.startswith("standard input, line 2, field 't': expected a number")
    own = b'{"node": "garden", "sequence": 0, "time": 1, "values": [1]}'
    (event,) = alone.read([own])
    assert (event.node, event.sequence, event.values) == ("garden", 0, [1.0])
    table = {"lines.jsonl": source, "other.jsonl": source}
    several = LineReader(network, Translator(table, network))
    (neither,) = several.read([b'{"t": 20.5, "time": 1700000000}'])
    assert "expected a message in our own form, or a topic of the sources, got neither" in neither
    named = LineReader(network, Translator(table, network), Path("here/other.jsonl"))
    assert named.read([b'{"t": 20.5, "time": 1700000001}', b'{"t": 20.4, "time": 1700000000}']) == []
    assert [message.values for message in named.end()] == [[20.4], [20.5]]  # of a file, in the order of their times


def test_sources_and_parts_exclude_each_other():
    from heliograph.live.fleet_options import Options
    from heliograph.serving.brokers.broker_address import parse_address
    from heliograph.serving.settings import ServiceSettings

    plant, sensor = hg.LinearPlant([[1.0]], [[1.0]], [0.0], [[1.0]]), hg.LinearSensor([[1.0]], 1.0)
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {})})
    with pytest.raises(ValueError, match="--parts: expected messages in our own form"):
        ServiceSettings(
            network, Options(1.0), "s.db", broker=parse_address("nats://a", {}), parts=2, sources={"t": "f"}
        )


@pytest.mark.real("NATS")
def test_subjects_of_nats_are_the_same_sources(server, translator):
    async def work() -> None:
        where = at(server, "nats", "field")
        transport = make_transport(where, translator=translator)
        try:
            await asyncio.wait_for(transport._open_reader(), 20)
            client = await nats.connect(f"nats://{where.host}:{where.port}")
            await client.publish("zigbee2mqtt.garden", b'{"temperature": 18.0}')
            await client.publish("v3.farm@ttn.devices.field-7.up", json.dumps(UPLINK).encode())
            await client.publish("field.in.a", b"as it is")
            await client.close()
            payloads: list[object] = []
            while len(payloads) < 3:
                batch = await asyncio.wait_for(transport.receive(), 20)
                payloads += batch.payloads
                await batch.acknowledge()
        finally:
            await transport.close()
        assert payloads[0].values == [18.0] and payloads[1].plant == "field-7" and payloads[2] == b"as it is"

    asyncio.run(work())


@pytest.mark.real("MQTT")
def test_the_stored_word_of_a_device_holds_for_a_service_that_begins_later(server, file):
    """zigbee2mqtt stores "offline" at the broker; a service that comes afterwards leaves values out until "online"."""
    from tests.files.module import load_module

    network, _ = load_module(str(file))
    here = hg.files.Available("den2mqtt/+/availability")
    source = hg.files.json_field("temperature", "garden", plant=hg.files.Level(1), where=here)
    translator, where = Translator({"den2mqtt/+": source}, network), at(server, "mqtt", "den")

    async def until(holds):
        for _ in range(400):
            if holds():
                return
            await asyncio.sleep(0.05)

    async def work() -> None:
        client = Client(CallbackAPIVersion.VERSION2)
        client.connect(where.host, where.port)
        client.loop_start()
        client.publish("den2mqtt/a/availability", b"offline", 1, retain=True).wait_for_publish(20)
        transport = make_transport(where, translator=translator)
        read = asyncio.ensure_future(transport.receive())
        try:
            # Brokers keep the order within a topic only: the word, the values, and "online" wait for each other.
            await until(lambda: not translator.sources.notes)
            for payload in (b'{"temperature": 90.0}', b'{"temperature": 91.0}'):
                client.publish("den2mqtt/a", payload, 1)
            await until(lambda: translator.sources.offline["den2mqtt/a"] == 2)
            client.publish("den2mqtt/a/availability", b'{"state": "online"}', 1, retain=True)
            await until(lambda: not translator.sources.device_statuses._offline)
            client.publish("den2mqtt/a", b'{"temperature": 18.0}', 1)
            batch = await asyncio.wait_for(read, 20)
            assert [message.values for message in batch.payloads] == [[18.0]]
            await batch.acknowledge()
        finally:
            client.publish("den2mqtt/a/availability", b"", 1, retain=True).wait_for_publish(20)
            await transport.close()
            client.disconnect()
            client.loop_stop()
        assert translator.left_out() == ["messages left out, of devices offline: den2mqtt/a (2)"]

    asyncio.run(work())


@pytest.mark.parametrize("kind", KINDS)
def test_inspect_lists_the_topics_of_a_broker(server, capsys, kind):
    """Forty messages a second while it listens: their rate, the lateness of their date, and sources that run."""
    where, stop = at(server, kind, "x"), threading.Event()

    def send() -> None:
        async def work() -> None:
            client = await nats.connect(f"nats://127.0.0.1:{server.nats}")
            for k in range(1000):
                measured = (datetime.now(UTC) - timedelta(seconds=2)).isoformat()
                payload = json.dumps({"climate": {"temperature": 20 + k, "note": "ok"}, "last_seen": measured})
                await client.publish("zigbee2mqtt.attic", payload.encode())
                await client.publish("zigbee2mqtt.door", b"open")
                await asyncio.sleep(0.025)
                if stop.is_set():
                    break
            await client.close()

        asyncio.run(work())

    thread = threading.Thread(target=send)
    thread.start()
    try:
        assert cli.main(["inspect", f"{kind}://{where.host}:{where.port}", "--seconds", "1"]) == 0
    finally:
        stop.set()
        thread.join()
    said = capsys.readouterr().out
    row = re.search(r"zigbee2mqtt/attic +JSON +(\d+) +([0-9.]+) Hz +\S+ s +([0-9.]+)", said)
    assert row is not None and int(row[1]) >= 10 and float(row[2]) < 50 and 2 <= float(row[3]) < 5
    assert re.search(r"zigbee2mqtt/door +no JSON", said)
    scope: dict[str, object] = {"hg": hg}
    exec(said[said.index("sources = {") :], scope)
    assert scope["sources"] == {
        "zigbee2mqtt/attic": hg.files.json_field("climate.temperature", "NODE", "OUTPUT", time="last_seen")
    }


@pytest.mark.parametrize("kind", ["nats", "mqtt"])
def test_a_broker_that_is_not_there_is_one_line(capsys, monkeypatch, kind):
    monkeypatch.setattr("heliograph.serving.brokers.broker_inspection.WAIT", 1.0)
    url = f"{kind}://127.0.0.1:{free_port()}"
    assert cli.main(["inspect", url]) == 2
    said = capsys.readouterr().err
    assert re.search(rf"broker {url}/\S*: expected a connection, got \S+", said) and said.count("\n") == 1


@pytest.mark.real("MQTT")
def test_the_service_takes_a_topic_of_zigbee2mqtt_without_glue(server, file, tmp_path):
    """The command itself, a real broker, and a payload as zigbee2mqtt sends it: an estimate comes out."""
    where, bodies = at(server, "mqtt", "home"), queue.Queue()
    client = Client(CallbackAPIVersion.VERSION2)
    client.on_message = lambda client, data, message: bodies.put((message.topic, message.payload))
    client.connect(where.host, where.port)
    client.loop_start()
    client.subscribe("home/out/#", 1)
    command = [sys.executable, "-m", "heliograph", "serve", str(file), "--store", "none", "--broker", str(where)]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    payload = json.dumps({"battery": 98, "linkquality": 120, "temperature": 17.25})
    try:
        # Until the service listens, what is sent is lost, as of any sensor.
        for _ in range(120):
            client.publish("zigbee2mqtt/garden", payload, 0)
            try:
                topic, body = bodies.get(timeout=1.0)
                break
            except queue.Empty:
                continue
        client.publish("zigbee2mqtt/garden", b'{"temperature": "warm"}', 0)
        refused = None
        for _ in range(60):
            name, content = bodies.get(timeout=20)
            if name.startswith("home/out/refused"):
                refused = json.loads(content)
                break
    finally:
        process.terminate()
        _, said = process.communicate(timeout=60)
        client.disconnect()
        client.loop_stop()
    estimate = json.loads(body)["estimates"]["garden"]["filter"]
    assert topic == "home/out/provisional/_" and estimate["mean"] == pytest.approx([17.25], abs=0.1)
    assert refused is not None and refused["reason"] == "malformed" and "field 'temperature'" in refused["detail"]
    assert process.returncode == 0, said
