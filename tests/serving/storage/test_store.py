"""Exactly once in effect: a service that dies anywhere goes on from its store as if it had not."""

import json
import sqlite3
from contextlib import closing

import numpy as np
import pytest

from heliograph.live.stored import pack_plant, unpack_plant
from heliograph.serving.service import Service
from heliograph.serving.storage import Store, identity
from tests.serving.worlds import fleet, lines, messages, moving, stepping


class DiedError(Exception):
    """The process is gone."""


class Dying(Store):
    """A store that dies at a commit: before it, within it, or after it, before anybody learns of it."""

    countdown, where = -1, ""

    def commit(self, *what):
        self.countdown -= 1
        dies = self.countdown == 0
        if dies and self.where == "before":
            raise DiedError
        if dies and self.where == "within":
            self._put = self._dies
        outputs = super().commit(*what)
        if dies:
            raise DiedError
        return outputs

    def _dies(self, *_):
        raise DiedError


def journal(store):
    """What was published once, by plant and time or reason, without its number; a refusal may come again."""
    known = store.entries()
    assert [item.number for item in known] == list(range(1, len(known) + 1))
    return [{k: v for k, v in json.loads(item.body).items() if k != "id"} for item in known if item.kind == "final"]


def by_plant(known):
    return {name: [item for item in known if item["plant"] == name] for name in {item["plant"] for item in known}}


def states(service):
    """What every plant holds, without the tallies, which duplicates change."""
    results = {}
    for name, item in service.store.load([f"p{i}" for i in range(4)]).items():
        plant = unpack_plant(name, item.body, service.fleet)
        plant.links, plant.forced = {}, 0
        results[name] = pack_plant(plant, service.fleet)
    return results


@pytest.mark.slow
@pytest.mark.parametrize("whole", [True, False])
def test_a_service_that_dies_at_any_commit_ends_with_the_same_bits(tmp_path, whole):
    network = stepping() if whole else moving()
    mine = identity(fleet(network))
    sent = lines(messages(4, 30, seed=5, whole=whole, longest=2.0))
    calm = Service(fleet(network), Store(str(tmp_path / "calm.db"), mine))
    for begin in range(0, len(sent), 16):
        calm.take(sent[begin : begin + 16])
    generator = np.random.default_rng(0)
    done, deaths, place = 0, 0, str(tmp_path / "dying.db")  # what was acknowledged is never sent again on purpose
    while done < len(sent):
        store = Dying(place, mine)
        store.countdown = int(generator.integers(1, 5))
        store.where = ("before", "within", "after")[deaths % 3]
        service = Service(fleet(network), store)
        service.published(service.unpublished())
        try:
            while done < len(sent):
                size = int(generator.integers(1, 9))
                service.take(sent[max(0, done - 3) : done + size])  # some come again
                done += size
        except DiedError:
            deaths += 1
        store.close()
    assert deaths > 10
    again = Service(fleet(network), Store(place, mine))
    assert states(again) == states(calm) and len(states(again)) == 4
    assert by_plant(journal(again.store)) == by_plant(journal(calm.store)) != {}


def test_processes_that_share_a_store_take_turns(tmp_path):
    """Messages of each plant go to whichever process; what one holds in memory is old when another has committed."""
    network = stepping()
    mine, sent = identity(fleet(network)), lines(messages(3, 20, seed=6, whole=True))
    alone = Service(fleet(network), Store(str(tmp_path / "alone.db"), mine))
    alone.take(sent)
    count = [Service(fleet(network), Store(str(tmp_path / "many.db"), mine, name)) for name in "abc"]
    for i, begin in enumerate(range(0, len(sent), 5)):
        known = count[i % 3].take(sent[begin : begin + 5])
        assert count[i % 3].unpublished() == [item for item in known if item.number is not None]
        count[i % 3].published(known)
        count[i % 3].finish(ended=False)
        assert count[i % 3].unpublished() == []
    assert states(count[0]) == states(alone)
    assert by_plant(journal(count[0].store)) == by_plant(journal(alone.store))


