"""Leaps in time: a gap, a stamp of 1970, one of the next century; none shuts a plant."""

import json
from datetime import UTC, datetime, timedelta

import pytest

import heliograph as hg
from heliograph.serving import Fleet, InMemoryStore, NetworkProgram, Options, Service

PLANT, SENSOR = hg.LinearPlant([[1.0]], 0.04, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.01)
NOW = datetime.now(UTC)
NEVER, SOON = timedelta(days=20_000), timedelta(seconds=1)


@pytest.fixture(scope="module")
def program():
    node = hg.Node(SENSOR, hg.perfect(), {"k": hg.kalman_filter(PLANT, SENSOR)})
    return NetworkProgram(hg.Network(PLANT, {"a": node, "b": node}))


def taken(service, messages):
    """Outputs of messages (time) or (time, node), each a batch, with counts by node."""
    results = []
    for i, item in enumerate(messages):
        time, node = item if isinstance(item, tuple) else (item, "a")
        moment = time.isoformat() if isinstance(time, datetime) else time
        body = {"node": node, "sequence": i, "time": moment, "values": [1.0]}
        results += [json.loads(output.body) for output in service.take([json.dumps(body).encode()])]
    return results


def served(program, messages, step=None, store=None):
    service = Service(Fleet(program, Options(window=5.0, step=step)), store or InMemoryStore())
    return service, taken(service, messages)


def is_now(time, step):
    """Whether a date, which may be rounded to whole steps, is NOW."""
    return abs(datetime.fromisoformat(time) - NOW) <= timedelta(seconds=step)


def links(service, node="a"):
    link = service.plants[""].links[node]
    return link.used, link.future, link.late, link.lost


@pytest.mark.parametrize("gap", [10_001, 10**6, 10**9])
def test_a_gap_of_any_length_does_not_shut_a_plant(program, gap):
    service, known = served(program, [0, 1, gap, gap + 1, gap + 10])
    assert links(service) == (5, 0, 0, 0) and not [item for item in known if item["kind"] == "refused"]
    assert [item["time"] for item in known if item["kind"] == "final"] == [0, 1, gap, gap + 1]


@pytest.mark.parametrize("first", [[0, 1, 2], []])
def test_one_number_of_a_wrong_clock_is_taken_back(program, first):
    service, known = served(program, [*first, 10**9, 3, 4, 20])
    (refused,) = (item for item in known if item["kind"] == "refused")
    assert (refused["reason"], refused["time"], refused["node"]) == ("future", 10**9, "a")
    assert "a clock is wrong" in refused["detail"]
    assert links(service) == (len(first) + 3, 1, 0, 0)
    assert [item["time"] for item in known if item["kind"] == "final"] == [*first, 3, 4]


@pytest.mark.parametrize("step", [1.0, 0.5])
@pytest.mark.parametrize("wrong", [datetime(1970, 1, 1, tzinfo=UTC), NOW + NEVER])
def test_one_date_of_a_wrong_clock_does_not_shut_a_plant(program, wrong, step):
    for first in ([], [NOW - 9 * SOON]):
        service, known = served(program, [*first, wrong, NOW - 2 * SOON, NOW - SOON, NOW], step)
        assert links(service)[0] == len(first) + 3 + (wrong < NOW and not first)
        assert is_now(known[-1]["time"], step) and known[-1]["kind"] == "provisional"


def test_a_node_whose_clock_is_years_ahead_does_not_shut_the_others(program):
    """Two in a row do not confirm each other where another node was heard, and the wall says that it is right."""
    wrong = [(NOW + NEVER, "b"), (NOW + NEVER + SOON, "b")]
    service, known = served(program, [NOW - 4 * SOON, *wrong, NOW - 2 * SOON, NOW], 1.0)
    assert links(service)[0] == 3 and links(service, "b")[1] == 2
    assert known[-1]["kind"] == "provisional" and is_now(known[-1]["time"], step=1.0)


@pytest.mark.parametrize("many", [2, 3, 12])
def test_no_number_of_messages_of_one_wrong_clock_shuts_a_plant(program, many):
    """Alone in its plant a node confirms itself, so that its rows become final; two that go on from before end that."""
    wrong = [10**9 + i for i in range(many)]
    service, known = served(program, [0, 1, *wrong, 2, 3, 4, 20])
    final = [item["time"] for item in known if item["kind"] == "final"]
    late = many > 6  # then rows after the leap are final already, and so the first that goes on from before it is late
    assert links(service) == (2 + 4 - late + max(many - 6, 0), min(many, 6), late, 0)
    assert final[:2] == [0, 1] and final[-2:] == [3, 4] and service.plants[""].leap.now < 0
    # What is final stays so; the rest is taken back, and said.
    refused = [item["time"] for item in known if item["kind"] == "refused" and item["reason"] == "future"]
    assert sorted([*final, *refused]) == [0, 1, *([] if late else [2]), 3, 4, *wrong]
    # The estimate is that of a service which never saw the wrong clock, nor what was late.
    _, right = served(program, [0, 1, *([] if late else [2]), 3, 4, 20])
    assert known[-1]["estimates"] == right[-1]["estimates"]


