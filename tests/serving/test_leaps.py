"""Leaps in time: a gap, a stamp of 1970, one of the next century; none shuts a plant."""

import json
from datetime import UTC, datetime, timedelta

import pytest

import heliograph as hg
from heliograph.serving import Fleet, InMemoryStore, Lanes, Options, Service

PLANT, SENSOR = hg.LinearPlant([[1.0]], 0.04, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.01)
NOW = datetime.now(UTC)
NEVER, SOON = timedelta(days=20_000), timedelta(seconds=1)


@pytest.fixture(scope="module")
def lanes():
    node = hg.Node(SENSOR, hg.perfect(), {"k": hg.kalman_filter(PLANT, SENSOR)})
    return Lanes(hg.Network(PLANT, {"a": node, "b": node}))


def taken(service, messages):
    """Outputs of messages (time) or (time, node), each a batch, with counts by node."""
    results = []
    for i, item in enumerate(messages):
        time, node = item if isinstance(item, tuple) else (item, "a")
        moment = time.isoformat() if isinstance(time, datetime) else time
        body = {"node": node, "sequence": i, "time": moment, "values": [1.0]}
        results += [json.loads(output.body) for output in service.take([json.dumps(body).encode()])]
    return results


def served(lanes, messages, step=None, store=None):
    service = Service(Fleet(lanes, Options(window=5.0, step=step)), store or InMemoryStore())
    return service, taken(service, messages)


def links(service, node="a"):
    link = service.plants[""].links[node]
    return link.used, link.future, link.late, link.lost


@pytest.mark.parametrize("gap", [10_001, 10**6, 10**9])
def test_a_gap_of_any_length_does_not_shut_a_plant(lanes, gap):
    service, known = served(lanes, [0, 1, gap, gap + 1, gap + 10])
    assert links(service) == (5, 0, 0, 0) and not [item for item in known if item["kind"] == "refused"]
    assert [item["time"] for item in known if item["kind"] == "final"] == [0, 1, gap, gap + 1]


@pytest.mark.parametrize("first", [[0, 1, 2], []])
def test_one_number_of_a_wrong_clock_is_taken_back(lanes, first):
    service, known = served(lanes, [*first, 10**9, 3, 4, 20])
    (refused,) = (item for item in known if item["kind"] == "refused")
    assert (refused["reason"], refused["time"], refused["node"]) == ("future", 10**9, "a")
    assert "a clock is wrong" in refused["detail"]
    assert links(service) == (len(first) + 3, 1, 0, 0)
    assert [item["time"] for item in known if item["kind"] == "final"] == [*first, 3, 4]


@pytest.mark.parametrize("step", [1.0, 0.5])
@pytest.mark.parametrize("wrong", [datetime(1970, 1, 1, tzinfo=UTC), NOW + NEVER])
def test_one_date_of_a_wrong_clock_does_not_shut_a_plant(lanes, wrong, step):
    for first in ([], [NOW - 9 * SOON]):
        service, known = served(lanes, [*first, wrong, NOW - 2 * SOON, NOW - SOON, NOW], step)
        assert links(service)[0] == len(first) + 3 + (wrong < NOW and not first)
        assert known[-1]["time"][:16] == NOW.isoformat()[:16] and known[-1]["kind"] == "provisional"


def test_a_node_whose_clock_is_years_ahead_does_not_shut_the_others(lanes):
    """Two in a row confirm each other; the wall does not, and the plant begins anew with who agrees with it."""
    wrong = [(NOW + NEVER, "b"), (NOW + NEVER + SOON, "b")]
    service, known = served(lanes, [NOW - 4 * SOON, *wrong, NOW - 2 * SOON, NOW], 1.0)
    assert links(service)[0] == 2 and links(service, "b")[1] == 2
    assert known[-1]["kind"] == "provisional" and known[-1]["time"][:16] == NOW.isoformat()[:16]


def test_a_leap_waits_for_its_confirmation_over_a_restart(lanes, tmp_path):
    from heliograph.serving.storage.store import Store
    from heliograph.serving.storage.store_protocol import identity

    fleet = Fleet(lanes, Options(window=5.0))
    for then, future in (([10**9 + 1], 0), ([3], 1)):
        path = str(tmp_path / f"{future}.db")
        served(lanes, [0, 1, 10**9], store=Store(path, identity(fleet)))
        service = Service(Fleet(lanes, Options(window=5.0)), Store(path, identity(fleet)))
        taken(service, then)
        assert links(service)[1] == future and service.plants[""].now == then[0]
