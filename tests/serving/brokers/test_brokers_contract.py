"""Both kinds of brokers keep the contract of transports, and have what was published when they say so."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import pytest

pytest.importorskip("nats")
pytest.importorskip("paho")
import nats
import nats.js.errors
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from heliograph.serving import make_transport
from heliograph.serving.brokers.transport import Transport
from heliograph.serving.brokers.transport_contract import check_transport
from heliograph.serving.output import Output
from heliograph_studies.live.server import Server
from tests.serving.broker_servers import KINDS, at, published, running, sent, silent


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    yield from running(tmp_path_factory.mktemp("server"))


class OverNats:
    """A service through JetStream, and the sensor and the reader on the other side; its subjects are topics of MQTT."""

    def __init__(self, server: Server):
        self.where, self.url = at(server, "nats", "stream"), f"nats://127.0.0.1:{server.nats}"

    def transport(self) -> Transport:
        return make_transport(self.where)

    async def send(self, bodies: Sequence[bytes]) -> None:
        try:
            await sent(self.where, list(bodies))
        except nats.js.errors.NoStreamResponseError:  # no service was there yet
            return

    async def published(self) -> list[bytes]:
        client = await nats.connect(self.url)
        reader = await client.jetstream().subscribe("stream.out.*.*", ordered_consumer=True)
        results = []
        with contextlib.suppress(nats.errors.TimeoutError):
            while True:
                results.append((await reader.next_msg(0.5)).data)
        await client.close()
        return results


class OverMqtt:
    """The same through MQTT."""

    def __init__(self, server: Server):
        self.where, self.received = at(server, "mqtt", "session"), list[bytes]()
        self.reader = Client(CallbackAPIVersion.VERSION2)
        self.reader.on_message = lambda client, data, message: self.received.append(message.payload)
        self.reader.connect(self.where.host, self.where.port)
        self.reader.subscribe("session/out/#", 1)
        self.reader.loop_start()

    def transport(self) -> Transport:
        return make_transport(self.where)

    async def send(self, bodies: Sequence[bytes]) -> None:
        await asyncio.to_thread(published, self.where, list(bodies))

    async def published(self) -> list[bytes]:
        return list(self.received)


@pytest.fixture(scope="module")
def checks(server: Server) -> Iterator[dict[str, Future[bool]]]:
    """Checks of both kinds, of which each waits for silence: side by side."""
    over_mqtt = OverMqtt(server)
    with ThreadPoolExecutor(2) as pool:
        yield {
            kind: pool.submit(check_transport, broker)
            for kind, broker in (("nats", OverNats(server)), ("mqtt", over_mqtt))
        }
    over_mqtt.reader.disconnect()
    over_mqtt.reader.loop_stop()


@pytest.mark.real("NATS")
def test_jetstream_keeps_the_contract_and_sends_again_in_order(checks: dict[str, Future[bool]]):
    assert checks["nats"].result()


@pytest.mark.real("MQTT")
def test_mqtt_keeps_the_contract(checks: dict[str, Future[bool]]):
    checks["mqtt"].result()  # this server sends what is new first


@pytest.mark.parametrize("kind", KINDS)
def test_outputs_are_on_the_broker_when_publish_returns(server: Server, kind: str):
    outputs = [Output(i, "a.b", "final", str(i).encode()) for i in range(300)]

    async def observe(work: Callable[[], Awaitable[None]]) -> list[bytes]:
        """What both kinds of clients find, since a topic is a subject."""
        client = await nats.connect(f"nats://127.0.0.1:{server.nats}")
        subscription = await client.subscribe(f"out{kind}.out.*.a%2Eb")
        await client.flush()
        await work()
        results = [(await subscription.next_msg(5)).data for _ in range(len(outputs) + 1)]
        await client.close()
        return results

    async def work() -> None:
        transport = make_transport(at(server, kind, f"out{kind}"))
        if kind == "nats":
            assert await silent(transport)
        else:  # what is provisional is lost until there is a connection
            async with asyncio.timeout(30):
                while not transport._writer.client.is_connected():
                    await asyncio.sleep(0.01)
        result = await observe(lambda: transport.publish([Output(None, "a.b", "provisional", b"now"), *outputs]))
        assert result == [b"now", *[output.body for output in outputs]]
        if kind == "nats":
            await transport.publish(outputs)  # published again, as after a restart
            info = await transport._client.jetstream().stream_info("outnats-out")
            assert info.state.messages == len(outputs)
        await transport.close()

    asyncio.run(work())