def test_another_node_that_was_heard_has_to_confirm_a_leap(program):
    messages = [(0, "a"), (0, "b"), (1, "a"), *((10**9 + i, "b") for i in range(9))]
    service, known = served(program, messages)
    assert service.plants[""].confirmed == 1 and not [m for m in known if m["kind"] == "final" and m["time"] > 1]
    known = taken(service, [(2, "a"), (3, "a"), (20, "a")])
    assert links(service)[:3] == (5, 0, 0) and links(service, "b")[:2] == (1, 9)
    # Where it says the same, the leap is confirmed at once.
    service, known = served(program, [*messages[:4], (10**9 + 1, "a"), (10**9 + 20, "a")])
    assert links(service)[0] == 4 and service.plants[""].leap is None
    assert [m["time"] for m in known if m["kind"] == "final"][-2:] == [10**9, 10**9 + 1]


def test_a_leap_is_confirmed_in_the_end_by_going_on_for_as_long(program):
    """The other node died in a gap of 20,000: for as long nothing is final, then all is."""
    service, _ = served(program, [(0, "a"), (0, "b"), *((20_000 + 4_000 * i, "a") for i in range(5))])
    assert service.plants[""].confirmed == 0
    known = taken(service, [(40_000, "a"), (40_010, "a")])
    assert service.plants[""].leap is None
    assert [m["time"] for m in known if m["kind"] == "final"] == [0, *range(20_000, 40_001, 4_000)]


@pytest.mark.parametrize(
    "wrong", [[10**9, 2 * 10**12], [10**9, 10**9 + 1, 2 * 10**12, 2 * 10**12 + 1], [10**12, 10**9]]
)
def test_a_clock_that_leaps_again_and_again_does_not_shut_a_plant(program, wrong):
    service, known = served(program, [0, 1, *wrong, 2, 3, 4, 20])
    assert service.plants[""].now == 20 and [m["time"] for m in known if m["kind"] == "final"][-2:] == [3, 4]


@pytest.mark.parametrize("node", ["a", "b"])
def test_a_plant_that_begins_with_a_wrong_clock_begins_anew(program, node):
    service, known = served(program, [10**9, 10**9 + 1, (0, node), (1, node), (2, node), (20, node)])
    assert service.plants[""].now == 20 and known[-1]["kind"] == "provisional" and known[-1]["time"] == 20
    assert [m["time"] for m in known if m["kind"] == "final" and m["time"] < 100][-2:] == [1, 2]


def test_a_wrong_arrival_does_not_shut_a_plant(program):
    service = Service(Fleet(program, Options(window=5.0)), InMemoryStore())
    for i, (time, arrival) in enumerate([(0, 0), (1, 1), (2, 10**9), (3, 3), (4, 4), (20, 20)]):
        body = {"node": "a", "sequence": i, "time": time, "arrival": arrival, "values": [1.0]}
        service.take([json.dumps(body).encode()])
    assert links(service) == (6, 0, 0, 0) and service.plants[""].now == 20


def test_a_leap_that_cannot_be_used_changes_nothing(program):
    """An implausible message that goes on from before a leap takes nothing back."""
    service, _ = served(program, [0, 1, 10**9, 10**9 + 1, 2])
    before = service.plants[""].clock
    body = {"node": "a", "sequence": 9, "time": 3, "values": [1e30]}
    service.take([json.dumps(body).encode()])
    assert links(service)[:2] == (5, 0) and service.plants[""].clock == before
    taken(service, [10**9 + 2])
    assert service.plants[""].now == 10**9 + 2 and service.plants[""].leap.back is None


def test_a_leap_waits_for_its_confirmation_over_a_restart(program, tmp_path):
    from heliograph.serving.storage import Store, identity

    fleet = Fleet(program, Options(window=5.0))
    for i, (wrong, then, future) in enumerate(
        (([10**9], [10**9 + 1], 0), ([10**9], [3], 1), ([10**9 + j for j in range(9)], [3, 4], 6))
    ):
        path = str(tmp_path / f"{i}.db")
        served(program, [0, 1, *wrong], store=Store(path, identity(fleet)))
        service = Service(Fleet(program, Options(window=5.0)), Store(path, identity(fleet)))
        taken(service, then)
        assert links(service)[1] == future and service.plants[""].now == then[-1]
