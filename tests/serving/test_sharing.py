"""Plants shared among processes: a part is one process's at a time, and what a dead one had goes on elsewhere."""

import asyncio
import json
import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

pytest.importorskip("nats")
pytest.importorskip("sqlalchemy")
import nats
from sqlalchemy import Engine, update

import heliograph
from heliograph.serving.brokers.transport import encode_name
from heliograph.serving.service import Service
from heliograph.serving.storage import InMemoryStore, Leases, open_database, part_leases
from heliograph_studies.live.server import Server
from tests.serving.worlds import WINDOW, fleet, lines, messages, stepping

ROOT = Path(heliograph.__file__).parents[2]
PARTS = 6
NETWORK = "from tests.serving.worlds import stepping\nnetwork = stepping()\n"


def test_processes_share_evenly_and_take_over_what_nobody_renews(tmp_path):
    shared(open_database(str(tmp_path / "store.sqlite")))


def shared(engine: Engine) -> None:
    """Three processes join, leave and die."""
    item, two, three = (Leases(engine, name, 5, term=600.0) for name in ("one", "two", "three"))
    assert item.renew() == {0, 1, 2, 3, 4}
    assert two.renew() == set() and item.renew() == {0, 1, 2}  # one still works at 3 and 4, until it says that it left
    assert two.renew() == set()
    item.release(3)
    item.release(4)
    assert two.renew() == {3, 4} and three.renew() == set() and item.renew() == {0, 1}
    item.release(2)
    assert three.renew() == {2} and item.renew() == {0, 1}
    two.leave()
    with engine.begin() as connection:  # one and three died, and it is longer ago than a lease lasts
        for table in (part_leases.PROCESSES, part_leases.PARTS):
            connection.execute(update(table).values(until=table.c.until - 601.0))
    two.release(0)  # what is not one's own stays
    assert two.renew() == {0, 1, 2, 3, 4} and item.renew() == set()
    engine.dispose()


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    item = Server(tmp_path)
    item.start()
    yield item
    item.kill()


class Process:
    """`heliograph serve` for a share of the plants."""

    def __init__(self, folder: Path, name: str, server: Server):
        (folder / "network.py").write_text(NETWORK)
        command = [
            sys.executable,
            "-m",
            "heliograph",
            "serve",
            "network.py",
            "--window",
            str(WINDOW),
            "--process",
            name,
        ]
        command += [
            "--store",
            "store.sqlite",
            "--parts",
            str(PARTS),
            "--broker",
            f"nats://127.0.0.1:{server.nats}/fleet",
        ]
        environment = os.environ | {"PYTHONPATH": f"{ROOT / 'src'}:{ROOT}"}
        self.log = open(folder / f"{name}.log", "wb")  # noqa: SIM115
        self.process = subprocess.Popen(command, cwd=folder, env=environment, stdout=self.log, stderr=self.log)


@pytest.mark.real("NATS")
def test_three_processes_of_which_one_is_killed_tell_what_one_would(server: Server, tmp_path: Path):
    result = messages(plants=12, count=60, seed=3, whole=True)
    expected = finals(output.body for output in Service(fleet(stepping()), InMemoryStore()).take(lines(result)))
    count = sum(len(item) for item in expected.values())
    processes = [Process(tmp_path, name, server) for name in ("one", "two", "three")]

    async def work() -> dict[str, list[str]]:
        client = await nats.connect(f"nats://127.0.0.1:{server.nats}")
        stream = client.jetstream(timeout=60)
        await until(lambda: owners(tmp_path) == {"one": 2, "two": 2, "three": 2})
        for message in result[: len(result) // 2]:
            await stream.publish(f"fleet.in.{encode_name(str(message['plant']))}", json.dumps(message).encode())
        await until_stopped(client, count // 4)
        processes[0].process.kill()
        for message in result[len(result) // 2 :]:
            await stream.publish(f"fleet.in.{encode_name(str(message['plant']))}", json.dumps(message).encode())
        await until_stopped(client, count)
        known = finals(await everything(client))
        await client.close()
        return known

    try:
        record = asyncio.run(work())
        owned = owners(tmp_path)
        for process in processes[1:]:
            process.process.send_signal(signal.SIGTERM)
            assert process.process.wait(30) == 0
    finally:
        for process in processes:
            process.process.kill()
            process.process.wait()
            process.log.close()
    assert record == expected  # the same text, digit by digit
    assert owned == {"two": 3, "three": 3} and owners(tmp_path) == {}


def finals(bodies) -> dict[str, list[str]]:
    """Final estimates of each plant in the order of time, without their numbers; published again they count once."""
    known: dict[str, dict[float, str]] = {}
    for body in bodies:
        content = json.loads(body)
        if content["kind"] == "final":
            del content["id"]
            again = known.setdefault(content["plant"], {}).setdefault(content["time"], json.dumps(content))
            assert again == json.dumps(content)
    return {plant: [text for _, text in sorted(of.items())] for plant, of in known.items()}


async def everything(client: nats.NATS) -> list[bytes]:
    """What the server keeps of what was published."""
    stream = client.jetstream(timeout=60)
    reader = await stream.subscribe("fleet.out.final.*", stream="fleet-out", ordered_consumer=True)
    count = (await stream.stream_info("fleet-out")).state.messages
    return [(await reader.next_msg(5)).data for _ in range(count)]


async def until_stopped(client: nats.NATS, count: int) -> None:
    for _ in range(1200):
        if (await client.jetstream(timeout=60).stream_info("fleet-out")).state.messages >= count:
            return
        await asyncio.sleep(0.1)
    raise TimeoutError(f"fewer than {count} final estimates")


async def until(holds) -> None:
    for _ in range(1200):
        if holds():
            return
        await asyncio.sleep(0.1)
    raise TimeoutError


def owners(folder: Path) -> dict[str, int]:
    """How many parts each process has."""
    with closing(sqlite3.connect(folder / "store.sqlite")) as store:
        try:
            return dict(store.execute("SELECT process, count(*) FROM parts GROUP BY process").fetchall())
        except sqlite3.OperationalError:
            return {}
