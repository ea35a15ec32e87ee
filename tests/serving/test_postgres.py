"""The same store in PostgreSQL, where there is one to start."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from heliograph.serving.database import engine_at
from heliograph.serving.service import Service
from heliograph.serving.store import Store
from heliograph.serving.whose import identity
from tests.serving import test_sharing
from tests.serving.test_store import by_plant, journal, states
from tests.serving.worlds import fleet, lines, messages, stepping

pytest.importorskip("psycopg", reason="PostgreSQL is an extra of its own")
SERVER = ("-c", "listen_addresses=", "-c", "fsync=off", "-c", "full_page_writes=off")


@pytest.fixture
def database(tmp_path_factory):
    """A server of its own in a new folder, on a socket there; it starts for nobody who may do everything."""
    if shutil.which("initdb") is None or shutil.which("postgres") is None:
        pytest.skip("no PostgreSQL here")
    folder = Path(tmp_path_factory.mktemp("pg"))
    who = []
    if os.geteuid() == 0:
        if shutil.which("runuser") is None:
            pytest.skip("PostgreSQL does not start for root")
        for place in (folder, *folder.parents[:2]):
            place.chmod(0o777)
        who = ["runuser", "-u", "nobody", "--"]
    data = folder / "data"
    made = subprocess.run(
        [*who, "initdb", "-D", data, "-A", "trust", "-U", "me", "-N"], capture_output=True, cwd=folder
    )
    if made.returncode:
        pytest.skip(f"PostgreSQL does not start here: {made.stderr.decode()[-200:]}")
    server = subprocess.Popen(
        [*who, "postgres", "-D", data, "-k", folder, *SERVER], stderr=subprocess.DEVNULL, cwd=folder
    )
    try:
        ready = ["pg_isready", "-h", folder, "-q"]
        while subprocess.run(ready, cwd=folder).returncode and server.poll() is None:
            pass
        yield f"postgresql://me@/postgres?host={folder}"
    finally:
        server.terminate()
        server.wait()


def test_processes_share_a_store_in_postgresql(tmp_path, database):
    network = stepping()
    mine, sent = identity(fleet(network)), lines(messages(3, 20, seed=6, whole=True))
    alone = Service(fleet(network), Store(str(tmp_path / "alone.db"), mine))
    alone.take(sent)
    many = [Service(fleet(network), Store(database, mine, name)) for name in "ab"]
    for i, begin in enumerate(range(0, len(sent), 6)):
        told = many[i % 2].take(sent[begin : begin + 6])
        many[i % 2].published(told)
        many[i % 2].finish(ended=False)
        assert many[i % 2].unpublished() == []
    assert states(many[0]) == states(alone)
    assert by_plant(journal(many[0].store)) == by_plant(journal(alone.store))
    with pytest.raises(ValueError, match=r"window: 5\.0"):
        Store(database, identity(fleet(network, window=6.0)))
    for service in many:
        service.store.close()


def test_parts_are_leased_in_postgresql(database):
    test_sharing.shared(engine_at(database))
