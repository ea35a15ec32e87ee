"""A timeline has the bits of filters that received everything in order, whatever the order, and it never grows."""

import itertools
import json

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

import heliograph as hg
from heliograph.live.stored import unpack_snapshot
from heliograph.live.stored.plant_codec import HEAD
from tests.live import worlds

WORLDS = {
    "forgetful": (worlds.forgetful, False),
    "remembering": (worlds.remembering, False),
    "moving": (worlds.moving, True),
    "sharing": (lambda: worlds.moving(shared=True), True),
}
WINDOW, CAPACITY = 4.0, 30
FEW = settings(max_examples=4, deadline=None, phases=[Phase.explicit, Phase.generate])


class World:
    """A network, and whether its time is continuous; hypothesis shows no more of it than its name."""

    def __init__(self, name):
        self.name, (build, self.continuous) = name, WORLDS[name]
        self.network = build()
        self.first = timeline(self.network)  # while one lives, others share what is compiled

    def __repr__(self):
        return self.name


DAILY = ("moving",)  # continuous time; worlds in steps cost 15 s of processor time and more


@pytest.fixture(
    scope="module", params=[name if name in DAILY else pytest.param(name, marks=pytest.mark.slow) for name in WORLDS]
)
def world(request):
    return World(request.param)


def timeline(network, window=WINDOW, capacity=CAPACITY):
    return hg.Timeline(network, window, capacity=capacity)


def outputs_of(item):
    return [
        part
        for filters in item.estimates().values()
        for estimate in filters.values()
        for part in (estimate.mean, estimate.covariance)
    ]


def assert_same_bits(item, other):
    for a, b in zip(outputs_of(item), outputs_of(other), strict=True):
        np.testing.assert_array_equal(a, b)


def in_order(network, accepted, now):
    """A filter that receives what was accepted, in order, each at once."""
    item = timeline(network)
    places = {name: i for i, name in enumerate(("inputs", *network.names))}
    for event in sorted(accepted, key=lambda e: (e.time, places[e.node], e.sequence)):
        assert item.push(*event[:4], event.time) == "used"
    item.advance(now)
    return item


@pytest.mark.slow
@FEW
@given(seed=st.integers(0, 10**6), mixing=st.floats(0.5, 3 * WINDOW))
def test_whatever_comes_its_bits_are_those_of_what_it_accepted(world, seed, mixing):
    """Delays beyond the window, copies, copies with other values, clocks that are ahead, a restart in between."""
    network, continuous = world.network, world.continuous
    generator = np.random.default_rng(seed)
    pushes = []
    for event in worlds.events(network, seed, 10, continuous):
        arrival = event.time + mixing * generator.random() ** 2
        pushes.append(event._replace(arrival=arrival))
        if generator.random() < 0.2:
            pushes.append(event._replace(arrival=arrival + 3 * generator.random()))
        if generator.random() < 0.2:
            pushes.append(event._replace(arrival=arrival + 3 * generator.random(), values=[9.0]))
        if generator.random() < 0.1:
            pushes.append(event._replace(arrival=event.time - 1.0, sequence=2**40))
    pushes.sort(key=lambda e: e.arrival)
    item, accepted, counted = timeline(network), [], 0
    stop = generator.integers(len(pushes))
    for i, event in enumerate(pushes):
        before = unpack_snapshot(item.save()) if generator.random() < 0.2 else None
        verdict = item.push(*event)
        counted += 1
        if verdict == "used":
            accepted.append(event)
        elif before is not None:
            assert_unchanged(before, unpack_snapshot(item.save()))
        held = [row.key[0] for row in item._plant.rows.held[1:]]
        assert all(time >= item.now - WINDOW for time in held) and len(held) <= CAPACITY
        if i == stop:
            item = hg.Timeline.restore(network, item.save())
    assert sum(sum(count.values()) for count in item.counts.values()) == counted
    assert sum(count["used"] for count in item.counts.values()) == len(accepted) and item.forced == 0
    assert_same_bits(item, in_order(network, accepted, item.now))


def assert_unchanged(before, after):
    assert before[0] == after[0]
    for name, array in before[1].items():
        a, b = array.tobytes(), after[1][name].tobytes()
        assert name == "plant" or a == b, name
    # Of the plant the counts alone differ.
    (head, rows), (head_after, rows_after) = (_plant(item[1]["plant"].tobytes()) for item in (before, after))
    assert head | {"links": 0} == head_after | {"links": 0} and rows == rows_after


def _plant(data):
    """Head and rows of a plant's bytes."""
    end = HEAD.size + HEAD.unpack_from(data)[0]
    return json.loads(data[HEAD.size : end]), data[end:]