def test_plants_leave_memory_and_come_back(tmp_path, monkeypatch):
    network = moving()
    mine, sent = identity(fleet(network)), lines(messages(4, 40, seed=7, whole=False))
    item, two = (Service(fleet(network), Store(str(tmp_path / name), mine)) for name in ("one.db", "two.db"))
    item.take(sent)
    monkeypatch.setattr("heliograph.serving.service.ROWS", 20)
    for line in sent:
        two.take([line])
        assert two.fleet.state_table.used <= 20 + 40
    assert len(two.plants) < 4 and states(item) == states(two)


def test_the_journal_is_bounded(tmp_path):
    service = Service(fleet(stepping()), Store(str(tmp_path / "a.db"), {}, journal=10))
    for line in lines(messages(1, 60, seed=8, whole=True)):
        service.take([line])
    assert len(service.store.entries()) == 10


def test_the_state_of_something_else_is_refused(tmp_path):
    place = tmp_path / "a.db"
    mine = identity(fleet(stepping()))
    service = Service(fleet(stepping()), Store(str(place), mine))
    service.take(lines(messages(1, 10, seed=9, whole=True)))
    assert identity(fleet(stepping())) == mine
    for other, what in (
        (identity(fleet(moving())), r"inputs: push -> speed, dt"),
        (identity(fleet(stepping(), window=7.0)), r"one that differs: option window: 5\.0 -> 7\.0;"),
        (mine | {"jax": "0.0.1"}, r"jax: \S+ -> 0\.0\.1;"),
        (mine | {"precision": "single"}, r"precision: double -> single;"),
    ):
        with pytest.raises(ValueError, match=what):
            Store(str(place), other)
    new = Store(str(tmp_path / "b.db"), mine)
    new.begin_from(str(place), mine)
    assert states(Service(fleet(stepping()), new)) == states(service)
    with pytest.raises(ValueError, match="no plants yet"):
        new.begin_from(str(place), mine)
    with pytest.raises(ValueError, match="inputs"):
        Store(str(tmp_path / "c.db"), identity(fleet(moving()))).begin_from(str(place), identity(fleet(moving())))


def test_a_store_begins_from_nothing_but_a_state(tmp_path):
    """An empty database is no state with no plants: it is a wrong name, and gets no tables."""
    empty, mine = tmp_path / "empty.db", identity(fleet(stepping()))
    sqlite3.connect(empty).close()
    new = Store(str(tmp_path / "new.db"), mine)
    for _ in range(2):
        with pytest.raises(ValueError, match=r"empty\.db: expected plants to begin from, got an empty one"):
            new.begin_from(str(empty), mine)
    with closing(sqlite3.connect(empty)) as connection:
        assert not connection.execute("select name from sqlite_master").fetchall()


@pytest.mark.parametrize(
    "place", ["/nowhere/a.db", "mysql://user:secret@host/db", "postgresql://user:secret@localhost:1/db", "://"]
)
def test_a_store_that_cannot_be_opened_is_one_line_without_its_password(place):
    with pytest.raises(ValueError, match="store") as error:
        Store(place, {})
    assert "secret" not in str(error.value) and "\n" not in str(error.value)


def test_a_disk_that_takes_nothing_more_ends_the_service_in_one_line(tmp_path):
    service = Service(fleet(stepping()), Store(str(tmp_path / "a.db"), {}))
    sent = lines(messages(1, 10, seed=9, whole=True))
    service.take(sent[:5])
    before = states(service)
    with service.store._engine.begin() as connection:
        connection.exec_driver_sql("CREATE TRIGGER full BEFORE INSERT ON journal BEGIN SELECT RAISE(FAIL, 'full'); END")
    with pytest.raises(ValueError, match=r"store .*a\.db: expected a database that takes a commit, got .*full"):
        service.take([*sent[5:], b"junk"])
    assert states(service) == before and service.plants == {}
