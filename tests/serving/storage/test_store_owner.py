"""A store has one owner, and a database that is away is waited for."""

import asyncio
import json
import os
import socket
import subprocess
import sys
import threading
import time

import pytest

from heliograph.serving.service import Service
from heliograph.serving.storage import AwayError, Store, identity, own_store
from heliograph.serving.waiting_service import WaitingService, retry_while_away
from tests.postgres import Postgres
from tests.serving.worlds import fleet, lines, messages, stepping

HOLDS = """
import sys, time
from heliograph.serving.storage.store_owner import own_store
with own_store(sys.argv[1], ""):
    print("mine", flush=True)
    time.sleep(60)
"""


def held_elsewhere(location):
    """Another process that owns a store; it is killed, as by a crash, and then nobody owns it."""
    other = subprocess.Popen([sys.executable, "-c", HOLDS, location], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout.readline() == "mine\n"
        said = rf"one that no other service has, got that of .* {other.pid}\b.*--store"
        with pytest.raises(ValueError, match=said), own_store(location, ""):
            pass
        with own_store(location, "named"):  # shares it by its name
            pass
    finally:
        other.kill()
        other.communicate()
    for _ in range(100):
        try:
            with own_store(location, ""):
                return
        except ValueError:  # a server notices a moment later
            time.sleep(0.05)
    raise AssertionError("it is still owned")


@pytest.mark.slow
def test_a_file_has_one_owner_who_is_named(tmp_path):
    location = str(tmp_path / "a.db")
    held_elsewhere(location)
    with own_store(location, ""):
        assert f"{socket.gethostname()} {os.getpid()}" in (tmp_path / "a.db.lock").read_text()


class Away:
    """A service whose store is away for so many calls."""

    def __init__(self, times):
        self.times, self.taken = times, []

    def unpublished(self):
        return ["told late"]

    def published(self, outputs): ...

    def finish(self, ended):
        return self.take([])

    def take(self, payloads):
        self.times -= 1
        if self.times >= 0:
            raise AwayError("store: expected a server that answers, got none")
        self.taken.append(payloads)
        return list(payloads)


def test_a_store_that_is_away_is_waited_for(monkeypatch, caplog):
    monkeypatch.setattr("heliograph.serving.waiting_service.FIRST", 0.01)
    service, stop = Away(2), asyncio.Event()
    patient = WaitingService(service, stop)
    assert patient.take(["a"]) == ["told late", "a"] and patient.take(["b"]) == ["b"]
    assert service.taken == [["a"], ["b"]] and caplog.text.count("trying again") == 2
    stop.set()  # then it ends with the line
    with pytest.raises(AwayError, match="a server that answers"):
        WaitingService(Away(1), stop).finish(False)


@pytest.mark.real("PostgreSQL")
def test_a_database_of_postgresql_has_one_owner_who_is_named():
    with Postgres() as server:
        held_elsewhere(server.database())


@pytest.mark.real("PostgreSQL")
def test_a_server_that_is_gone_for_a_while_loses_and_doubles_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr("heliograph.serving.waiting_service.FIRST", 0.05)
    network = stepping()
    mine, sent = identity(fleet(network)), lines(messages(2, 20, seed=6, whole=True))
    alone, results = Service(fleet(network), Store(str(tmp_path / "alone.db"), mine)), []
    expected = [output.body for begin in range(0, len(sent), 5) for output in alone.take(sent[begin : begin + 5])]
    with Postgres() as server:
        store = Store(server.database(), mine)
        service = WaitingService(Service(fleet(network), store), asyncio.Event())
        for begin in range(0, len(sent), 5):
            if begin == 10:
                server.stop()
                threading.Timer(0.5, server.start).start()
            results += [output.body for output in service.take(sent[begin : begin + 5])]
        store.close()
    assert results == expected and len(results) > 20
    with pytest.raises(AwayError, match="a server that answers"):
        stop = asyncio.Event()
        stop.set()
        retry_while_away(lambda: Store("postgresql://me@/none?host=/nowhere", mine), stop)
    assert all(json.loads(body) for body in results)