@FEW
@given(seed=st.integers(0, 10**6))
def test_any_order_within_the_window_and_everything_twice(world, seed):
    network, continuous = world.network, world.continuous
    generator = np.random.default_rng(seed)
    results = [
        e._replace(arrival=e.time + WINDOW * generator.random()) for e in worlds.events(network, seed, 12, continuous)
    ]
    once, twice = timeline(network), timeline(network)
    for event in sorted(results, key=lambda e: e.arrival):
        assert once.push(*event) == "used"
        assert twice.push(*event) == "used" and twice.push(*event) == "duplicate"
    assert_same_bits(once, twice)
    assert_same_bits(once, in_order(network, results, once.now))


@FEW
@given(seed=st.integers(0, 10**6))
def test_what_comes_in_order_is_used_however_late(world, seed):
    network, continuous = world.network, world.continuous
    delays = np.random.default_rng(seed).exponential(4 * WINDOW, 40)
    item, now, last = timeline(network), 0.0, None
    for event, delay in zip(worlds.events(network, seed, 10, continuous), delays, strict=False):
        if item._plant.rows.joint and last == event.time:  # one row is made of them, and it may be final
            continue
        now, last = max(now, event.time + delay), event.time
        assert item.push(*event[:4], now) == "used"


def test_its_estimates_are_those_of_run(world):
    """Rows in order, with the time since the row before where that is an input; two programs, so to rounding."""
    network = world.network
    result = worlds.events(network, 5, 9, world.continuous)
    joint = not world.continuous or world.name == "sharing"
    rows, held, last = [], np.zeros(1), 0.0
    for event in result:
        if not rows or not (joint and rows[-1]["time"] == event.time):
            rows.append({"time": event.time, "u": [held, event.time - last], "received": {}})
        last = event.time
        if event.node == "inputs":
            held = event.values
            rows[-1]["u"][0] = rows[-1]["u"][0] if world.continuous else held
        else:
            rows[-1]["received"][event.node] = event.values
    if not world.continuous:  # every step has a row
        at = {row["time"]: row for row in rows}
        for k in range(int(last) + 1):
            at.setdefault(float(k), {"u": None, "received": {}})
        rows = [at[float(k)] for k in range(int(last) + 1)]
        for before, row in itertools.pairwise([{"u": [np.zeros(1)]}, *rows]):
            row["u"] = row["u"] or before["u"]
    z = {node: np.array([row["received"].get(node, [np.nan]) for row in rows]) for node in network.nodes}
    u = np.array([np.ravel(row["u"][0]) for row in rows])
    if world.continuous:
        u = np.column_stack([u, [row["u"][1] for row in rows]])
    record, item = hg.run(network, z, u if network.inputs else None), timeline(network, window=10.0)
    for event in reversed(result):
        assert item.push(*event[:4], 9.0) == "used"
    item._plant.now = last
    for node, filters in item.estimates().items():
        for name, estimate in filters.items():
            expected = record.estimates[node][name]
            np.testing.assert_allclose(estimate.mean, expected.mean[-1], rtol=1e-10, atol=1e-12)
            np.testing.assert_allclose(estimate.covariance, expected.covariance[-1], rtol=1e-10, atol=1e-12)


def test_a_start_that_nobody_knows_goes_on_row_by_row_and_is_kept():
    plant = hg.LinearPlant([[1.0, 1.0], [0.0, 1.0]], np.diag([100.0, 1.0]), [0.0, 0.0], hg.diffuse)
    sensor = hg.LinearSensor([[1.0, 0.0]], 15.0)
    filter = hg.kalman_filter(plant, sensor)
    network = hg.Network(plant, {"node": hg.Node(sensor, hg.perfect(1), {"f": filter})})
    z, timeline = [5.0, 7.0, 8.0], hg.Timeline(network, window=10)
    run = filter.run(z)
    for k in (0, 2, 1):  # out of order
        timeline.push("node", k, k, [z[k]])
    estimate = timeline.estimates()["node"]["f"]
    np.testing.assert_allclose(estimate.mean, run.means[-1], rtol=1e-12)
    np.testing.assert_allclose(estimate.covariance, run.covariances[-1], rtol=1e-12)
    again = hg.Timeline.restore(network, timeline.save()).estimates()["node"]["f"]
    np.testing.assert_array_equal(again.mean, estimate.mean)
    first = hg.Timeline(network, window=10)
    first.push("node", 0, 0, [5.0])
    early = first.estimates()["node"]["f"]
    np.testing.assert_allclose(np.diagonal(early.covariance), [15.0, np.inf], rtol=1e-12)
    assert early.claim == "none"  # of a slope that nobody knows it claims nothing yet
