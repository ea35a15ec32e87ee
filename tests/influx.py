"""An InfluxDB server for the tests, in a new folder: version 1, as distributions have it."""

import os
import shutil
import subprocess
import tempfile
import time
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import urlencode

SECONDS = 60  # until a server that starts must answer
CONFIGURATION = """
reporting-disabled = true
bind-address = "127.0.0.1:{rpc}"
[meta]
dir = "{folder}/meta"
[data]
dir = "{folder}/data"
wal-dir = "{folder}/wal"
index-version = "inmem"
[http]
bind-address = "127.0.0.1:{port}"
log-enabled = false
[monitor]
store-enabled = false
"""


def influxd() -> str | None:
    """The program, where it is on the path."""
    return shutil.which("influxd")


class Influx:
    """A server with one database, `plant`, in a folder that goes with it; use it in a `with`."""

    def __init__(self) -> None:
        from heliograph_studies.live.server import free_port  # brings JAX, which reads its settings when imported

        self.folder, self.port = Path(tempfile.mkdtemp(prefix="heliograph-influx-")), free_port()
        configuration = self.folder / "influxdb.conf"
        configuration.write_text(CONFIGURATION.format(folder=self.folder, port=self.port, rpc=free_port()))
        program = influxd()
        assert program is not None
        environment = {**os.environ, "HOME": str(self.folder)}
        with (self.folder / "log").open("wb") as log:
            command = [program, "-config", configuration]
            self.process = subprocess.Popen(command, stdout=log, stderr=log, env=environment)
        self._wait()
        self._create_database()

    @property
    def url(self) -> str:
        """Where the database is."""
        return f"influx://127.0.0.1:{self.port}/plant"

    def send(self, method: str, target: str, body: str = "") -> int:
        """Send a request; the status of its answer."""
        return self._ask(method, target, body)[0]

    def _ask(self, method: str, target: str, body: str = "") -> tuple[int, str]:
        """Send a request; the status of its answer, and the answer."""
        connection = HTTPConnection("127.0.0.1", self.port, timeout=20)
        try:
            connection.request(method, target, body.encode())
            answer = connection.getresponse()
            return answer.status, answer.read().decode()
        finally:
            connection.close()

    def _create_database(self) -> None:
        """Make the database; again where a busy server has no time for it, which it says in an answer of status 200."""
        last, target = time.monotonic() + SECONDS, f"/query?{urlencode({'q': 'CREATE DATABASE plant'})}"
        while (answer := self._ask("POST", target))[0] != 200 or "error" in answer[1]:
            assert time.monotonic() < last, answer
            time.sleep(0.2)

    def write(self, lines: str) -> None:
        """Write lines of the protocol, as any other program does; again where a busy server has no time for them."""
        last = time.monotonic() + SECONDS
        while (status := self.send("POST", "/write?db=plant&precision=ns", lines)) >= 500 and time.monotonic() < last:
            time.sleep(0.2)
        assert status == 204, status

    def _wait(self) -> None:
        last = time.monotonic() + SECONDS
        while True:
            try:
                assert self.send("GET", "/ping") == 204
                return
            except OSError:
                assert self.process.poll() is None and time.monotonic() < last, (self.folder / "log").read_text()
                time.sleep(0.05)

    def __enter__(self) -> "Influx":
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        try:
            self.process.wait(10)
        finally:
            self.process.kill()
            shutil.rmtree(self.folder, ignore_errors=True)
