"""A store of which bytes have changed: the damage is named, and no wrong number is used or published."""

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import heliograph as hg
from heliograph.live.stored import PlantMigration
from heliograph.serving.service import Service
from heliograph.serving.storage import Store, describe_damaged_plants, identity
from heliograph.serving.storage.store_protocol import DamagedRow
from tests.serving.worlds import fleet, lines, messages, stepping

SENT = lines(messages(2, 24, seed=11, whole=True))
HALF = len(SENT) // 2


@pytest.fixture(scope="module")
def mine():
    return identity(fleet(stepping()))


@pytest.fixture(scope="module")
def whole(tmp_path_factory, mine):
    """A store in which half of the messages were used, of which nothing was published; one file, for it was closed."""
    place = tmp_path_factory.mktemp("whole") / "a.db"
    service = Service(fleet(stepping()), Store(str(place), mine))
    for begin in range(0, HALF, 4):
        service.take(SENT[begin : min(begin + 4, HALF)])
    service.store.close()
    assert {path.name for path in place.parent.iterdir()} == {"a.db"}
    return place


def changed(place, what, *values):
    """One statement of SQL in a store that nobody has open."""
    with closing(sqlite3.connect(place)) as connection:
        result = connection.execute(what, values).fetchall()
        connection.commit()
    return result


def copy(whole, tmp_path):
    place = tmp_path / "a.db"
    place.write_bytes(whole.read_bytes())
    return place


def gone_on(place, mine):
    """What a service tells that goes on from a store, by plant, and the reasons of its refusals."""
    store = Store(str(place), mine)
    try:
        service = Service(fleet(stepping()), store)
        outputs = [*service.unpublished(), *service.take(SENT[HALF:])]
    finally:
        store.close()
    published = [json.loads(output.body) for output in outputs]
    estimates = {name: [item for item in published if item["plant"] == name and item["kind"] != "refused"] for name in
                 ("p0", "p1")}  # fmt: skip
    return estimates, [item for item in published if item["kind"] == "refused"]


def without_numbers(estimates):
    """A refusal takes a number too, so that those of others move on."""
    return [{key: value for key, value in estimate.items() if key != "id"} for estimate in estimates]


@pytest.mark.slow
def test_no_byte_of_a_body_changes_unseen(whole, tmp_path, mine):
    place = copy(whole, tmp_path)
    ((body,),) = changed(place, "select body from plants where name = 'p1'")
    store = Store(str(place), mine)
    assert store.damaged == {} and store.load(["p1"])["p1"].body == body
    with closing(sqlite3.connect(place, isolation_level=None)) as connection:
        connection.execute("pragma synchronous = off")
        for at in range(len(body)):
            other = bytearray(body)
            other[at] ^= 1 << at % 8
            connection.execute("update plants set body = ? where name = 'p1'", (bytes(other),))
            stored = store.load(["p0", "p1"])
            assert stored["p0"].damage == "" and stored["p1"].body == b""
            assert "a.db, plant 'p1': expected the state that was written, got a damaged one" in stored["p1"].damage
    store.close()


@pytest.mark.parametrize(
    "how",
    [
        "set body = substr(body, 1, length(body) / 2)",
        "set body = null",
        "set body = 7",
        "set body = 'text'",
        "set version = version + 1",
        "set version = 'x'",
        "set version = null",
        "set checksum = null",
        "set checksum = 'x'",
    ],
)
def test_a_damaged_plant_is_refused_by_name_and_the_others_go_on(whole, tmp_path, mine, how):
    right, _ = gone_on(copy(whole, tmp_path), mine)
    place = copy(whole, tmp_path)
    changed(place, f"update plants {how} where name = 'p1'")
    estimates, refused = gone_on(place, mine)
    assert without_numbers(estimates["p0"]) == without_numbers(right["p0"]) != []
    assert all(estimate in right["p1"] for estimate in estimates["p1"])  # what was published before
    assert {item["reason"] for item in refused if item["plant"] == "p1"} == {"damaged"}
    assert all(f"{place}, plant 'p1': expected" in item["detail"] for item in refused if item["plant"] == "p1")
    assert all("--anew p1 begins it anew" in item["detail"] for item in refused if item["plant"] == "p1")


def test_a_plant_begins_anew_where_the_user_says_so(whole, tmp_path, mine):
    place = copy(whole, tmp_path)
    changed(place, "update plants set body = x'00' where name = 'p1'")
    store = Store(str(place), mine)
    assert list(store.damaged) == ["p1"]
    with pytest.raises(ValueError, match=r"a\.db, --anew: expected the name of a plant that it has, got 'q'"):
        store.begin_anew(["q"])
    store.begin_anew(["p1"])
    assert store.damaged == {} and store.count() == 1
    store.close()
    _, refused = gone_on(place, mine)
    assert "damaged" not in {item["reason"] for item in refused}


@pytest.mark.parametrize("name", ["'q1'", "cast(x'70ff' as text)", "x'70'"])
def test_nothing_begins_anew_where_a_name_is_damaged(whole, tmp_path, mine, name):
    """A plant that is not there may be the one that lost its name."""
    place = copy(whole, tmp_path)
    changed(place, f"update plants set name = {name} where name = 'p1'")
    _, refused = gone_on(place, mine)
    assert {item["reason"] for item in refused if item["plant"] == "p1"} == {"damaged"}
    assert all("may have had it" in item["detail"] for item in refused if item["plant"] == "p1")
    store = Store(str(place), mine)
    store.begin_anew(list(store.damaged))
    assert store.damaged == {} and store.count() == 1
    store.close()


