"""A broker of one's own on this machine: NATS with JetStream, which also speaks MQTT."""

import socket
import subprocess
import sysconfig
import time
from pathlib import Path
from shutil import which

from heliograph.numerics.process.optional_packages import how_to_install


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
    """A port of this machine that nobody uses."""
    with socket.socket() as item:
        item.bind(("127.0.0.1", 0))
        return int(item.getsockname()[1])


class Server:
    """On free ports `nats` and `mqtt`, its streams in a folder, so that it can be killed and started again."""

    def __init__(self, folder: Path):
        self.command, self.nats, self.mqtt = find_server(), free_port(), free_port()
        self.file = folder / "server.conf"
        self.file.write_text(
            f'server_name: one\nlisten: "127.0.0.1:{self.nats}"\njetstream {{ store_dir: "{folder}" }}\n'
            f'mqtt {{ listen: "127.0.0.1:{self.mqtt}", ack_wait: "1s", max_ack_pending: 5000 }}\n'
        )
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it, and wait until it answers."""
        self.process = subprocess.Popen(
            [self.command, "-c", str(self.file)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        for port in (self.nats, self.mqtt):
            _wait(port)

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


def _wait(port: int) -> None:
    for _ in range(500):
        try:
            socket.create_connection(("127.0.0.1", port), 1).close()
            return
        except OSError:
            time.sleep(0.02)
    raise TimeoutError(f"no broker at port {port}")
