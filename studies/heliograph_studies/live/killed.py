"""The drive through `heliograph serve`: left alone behind a pipe, and behind a broker while it is killed."""

import asyncio
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Awaitable, Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from shutil import which
from tempfile import TemporaryDirectory

import nats
import numpy as np
from nats.aio.client import Client
from nats.js.errors import NotFoundError

from heliograph_studies.live.mower import PLANT, SERVED
from heliograph_studies.live.server import Server, free_port

WINDOW = 10.0  # s
TOPIC = "live"
SOON = 0.3  # s, within which it is killed once it has published enough
PATIENCE = 240.0  # s, for a service that starts and compiles on a busy machine
TOGETHER = 20  # messages that are sent before others may work
ALONE, KILLED = "alone.sqlite", "killed.sqlite"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SIZES = {"page": (1200, 1250), "page_phone": (420, 1700)}  # pixels
Screenshots = dict[str, bytes]  # PNG files by name


@dataclass(frozen=True)
class Killed:
    """Final estimates as text, one a line, in the order in which they were published; the page as a browser drew it."""

    finals: list[bytes]
    kills: int
    again: int
    pictures: Screenshots


def served(*options: str) -> list[str]:
    """The command that serves the mower."""
    return [sys.executable, "-m", "heliograph", "serve", SERVED, "--window", f"{WINDOW:g}", *options]


def left_alone(folder: Path, lines: Sequence[bytes]) -> list[bytes]:
    """Final estimates of a service that reads all messages from a pipe."""
    done = subprocess.run(
        served("--store", ALONE), input=b"\n".join(lines), cwd=folder, stdout=subprocess.PIPE, check=True
    )
    return finals(done.stdout.splitlines())


def finals(bodies: Iterable[bytes]) -> list[bytes]:
    """Final estimates without the number that tells copies apart; what was published again counts once."""
    results: dict[int, bytes] = {}
    for body in bodies:
        if b'"kind":"final"' in body:
            results.setdefault(json.loads(body)["id"], re.sub(rb'^\{"id":\d+,', b"{", body))
    return list(results.values())


def screenshots(url: str) -> Screenshots:
    """A page as on a desk and as on a phone; nothing without a browser."""
    browser = next(filter(None, map(which, BROWSERS)), None)
    return {} if browser is None else {name: _screenshot(browser, url, *size) for name, size in SIZES.items()}


def _screenshot(browser: str, url: str, width: int, height: int) -> bytes:
    with TemporaryDirectory() as folder:
        target = Path(folder) / "page.png"
        command = [browser, "--headless=new", "--disable-gpu", "--hide-scrollbars", "--timeout=4000"]
        command += [f"--user-data-dir={folder}", f"--window-size={width},{height}", f"--screenshot={target}", url]
        if os.geteuid() == 0:  # its sandbox refuses root
            command.insert(1, "--no-sandbox")
        subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=120, check=True)
        return target.read_bytes()


async def killed(
    folder: Path,
    server: Server,
    lines: Sequence[bytes],
    count: int,
    kills: int,
    seed: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
    look: Callable[[str], Screenshots] = screenshots,
) -> Killed:
    """The same through the broker; the service is killed with -9 after about equal shares of `count` estimates."""
    port = free_port()
    run = _Run(folder, server, port)
    generator = np.random.default_rng(seed)
    client = await nats.connect(f"nats://127.0.0.1:{server.nats}")
    try:
        run.start()
        await run.until(partial(_reads, client))
        for kill in range(kills):
            progress(kill, kills)
            part = slice(len(lines) * kill // (kills + 1), len(lines) * (kill + 1) // (kills + 1))
            async with asyncio.TaskGroup() as group:  # if sending fails nothing more is waited for
                group.create_task(_send(client, lines[part]))
                await run.until(partial(_finals_read, client, count * (2 * kill + 1) // (2 * kills + 2)))
                await asyncio.sleep(generator.uniform(0, SOON))
                run.kill()
            run.start()
        progress(kills, kills)
        await _send(client, lines[len(lines) * kills // (kills + 1) :])
        await run.until(partial(_finals_read, client, count))
        await run.until(partial(_idle, client))
        pictures = await asyncio.to_thread(look, f"http://127.0.0.1:{port}/")
        run.stop()
        bodies = await _everything(client)
        result = finals(bodies)
        return Killed(result, kills, len(bodies) - len(result), pictures)
    finally:
        run.kill()
        await client.close()


class _Run:
    """A service that is started again and again, from the same store."""

    def __init__(self, folder: Path, server: Server, port: int):
        self.folder = folder
        self.command = served("--store", KILLED, "--page", str(port))
        self.command += ["--broker", f"nats://127.0.0.1:{server.nats}/{TOPIC}"]
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        self.process = subprocess.Popen(self.command, cwd=self.folder)

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()

    async def until(self, holds: Callable[[], Awaitable[bool]]) -> None:
        """Wait until this holds, while it works."""
        assert self.process is not None
        async with asyncio.timeout(PATIENCE):
            while not await holds():
                if (code := self.process.poll()) is not None:
                    raise RuntimeError(f"serve: expected to go on, ended with {code}")
                await asyncio.sleep(0.02)

    def stop(self) -> None:
        """As a system stops it: it ends well."""
        assert self.process is not None
        self.process.send_signal(signal.SIGTERM)
        if code := self.process.wait(PATIENCE):
            raise RuntimeError(f"serve: expected to end with 0 after SIGTERM, got {code}")


async def _send(client: Client, lines: Sequence[bytes]) -> None:
    stream = client.jetstream(timeout=60)
    for i, line in enumerate(lines):
        await stream.publish(f"{TOPIC}.in.{PLANT}", line)
        if i % TOGETHER == 0:
            await asyncio.sleep(0)


async def _reads(client: Client) -> bool:
    """Whether a service reads the stream of messages: before that there is none to send to."""
    try:
        return bool(await client.jetstream(timeout=60).consumers_info(TOPIC))
    except NotFoundError:
        return False


async def _finals_read(client: Client, count: int) -> bool:
    """Whether so many final estimates were published."""
    try:
        info = await client.jetstream(timeout=60).stream_info(f"{TOPIC}-out", subjects_filter=f"{TOPIC}.out.final.*")
    except NotFoundError:
        return False
    return sum((info.state.subjects or {}).values()) >= count


async def _idle(client: Client) -> bool:
    """Whether every message was acknowledged."""
    readers = await client.jetstream(timeout=60).consumers_info(TOPIC)
    return bool(readers) and all(not reader.num_pending and not reader.num_ack_pending for reader in readers)


async def _everything(client: Client) -> list[bytes]:
    """All final estimates that the server keeps."""
    stream = client.jetstream(timeout=60)
    reader = await stream.subscribe(f"{TOPIC}.out.final.*", stream=f"{TOPIC}-out", ordered_consumer=True)
    results = []
    while True:
        try:
            results.append((await reader.next_msg(1)).data)
        except nats.errors.TimeoutError:
            return results
