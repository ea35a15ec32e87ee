"""A service tells by the clock which sensors are silent for longer than their timeout, and commits nothing for it."""

import json
from datetime import UTC, datetime, timedelta

import pytest

import heliograph as hg
from heliograph.serving import Fleet, NetworkProgram, Options, Service
from heliograph.serving.observation import watch_of
from heliograph.serving.storage import Store, identity

PLANT = hg.LinearPlant(lambda u: [[1.0]], lambda u: [[0.1 * u[0]]], [0.0], [[1.0]], inputs=["dt"])
SENSOR = hg.LinearSensor([[1.0]], 0.01)


BEGUN = datetime(2026, 11, 25, 12, 0, 0, tzinfo=UTC)


class _AnyDate(type):
    """Dates of messages are dates by this clock too."""

    def __instancecheck__(cls, moment):
        return isinstance(moment, datetime)


class Clock(datetime, metaclass=_AnyDate):
    """The wall, at so many seconds."""

    seconds = 0.0

    @classmethod
    def now(cls, zone):
        return BEGUN + timedelta(seconds=cls.seconds)


@pytest.fixture(scope="module")
def program():
    filters = {"f": hg.kalman_filter(PLANT, SENSOR)}
    nodes = {name: hg.Node(SENSOR, hg.perfect(), filters, timeout=timeout) for name, timeout in (("a", 5), ("b", None))}
    return NetworkProgram(hg.Network(PLANT, nodes))


@pytest.fixture
def clock(monkeypatch):
    monkeypatch.setattr("heliograph.serving.service.datetime", Clock)
    Clock.seconds = 0.0
    return Clock


def begun(program, path):
    fleet = Fleet(program, Options(window=2.0))
    service = Service(fleet, Store(str(path), identity(fleet)))
    service.resume()
    return service


def send(service, seconds, node, sequence, plant="p"):
    body = {"plant": plant, "node": node, "sequence": sequence, "values": [0.2],
            "time": (BEGUN + timedelta(seconds=seconds)).isoformat()}  # fmt: skip
    return service.take([json.dumps(body).encode()])


def dead(outputs):
    """The reason of the sensor in each output that is provisional."""
    return [json.loads(output.body)["senders"]["a"]["reason"] for output in outputs if output.kind == "provisional"]


def test_silence_of_all_is_told_once_by_the_clock_and_commits_nothing(program, clock, tmp_path):
    service = begun(program, tmp_path / "a.db")
    send(service, 0.0, "a", 0)
    send(service, 0.5, "b", 0)
    before = service.store.number("journal")
    told = []
    for second in range(1, 20):
        clock.seconds = float(second)
        told += service.take([])
    assert dead(told) == ["nothing came for 6 s, and its timeout is 5 s"]
    assert json.loads(told[0].body)["time"] == (BEGUN + timedelta(seconds=6)).isoformat()
    assert service.dead_senders() == {"a": 1} and service.dead_by_plant() == {"p": ["a"]}
    # Nothing was committed, and no time has passed: what was measured before is not late.
    assert service.store.number("journal") == before and service.plants["p"].now == pytest.approx(43200.5)
    assert dead(send(service, 19.0, "a", 1)) == [""]
    assert service.dead_senders() == {"a": 0} and service.plants["p"].links["a"].timeouts == 1


def test_silence_of_one_is_told_with_what_the_other_sends(program, clock, tmp_path):
    service = begun(program, tmp_path / "a.db")
    send(service, 0.0, "a", 0)
    assert dead(send(service, 4.0, "b", 0)) == [""]
    assert dead(send(service, 5.5, "b", 1)) == ["nothing came for 5.5 s, and its timeout is 5 s"]


def test_a_silent_plant_is_told_while_others_send_unless_messages_wait(program, clock, tmp_path, monkeypatch):
    monkeypatch.setattr("heliograph.serving.silent_senders.SHORTEST", -1.0)  # a look after each batch
    service = begun(program, tmp_path / "a.db")
    send(service, 0.0, "a", 0, "silent")
    clock.seconds = 60.0
    assert len(send(service, 50.0, "a", 0, "other")) == 1  # ten seconds late: what the silent one sent may wait too
    told = send(service, 60.0, "a", 1, "other")
    assert [output.plant for output in told if output.kind == "provisional"] == ["other", "silent"]


def test_after_a_restart_it_is_told_again_and_the_page_and_metrics_know(program, clock, tmp_path, monkeypatch):
    service = begun(program, tmp_path / "a.db")
    send(service, 0.0, "a", 0)
    send(service, 0.0, "a", 1)
    service.store.close()
    again = begun(program, tmp_path / "a.db")
    watch = watch_of(program.network, "")
    watched = watch.wrap(again)
    clock.seconds = 30.0
    assert watched.take([]) == []  # messages that waited come first
    monkeypatch.setattr("heliograph.serving.silent_senders.GRACE", -1.0)
    assert dead(watched.take([])) == ["nothing came for 30 s, and its timeout is 5 s"]
    warnings = ["a: its sender is dead: nothing came for 30 s, and its timeout is 5 s"]
    assert watch.make_page_data("p")["warnings"] == warnings
    assert [wrong.dead for wrong in watch.list_worst_plants()] == [("a",)] and watch.dead_senders()["a"] == 1
    send(watched, 40.0, "a", 2)
    assert watch.links()["a"]["timeouts"] == 1
    assert watch.make_page_data("p")["warnings"] == ["a: 1 times silent for longer than its timeout, and back"]