def test_damage_is_one_line_with_what_to_do():
    named = DamagedRow(True, 0)
    assert describe_damaged_plants({"a": named, "": named}).endswith("(--anew a --anew '')")
    assert "lost its name" in describe_damaged_plants({"a": named, "b": DamagedRow(False, 0)})
    assert describe_damaged_plants({f"p{i}": named for i in range(13)}).endswith("--anew p9 and 3 more)")


@pytest.mark.parametrize(
    ("how", "what"),
    [
        ("update journal set lines = replace(lines, '0.', '1.')", r"journal: expected .* damage in those up to number"),
        ("update journal set process = 'other'", r"journal: expected .* damage in those up to number"),
        ("update numbers set value = value + 1 where name = 'journal'", "count 'journal': expected what was written"),
        ("update whose set value = substr(value, 2)", "damaged: no network that it is of"),
        ("update whose set value = '[]'", "damaged: no network that it is of"),
        ("delete from whose", "damaged: no network that it is of"),
        ("drop table numbers", "damaged: no table numbers"),
    ],
)
def test_damage_outside_the_plants_ends_the_service_in_one_line(whole, tmp_path, mine, how, what):
    place = copy(whole, tmp_path)
    changed(place, how)
    with pytest.raises(hg.InputError, match=what) as error:
        gone_on(place, mine)
    assert f"store {place}" in str(error.value) and "\n" not in str(error.value)


def test_plants_go_on_in_a_new_store_where_the_journal_is_damaged(whole, tmp_path, mine):
    right, _ = gone_on(copy(whole, tmp_path), mine)
    place = copy(whole, tmp_path)
    changed(place, "update journal set lines = ''")
    changed(place, "update plants set body = null where name = 'p1'")
    new = Store(str(tmp_path / "new.db"), mine)
    new.begin_from(str(place), mine)
    assert list(new.damaged) == ["p1"]
    new.close()
    estimates, refused = gone_on(tmp_path / "new.db", mine)
    known = without_numbers(estimates["p0"])
    assert known == without_numbers(right["p0"])[-len(known) :] != []
    assert {item["reason"] for item in refused if item["plant"] == "p1"} == {"damaged"}


@pytest.mark.parametrize("accepts", [False, True])
def test_a_store_of_an_older_release_is_refused_by_its_layout_and_release(tmp_path, mine, accepts):
    """With `--accept-changes` too: it does not say where the states of its filters stand."""
    place, here = tmp_path / "a.db", fleet(stepping())
    for what in (
        "create table plants (name varchar(200) primary key, version bigint, body blob)",
        "create table journal (last bigint primary key, process varchar(200), lines text)",
        "create table numbers (name varchar(220) primary key, value bigint)",
        "create table whose (name varchar(20) primary key, value text)",
    ):
        changed(place, what)
    changed(place, "insert into whose values ('identity', ?)", json.dumps(mine | {"heliograph": "0.1.0"}))
    changed(place, "insert into plants values ('p', 1, x'00')")
    said = []
    with pytest.raises(hg.InputError) as refused:
        Store(str(place), mine, carrier=PlantMigration(here, mine, said.append) if accepts else None)
    assert str(refused.value) == (
        f"store {place}: expected layout 5, of heliograph {mine['heliograph']}, got layout 1, of heliograph "
        "0.1.0, whose plants cannot be carried over; to begin anew, name another"
    )
    assert not said


@pytest.mark.slow
def test_no_byte_of_the_file_changes_what_is_informed(whole, tmp_path, mine):
    """Either all goes on as if nothing had happened, or the damage is named in one line."""
    right, others = gone_on(copy(whole, tmp_path), mine)
    data, place = whole.read_bytes(), tmp_path / "a.db"
    header, rest = range(100), np.random.default_rng(0).choice(np.arange(100, len(data)), 200, replace=False)
    outcomes = {"same": 0, "refused": 0, "damaged": 0}
    for at in (*header, *rest.tolist()):
        for left in tmp_path.glob("a.db*"):
            left.unlink()
        other = bytearray(data)
        other[at] ^= 1 << at % 8
        place.write_bytes(other)
        try:
            estimates, refused = gone_on(place, mine)
        except hg.InputError as error:
            assert str(error).startswith(f"store {place}") and "\n" not in str(error)
            outcomes["refused"] += 1
            continue
        hurt = {item["plant"] for item in refused if item["reason"] == "damaged"}
        outcomes["damaged" if hurt else "same"] += 1
        if not hurt:
            assert (estimates, refused) == (right, others), at
        for name in {"p0", "p1"} - hurt:
            assert without_numbers(estimates[name]) == without_numbers(right[name]), at
        for name in hurt:
            assert all(estimate in right[name] for estimate in estimates[name]), at
    assert min(outcomes.values()) > 0, outcomes


@pytest.mark.parametrize("place", ["", " ", ":memory:", "sqlite://"])
def test_a_place_that_is_none_is_refused(place):
    with pytest.raises(hg.InputError, match=r"store: expected a file, .*; none keeps nothing, got"):
        Store(place, {})


def test_the_folder_of_a_store_holds_nothing_else(whole):
    assert [path.name for path in Path(whole).parent.iterdir()] == ["a.db"]
