"""Silence follows from the last commit and the clock: it is no message, no loss, no commit and no news."""

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

import heliograph as hg
from heliograph.live.stored import pack_plant, unpack_plant
from heliograph.serving import Fleet, NetworkProgram, Options, Service
from heliograph.serving.storage import Store, identity

BEGUN = datetime(2026, 11, 25, 12, 0, 0, tzinfo=UTC)
DAY = 86_400


class Clock(datetime):
    """The wall, at so many seconds."""

    seconds = 0.0

    @classmethod
    def now(cls, zone):
        return BEGUN + timedelta(seconds=cls.seconds)


@pytest.fixture(scope="module")
def program():
    plant, sensor = hg.LinearPlant([[0.98]], 0.04, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.01)
    trigger = hg.SendOnDelta(0.6, heartbeat=600)
    filters = {"event": hg.event_filter(plant, sensor, hg.perfect(), trigger, known=1, lost=1)}
    return NetworkProgram(hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), filters, trigger=trigger)}))


@pytest.fixture
def clock(monkeypatch):
    monkeypatch.setattr("heliograph.serving.service.datetime", Clock)
    Clock.seconds = 0.0
    return Clock


def begun(program, path, every=None):
    fleet = Fleet(program, Options(window=5.0, step=1.0))
    return Service(fleet, Store(str(path), identity(fleet)), every=every)


def send(service, seconds, value, sequence, plant="p0"):
    time = (BEGUN + timedelta(seconds=seconds)).isoformat()
    body = {"plant": plant, "node": "a", "sequence": sequence, "time": time, "values": [value]}
    return [json.loads(output.body) for output in service.take([json.dumps(body).encode()])]


def wait(service, clock, until):
    """Let the seconds pass; return what is told."""
    results = []
    for second in range(int(clock.seconds) + 1, until + 1):
        clock.seconds = float(second)
        results += service.take([])
    return results


@pytest.mark.slow
def test_four_silent_thermometers_write_and_tell_next_to_nothing(program, clock, tmp_path):
    """Ten minutes from the last value on, as a share of 10 MB a day; the database and its log, and what is told."""
    service = begun(program, tmp_path / "a.db")
    for i in range(4):
        send(service, 0.0, 0.2, 0, f"p{i}")
        send(service, 1.0, 0.9, 1, f"p{i}")
    wait(service, clock, 10)

    def written():
        return sum(file.stat().st_size for file in Path(tmp_path).iterdir())

    before, numbers = written(), service.store.number("journal")
    told = wait(service, clock, 610)
    assert written() == before and service.store.number("journal") == numbers
    assert {output.kind for output in told} == {"provisional"}
    assert sum(len(output.body) for output in told) * DAY / 600 < 10e6
    # One of them each, at the end, says that a heartbeat is missing.
    assert [json.loads(output.body)["senders"]["a"]["dead"] for output in told][-4:] == [True] * 4
    for plant in service.plants.values():
        link = plant.links["a"]
        assert set(plant.links) == {"a"} and (link.used, link.lost) == (2, 0)


@pytest.mark.slow
def test_four_thermometers_that_only_say_that_they_live_write_less_than_ten_megabytes_a_day(program, clock, tmp_path):
    """A heartbeat of each in ten minutes, in commits of their own: pages of 16 kB and the states' zeros made it 67."""
    service = begun(program, tmp_path / "a.db")

    def beat(sequence):
        for i in range(4):
            send(service, clock.seconds, 0.2, sequence, f"p{i}")
        wait(service, clock, int(clock.seconds) + 10)

    beat(0)
    clock.seconds = 600.0
    service.take([])
    before = (tmp_path / "a.db-wal").stat().st_size
    beat(1)
    assert ((tmp_path / "a.db-wal").stat().st_size - before) * DAY / 600 < 10e6
    # The state is that of a value that came: of 600 ages one has a probability.
    (row, *_) = service.plants["p0"].rows.held
    numbers = service.fleet.state_table.table[row.slot]
    assert len(pack_plant(service.plants["p0"], service.fleet)) < numbers.nbytes / 4
    restored = unpack_plant("p0", pack_plant(service.plants["p0"], service.fleet), service.fleet)
    (again, *_) = restored.rows.held
    assert service.fleet.state_table.table[again.slot].tobytes() == numbers.tobytes()


@pytest.mark.slow
def test_what_was_received_becomes_final_in_silence_and_once(program, clock, tmp_path):
    service = begun(program, tmp_path / "a.db")
    send(service, 0.0, 0.2, 0)
    send(service, 1.0, 0.9, 1)
    told = wait(service, clock, 30)
    assert [json.loads(output.body)["time"][17:19] for output in told if output.kind == "final"] == ["00", "01"]


@pytest.mark.slow
def test_silence_is_that_of_a_timeline_and_a_value_ends_it(program, clock, tmp_path):
    service, line = begun(program, tmp_path / "a.db", every=1.0), hg.Timeline(program.network, window=5.0)
    send(service, 0.0, 0.2, 0)
    line.push("a", 0, 0, [0.2])
    last = json.loads(wait(service, clock, 20)[-1].body)
    line.advance(20)
    for newest in (last, send(service, 21.0, 1.1, 1)[-1]):
        result, expected = newest["estimates"]["a"]["event"], line.estimates()["a"]["event"]
        assert result["mean"] == pytest.approx(expected.mean, rel=1e-9)  # compiled apart
        assert result["covariance"][0] == pytest.approx(expected.covariance[0], rel=1e-9)
        line.push("a", 1, 21, [1.1])


@pytest.mark.slow
def test_every_so_many_seconds_it_is_told_if_asked_for(program, clock, tmp_path):
    quiet, often = begun(program, tmp_path / "a.db"), begun(program, tmp_path / "b.db", every=10.0)
    for service in (quiet, often):
        clock.seconds = 0.0
        send(service, 0.0, 0.2, 0)
        wait(service, clock, 200)
    clock.seconds = 200.0
    assert not wait(quiet, clock, 300)
    clock.seconds = 200.0
    assert len(wait(often, clock, 300)) == 10


@pytest.mark.slow
def test_a_dead_sender_is_dead_after_a_restart_too(program, clock, tmp_path, monkeypatch):
    service = begun(program, tmp_path / "a.db")
    send(service, 0.0, 0.2, 0)
    wait(service, clock, 620)
    assert service.dead_senders() == {"a": 1} and service.dead_by_plant() == {"p0": ["a"]}
    again = begun(program, tmp_path / "a.db")
    again.resume()
    assert list(again.plants) == ["p0"]
    clock.seconds = 621.0
    assert again.take([]) == []  # messages that waited come first
    monkeypatch.setattr("heliograph.serving.silent_senders.GRACE", -1.0)
    (said,) = again.take([])
    assert again.dead_senders() == {"a": 1} and json.loads(said.body)["senders"]["a"]["dead"]
