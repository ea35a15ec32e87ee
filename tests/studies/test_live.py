"""The drive through a real broker: a service that is killed tells what one that is left alone does."""

import asyncio
import json
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("gtsam")
pytest.importorskip("nats")
pytest.importorskip("sqlalchemy")
import nats
from nats.js.errors import NoStreamResponseError

from heliograph.serving import make_transport, parse_address
from heliograph_studies.live.compute import differences
from heliograph_studies.live.killed import TOPIC, _finals_read, _reads, _send, killed, left_alone
from heliograph_studies.live.mower import read_drive
from heliograph_studies.live.server import Server
from heliograph_studies.live.speed import PLANTS, many_plants


@pytest.mark.real("NATS")
def test_what_is_said_is_the_same_if_it_is_killed(tmp_path: Path):
    drive = read_drive(0)
    assert len(drive.lines) + drive.unreceived == 3632 and 0 < drive.unreceived < 300
    lines = drive.lines[:400]
    alone = left_alone(tmp_path, lines)
    server = Server(tmp_path)
    server.start()
    try:
        record = asyncio.run(killed(tmp_path, server, lines, len(alone), 1, 0, look=lambda url: {}))
    finally:
        server.kill()
    assert record.kills == 1 and len(alone) > 100 and record.finals == alone
    outputs = [json.loads(line)["time"] for line in alone]
    assert outputs == sorted(outputs)


def test_what_was_lost_and_what_was_counted_twice():
    alone, after = ({node: SimpleNamespace(used=used) for node, used in (("a", 5), ("b", b))} for b in (5, 7))
    after["a"].used = 4
    assert differences(alone, after) == (1, 2)


@pytest.mark.real("NATS")
def test_nothing_is_sent_before_there_is_a_stream_to_send_to(tmp_path: Path):
    """A service makes the stream of what it tells before that of what it reads: a message in between would be lost."""

    async def work(server: Server) -> None:
        transport = make_transport(parse_address(f"nats://127.0.0.1:{server.nats}/{TOPIC}", {}))
        client = await nats.connect(f"nats://127.0.0.1:{server.nats}")
        await transport._open()
        assert await _finals_read(client, 0) and not await _reads(client)
        with pytest.raises(ExceptionGroup) as error:
            async with asyncio.timeout(5), asyncio.TaskGroup() as group:
                group.create_task(_send(client, [b"{}"]))
                await asyncio.sleep(30)
        assert error.group_contains(NoStreamResponseError)
        await transport._open_reader()
        assert await _reads(client)
        await _send(client, [b"{}"])
        await asyncio.gather(transport.close(), client.close())

    server = Server(tmp_path)
    server.start()
    try:
        asyncio.run(work(server))
    finally:
        server.kill()


def test_many_mowers_send_what_one_did():
    lines = many_plants(read_drive(0).lines, 300)
    results = [json.loads(line) for line in lines]
    assert len(results) == 300 and len({item["plant"] for item in results}) == PLANTS
    assert [item["sequence"] for item in results if item["plant"] == "mower 7"] == [0, 1, 2]
