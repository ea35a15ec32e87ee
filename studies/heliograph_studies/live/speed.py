"""How many steps a second: from lines in memory, and through real brokers with every commit on disk."""

import asyncio
import json
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter

import nats
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from heliograph.live.fleet import Fleet
from heliograph.live.fleet_options import Options
from heliograph.live.network_step_program import NetworkProgram
from heliograph.serving import make_transport
from heliograph.serving.brokers.broker_address import Address, parse_address
from heliograph.serving.message import Payload
from heliograph.serving.output import Output
from heliograph.serving.service import Service
from heliograph.serving.service_loop import serve_until
from heliograph.serving.storage.store import Store
from heliograph.serving.storage.store_protocol import InMemoryStore, identity
from heliograph_studies.live.server import Server

PLANTS = 100  # mowers on the same drive, each a little after the one before
BATCH = 1000  # lines that are taken together from memory


def many_plants(lines: Sequence[bytes], count: int) -> list[bytes]:
    """The first messages of one mower as those of many, `count` in all."""
    results = [json.loads(line) for line in lines[: count // PLANTS]]
    return [json.dumps(item | {"plant": f"mower {i}"}).encode() for item in results for i in range(PLANTS)]


class Counted:
    """A service that stops after so many messages, and how long they took from the first batch on."""

    def __init__(self, service: Service, count: int, stop: asyncio.Event):
        self.service, self.left, self.stop, self.loop = service, count, stop, asyncio.get_running_loop()
        self.begun = self.ended = 0.0

    def unpublished(self) -> list[Output]:
        """As the service says."""
        return self.service.unpublished()

    def take(self, payloads: Sequence[Payload]) -> list[Output]:
        """As the service does."""
        self.begun = self.begun or perf_counter()
        outputs = self.service.take(payloads)
        self.left -= len(payloads)
        self.ended = perf_counter()
        return outputs

    def published(self, outputs: Sequence[Output]) -> None:
        """As the service does; the last batch is over when it was published."""
        self.service.published(outputs)
        self.ended = perf_counter()
        if self.left <= 0:
            self.loop.call_soon_threadsafe(self.stop.set)

    def finish(self, ended: bool) -> list[Output]:
        """As the service does."""
        return self.service.finish(ended)


def in_memory(program: NetworkProgram, options: Options, lines: Sequence[bytes]) -> float:
    """Steps a second of a service that keeps nothing."""
    service = Service(Fleet(program, options), InMemoryStore())
    begun = perf_counter()
    for i in range(0, len(lines), BATCH):
        service.take(lines[i : i + BATCH])
    return len(lines) / (perf_counter() - begun)


async def through(
    kind: str, folder: Path, server: Server, program: NetworkProgram, options: Options, lines: Sequence[bytes]
) -> float:
    """Steps a second through a broker that has the messages already, estimates published to it, commits on disk."""
    where = parse_address(f"{kind}://127.0.0.1:{getattr(server, kind)}/speed-{kind}", {})
    await _subscribed(where)
    await (_sent(where, lines) if kind == "nats" else asyncio.to_thread(_published, where, lines))
    fleet, stop = Fleet(program, options), asyncio.Event()
    store = Store(str(folder / f"{kind}.sqlite"), identity(fleet))
    counted = Counted(Service(fleet, store), len(lines), stop)
    try:
        await asyncio.wait_for(serve_until(stop, counted, make_transport(where)), 300)
    finally:
        store.close()
    return len(lines) / (counted.ended - counted.begun)


async def _subscribed(where: Address) -> None:
    """Have the broker keep what will be sent: a stream, or a session."""
    transport = make_transport(where)
    try:
        await asyncio.wait_for(transport.receive(), 1.0)
    except TimeoutError:
        await transport.close()


async def _sent(where: Address, lines: Sequence[bytes]) -> None:
    client = await nats.connect(f"nats://{where.host}:{where.port}")
    stream = client.jetstream(timeout=60)
    for i in range(0, len(lines), BATCH):
        subject = f"{where.topic}.in.mower"
        await asyncio.gather(*[await stream.publish_async(subject, line) for line in lines[i : i + BATCH]])
    await client.close()


def _published(where: Address, lines: Sequence[bytes]) -> None:
    client = Client(CallbackAPIVersion.VERSION2)
    client.max_inflight_messages_set(BATCH)
    client.connect(where.host, where.port)
    client.loop_start()
    for item in [client.publish(f"{where.topic}/in/mower", line, 1) for line in lines]:
        item.wait_for_publish(60)
    client.disconnect()
    client.loop_stop()
