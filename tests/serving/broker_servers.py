"""A server of both kinds of brokers, and what is sent to it and received of it."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("nats")
pytest.importorskip("paho")
import nats
import nats.js.errors
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from heliograph.serving import make_transport
from heliograph.serving.brokers.broker_address import Address, parse_address
from heliograph.serving.brokers.transport import Part, Transport, encode_name
from heliograph_studies.live.server import Server

KINDS = [pytest.param(kind, marks=pytest.mark.real(part)) for kind, part in (("nats", "NATS"), ("mqtt", "MQTT"))]


def running(folder: Path) -> Iterator[Server]:
    """A server while a module's tests run."""
    item = Server(folder)
    item.start()
    yield item
    item.kill()


def at(server: Server, kind: str, topic: str) -> Address:
    return parse_address(f"{kind}://127.0.0.1:{getattr(server, kind)}/{topic}", {})


async def received(transport: Transport, count: int, acknowledge: bool = True) -> list[bytes]:
    """At least so many messages."""
    results: list[bytes] = []
    while len(results) < count:
        batch = await asyncio.wait_for(transport.receive(), 20)
        assert batch is not None
        results += batch.payloads
        if acknowledge:
            await batch.acknowledge()
    return results


async def silent(transport: Transport, seconds: float = 0.3) -> bool:
    try:
        await asyncio.wait_for(transport.receive(), seconds)
    except TimeoutError:
        return True
    return False


async def sent(where: Address, bodies: list[bytes], plant: str = "a") -> None:
    client = await nats.connect(f"nats://{where.host}:{where.port}")
    stream = client.jetstream(timeout=60)
    try:
        await asyncio.gather(
            *[await stream.publish_async(f"{where.topic}.in.{encode_name(plant)}", body) for body in bodies]
        )
    finally:
        await client.close()


def published(where: Address, bodies: list[bytes], below: str = "a") -> None:
    client = Client(CallbackAPIVersion.VERSION2)
    client.connect(where.host, where.port)
    client.loop_start()
    for item in [client.publish(f"{where.topic}/in/{below}", body, 1) for body in bodies]:
        item.wait_for_publish(10)
    client.disconnect()
    client.loop_stop()


def numbered(start: int, stop: int) -> list[bytes]:
    return [str(i).encode() for i in range(start, stop)]


async def made(where: Address, part: Part = Part()) -> Transport:  # noqa: B008
    """A reader that has made its stream."""
    reader = make_transport(where, part)
    await asyncio.wait_for(reader._open_reader(), 20)
    return reader
