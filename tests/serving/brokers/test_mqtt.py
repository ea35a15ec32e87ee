"""Publishing to an MQTT server that acknowledges when it is asked to, and not before."""

import asyncio
import contextlib
import socket
import subprocess
import time
from collections.abc import Callable, Coroutine
from shutil import which

import pytest

pytest.importorskip("paho")

from heliograph import cli
from heliograph.serving import Output, Transport, make_transport, parse_address
from heliograph_studies.live.server import free_port

CONNECT, PUBLISH, DISCONNECT = 1, 3, 14  # kinds of packets of MQTT 3.1.1
OUTPUTS = [Output(None, "", "provisional", b"now"), *(Output(i, "", "final", str(i).encode()) for i in range(3))]


class Reluctant:
    """Server of MQTT that accepts connections and messages, and holds acknowledgements back."""

    def __init__(self) -> None:
        self.numbers, self.bodies = list[bytes](), list[bytes]()
        self.writer: asyncio.StreamWriter | None = None

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while (head := (await reader.readexactly(1))[0]) >> 4 != DISCONNECT:
                rest = await reader.readexactly((await reader.readexactly(1))[0])  # none here is longer than 127 bytes
                if head >> 4 == CONNECT:
                    writer.write(bytes([0x20, 2, 0, 0]))
                elif head >> 4 == PUBLISH:
                    self.take(head, rest, writer)
        except asyncio.IncompleteReadError:
            pass
        writer.close()

    def take(self, head: int, rest: bytes, writer: asyncio.StreamWriter) -> None:
        start = 2 + int.from_bytes(rest[:2])
        if head & 0b110:  # the quality of service: a number follows the topic
            self.numbers.append(rest[start : start + 2])
            start += 2
        self.bodies.append(rest[start:])
        self.writer = writer

    def acknowledge(self) -> None:
        assert self.writer is not None
        self.writer.write(bytes([0x40, 2]) + self.numbers.pop(0))


def serve(work: Callable[[Reluctant, Transport], Coroutine[None, None, None]]) -> None:
    """Run a test beside a server and a transport that is connected to it."""

    async def run() -> None:
        broker = Reluctant()
        server = await asyncio.start_server(broker.serve, "127.0.0.1", 0)
        transport = make_transport(parse_address(f"mqtt://127.0.0.1:{server.sockets[0].getsockname()[1]}", {}))
        async with asyncio.timeout(30):
            await until(transport._writer.client.is_connected)
            await work(broker, transport)
        await transport.close()
        server.close()

    asyncio.run(run())


async def until(condition: Callable[[], bool]) -> None:
    while not condition():
        await asyncio.sleep(0.005)


def test_publish_returns_when_the_server_has_acknowledged_every_output_with_a_number():
    async def work(broker: Reluctant, transport: Transport) -> None:
        publishing = asyncio.create_task(transport.publish(OUTPUTS))
        await until(lambda: len(broker.bodies) == len(OUTPUTS))
        assert broker.bodies == [output.body for output in OUTPUTS]
        for _ in range(3):
            await asyncio.sleep(0.02)
            assert broker.numbers and not publishing.done()
            broker.acknowledge()
        await publishing

    serve(work)


def test_what_was_not_acknowledged_is_published_again_after_the_connection_ended():
    async def work(broker: Reluctant, transport: Transport) -> None:
        publishing = asyncio.create_task(transport.publish(OUTPUTS))
        await until(lambda: len(broker.bodies) == len(OUTPUTS))
        broker.acknowledge()
        assert broker.writer is not None
        await broker.writer.drain()
        broker.writer.close()
        lost = broker.numbers.copy()
        broker.numbers.clear()
        await until(lambda: broker.numbers == lost)
        assert not publishing.done()
        for _ in lost:
            broker.acknowledge()
        await publishing
        assert [body for body in broker.bodies if body != b"now"] == [b"0", b"1", b"2", b"1", b"2"]

    serve(work)


@pytest.mark.skipif(which("mosquitto") is None, reason="no mosquitto here")
def test_a_refused_login_is_told_as_one(tmp_path, capsys):
    """A broker that takes no anonymous client, and knows nobody."""
    port = free_port()
    settings = tmp_path / "mosquitto.conf"
    settings.write_text(f"listener {port} 127.0.0.1\nallow_anonymous false\n")
    broker = subprocess.Popen(["mosquitto", "-c", str(settings)], stdout=-3, stderr=-3)
    try:
        for _ in range(100):
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
                break
            time.sleep(0.05)
        assert cli.main(["inspect", f"mqtt://127.0.0.1:{port}", "--seconds", "0.1"]) == 2
        assert "expected a connection, got a refusal: Not authori" in capsys.readouterr().err
    finally:
        broker.terminate()
        broker.wait()
