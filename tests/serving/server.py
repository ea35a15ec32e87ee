"""A broker of the tests' own: NATS with JetStream, which also speaks MQTT."""

import os
import socket
import subprocess
import sysconfig
import time
from pathlib import Path

COMMAND = Path(sysconfig.get_path("scripts")) / "nats-server"


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


class Server:
    """On two free ports, its streams in a folder, so that it can be killed and started again."""

    def __init__(self, folder: Path):
        self.nats, self.mqtt = free_port(), free_port()
        self.file = folder / "server.conf"
        self.file.write_text(
            f'server_name: one\nlisten: "127.0.0.1:{self.nats}"\n'
            f'jetstream {{ store_dir: "{folder}" }}\n'
            f'mqtt {{ listen: "127.0.0.1:{self.mqtt}", ack_wait: "1s", max_ack_pending: 5000 }}\n'
        )

    def start(self) -> None:
        self.process = subprocess.Popen(
            [COMMAND, "-c", self.file], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=os.environ
        )
        for port in (self.nats, self.mqtt):
            self._wait(port)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    @staticmethod
    def _wait(port: int) -> None:
        for _ in range(500):
            try:
                socket.create_connection(("127.0.0.1", port), 1).close()
                return
            except OSError:
                time.sleep(0.02)
        raise TimeoutError(f"no broker at {port}")
