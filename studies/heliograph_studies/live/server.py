"""A broker of one's own on this machine: NATS with JetStream, which also speaks MQTT."""

import socket
import subprocess
import sysconfig
import time
from contextlib import suppress
from pathlib import Path
from random import SystemRandom
from shutil import which

from heliograph.numerics.process.optional_packages import how_to_install

PORTS = range(10_000, 32_768)
"""Ports that no system gives to outgoing connections: those begin at 32,768 on Linux, at 49,152 elsewhere."""

SECONDS_TO_START = 60.0
"""How long a server may take until it answers, on a machine that does much else."""


def find_server() -> str:
    """The command nats-server, as its wheel brings it or as the machine has it.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    result = which("nats-server", path=sysconfig.get_path("scripts")) or which("nats-server")
    if result is None:
        raise ModuleNotFoundError(
            f"nats-server: expected to be installed, got no such command: {how_to_install('live')}", name="nats-server"
        )
    return result


def free_port() -> int:
    """A port of this machine that nobody uses.

    The system's own choice (port 0) would be given to the next connection that asks, before a server binds it.
    """
    chance = SystemRandom()
    while True:
        port = chance.choice(PORTS)
        with suppress(OSError), socket.socket() as item:
            item.bind(("127.0.0.1", port))
            return port


class Server:
    """On free ports `nats` and `mqtt`, its streams in a folder, so that it can be killed and started again."""

    def __init__(self, folder: Path):
        self.command, self.nats, self.mqtt = find_server(), free_port(), free_port()
        self.file, self.log = folder / "server.conf", folder / "server.log"
        self.file.write_text(
            f'server_name: one\nlisten: "127.0.0.1:{self.nats}"\njetstream {{ store_dir: "{folder}" }}\n'
            f'mqtt {{ listen: "127.0.0.1:{self.mqtt}", ack_wait: "1s", max_ack_pending: 5000 }}\n'
        )
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it, and wait until it answers.

        Raises:
            RuntimeError: it ended, or did not answer for a minute; the last words of its log are said.
        """
        with self.log.open("wb") as log:
            self.process = subprocess.Popen([self.command, "-c", str(self.file)], stdout=log, stderr=log)
        try:
            for port in (self.nats, self.mqtt):
                self._wait_for(self.process, port)
        except BaseException:
            self.kill()
            raise

    def __enter__(self) -> "Server":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    def kill(self) -> None:
        """End it at once."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()

    def _wait_for(self, process: subprocess.Popen[bytes], port: int) -> None:
        """Wait until the server takes connections at a port."""
        last = time.monotonic() + SECONDS_TO_START
        while process.poll() is None and time.monotonic() < last:
            with suppress(OSError):
                socket.create_connection(("127.0.0.1", port), 1).close()
                return
            time.sleep(0.02)
        end = "no answer" if process.returncode is None else f"its end with status {process.returncode}"
        raise RuntimeError(f"nats-server: expected an answer at port {port}, got {end}: {self._last_words()}")

    def _last_words(self) -> str:
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "its log is empty"
