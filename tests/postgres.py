"""A PostgreSQL server for the tests: in a new folder, reached by a socket there, also where the tests run as root."""

import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from functools import cache
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import Any

SPARE = ("-c", "listen_addresses=", "-c", "fsync=off", "-c", "full_page_writes=off")  # no network, no disk to wait for
SECONDS = 60  # until a server that starts must answer


def user() -> dict[str, Any]:
    """Arguments of a process that PostgreSQL accepts: it starts for nobody who may do everything.

    Raises:
        KeyError: root runs the tests, and the machine knows no other user for the server.
    """
    if os.geteuid() != 0:
        return {}
    names = {entry.pw_name for entry in pwd.getpwall()}
    entry = pwd.getpwnam("postgres" if "postgres" in names else "nobody")
    return {"user": entry.pw_uid, "group": entry.pw_gid, "extra_groups": []}


@cache
def programs() -> Path | None:
    """The folder of `initdb` and `postgres` if both start here: on the path, or where distributions put them."""
    if find_spec("psycopg") is None:
        return None
    distributed = [*Path("/usr/lib/postgresql").glob("*/bin"), *Path("/usr").glob("pgsql-*/bin")]
    places = [Path(path).resolve().parent for name in ("postgres", "initdb") if (path := shutil.which(name))]
    for folder in (*places, *sorted(distributed, key=lambda path: [int(n) for n in path.parts if n.isdigit()])[::-1]):
        try:
            for name in ("initdb", "postgres"):
                subprocess.run([folder / name, "--version"], check=True, capture_output=True, cwd="/", **user())
        except (OSError, KeyError, subprocess.SubprocessError):
            continue
        return folder
    return None


def reachable_by_all() -> str:
    """A folder of temporary files in which every user reaches what is his."""
    places = [Path(tempfile.gettempdir()), Path("/tmp"), Path("/var/tmp")]
    for place in places:
        folders = (place, *place.resolve().parents)
        if place.is_dir() and all(folder.stat().st_mode & 0o001 for folder in folders):
            return str(place)
    raise FileNotFoundError(f"PostgreSQL: expected a folder that every user reaches, got {', '.join(map(str, places))}")


class Postgres:
    """A server in a folder of its own, which goes with it; use it in a `with`."""

    def __init__(self) -> None:
        folder = programs()
        assert folder is not None, "PostgreSQL: expected to be installed"
        self.folder = Path(tempfile.mkdtemp(prefix="heliograph-pg-", dir=reachable_by_all()))
        if who := user():
            shutil.chown(self.folder, who["user"], who["group"])
        data = self.folder / "data"
        self._command = [folder / "postgres", "-D", data, "-k", self.folder, *SPARE]
        made = subprocess.run(
            [folder / "initdb", "-D", data, "-A", "trust", "-U", "me", "-E", "UTF8", "--locale=C", "-N"],
            capture_output=True, text=True, cwd=self.folder, **who,
        )  # fmt: skip
        assert made.returncode == 0, made.stderr
        self.numbers = count(1)
        self.start()

    def start(self) -> None:
        """Start, and wait until it answers."""
        log = self.folder / "log"
        with log.open("ab") as errors:
            self.process = subprocess.Popen(self._command, stdout=errors, stderr=errors, cwd=self.folder, **user())
        self.wait(log)

    def stop(self) -> None:
        """End all connections, and the server."""
        self.process.send_signal(signal.SIGINT)
        self.process.wait(10)

    def wait(self, log: Path) -> None:
        """Until it answers."""
        import psycopg

        last = time.monotonic() + SECONDS
        while True:
            try:
                psycopg.connect(self.address("postgres")).close()
                return
            except psycopg.OperationalError:
                assert self.process.poll() is None and time.monotonic() < last, log.read_text()
                time.sleep(0.05)

    def address(self, name: str) -> str:
        """Where a database is."""
        return f"postgresql://me@/{name}?host={self.folder}"

    def database(self) -> str:
        """The address of a new database, empty."""
        import psycopg

        name = f"test{next(self.numbers)}"
        with psycopg.connect(self.address("postgres"), autocommit=True) as connection:
            connection.execute(f"CREATE DATABASE {name}")  # type: ignore[arg-type]
        return self.address(name)

    def __enter__(self) -> "Postgres":
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        try:
            self.process.wait(10)
        finally:
            self.process.kill()
            shutil.rmtree(self.folder, ignore_errors=True)
