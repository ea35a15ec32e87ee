"""The same store in PostgreSQL, where there is one to start."""

import json
from pathlib import Path

import pytest
from sqlalchemy import text

from heliograph.serving.service import Service
from heliograph.serving.storage import Store, identity, open_database
from tests.postgres import Postgres
from tests.serving import test_sharing
from tests.serving.storage.test_store import by_plant, journal, states
from tests.serving.test_run_it_live import SAID, piped, retuned
from tests.serving.worlds import fleet, lines, messages, stepping

pytestmark = pytest.mark.real("PostgreSQL")


@pytest.fixture(scope="module")
def server():
    """One for these tests: it takes a second to make."""
    with Postgres() as server:
        yield server


@pytest.fixture
def database(server):
    """The address of an empty one."""
    return server.database()


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="no /proc here: run on Linux")
def test_the_server_is_not_root(server):
    assert Path(f"/proc/{server.process.pid}").stat().st_uid != 0


def test_processes_share_a_store_in_postgresql(tmp_path, database):
    network = stepping()
    mine, sent = identity(fleet(network)), lines(messages(3, 20, seed=6, whole=True))
    alone = Service(fleet(network), Store(str(tmp_path / "alone.db"), mine))
    alone.take(sent)
    count = [Service(fleet(network), Store(database, mine, name)) for name in "ab"]
    for i, begin in enumerate(range(0, len(sent), 6)):
        known = count[i % 2].take(sent[begin : begin + 6])
        count[i % 2].published(known)
        count[i % 2].finish(ended=False)
        assert count[i % 2].unpublished() == []
    assert states(count[0]) == states(alone)
    assert by_plant(journal(count[0].store)) == by_plant(journal(alone.store))
    with pytest.raises(ValueError, match=r"window: 5\.0"):
        Store(database, identity(fleet(network, window=6.0)))
    for service in count:
        service.store.close()


def test_a_network_that_was_retuned_goes_on_from_its_store_in_postgresql(tmp_path, monkeypatch, capfd, database):
    monkeypatch.chdir(tmp_path)
    retuned(database, capfd)


def test_a_store_in_a_file_begins_from_one_in_postgresql(tmp_path, monkeypatch, capfd, database):
    monkeypatch.chdir(tmp_path)
    retuned(database, capfd)
    assert piped(f"heliograph serve net.py --window 5 --store net.db --from-snapshot '{database}' < rest", capfd)
    assert "the state is kept in net.db, plants so far: 1 " in SAID.read_text()


def test_parts_are_leased_in_postgresql(database):
    test_sharing.shared(open_database(database))


@pytest.mark.parametrize(
    "how",
    [
        "body = substring(body from 1 for length(body) / 2)",
        "body = set_byte(body, 40, get_byte(body, 40) # 1)",
        "body = null",
        "version = version + 1",
        "version = null",
        "checksum = null",
    ],
)
def test_a_damaged_plant_is_refused_by_name_in_postgresql(database, how):
    """The other goes on with what it knew; after --anew the damaged one begins anew."""
    network = stepping()
    mine, sent = identity(fleet(network)), lines(messages(2, 24, seed=11, whole=True))
    half = len(sent) // 2
    begun = Service(fleet(network), Store(database, mine))
    begun.published(begun.take(sent[:half]))
    known = begun.store.load(["p0"])["p0"].body
    begun.store.close()
    engine = open_database(database)
    with engine.begin() as connection:
        connection.execute(text(f"update plants set {how} where name = 'p1'"))
    engine.dispose()
    store = Store(database, mine)
    assert list(store.damaged) == ["p1"]
    assert store.load(["p0"])["p0"].body == known
    service = Service(fleet(network), store)
    refused = [json.loads(item.body) for item in service.take(sent[half:]) if item.kind == "refused"]
    assert {item["plant"] for item in refused if item["reason"] == "damaged"} == {"p1"}
    assert all("plant 'p1': expected" in item["detail"] for item in refused if item["reason"] == "damaged")
    store.begin_anew(["p1"])
    assert store.damaged == {}
    store.close()
