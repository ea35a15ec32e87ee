"""Verdicts on a whole recording at once against those of a timeline, one event after another."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.files.events.event_columns import count_missing_messages
from heliograph.files.sources.message_reading import Reading

MOVING = hg.Plant(lambda x, u: x, lambda u: 0.1 * u[:1, None], [0.0], 1.0, states=["x"], inputs=["dt"])
COUNTING = hg.LinearPlant([[1.0]], 0.1, [0.0], 1.0, states=["x"])
SECOND = 10**9


def network(plant):
    sensor = hg.Sensor(lambda x: x, 1.0)
    node = hg.Node(sensor, hg.perfect(), {"f": hg.extended_filter(plant, sensor, hg.perfect())})
    return hg.Network(plant, {"a": node, "b": node})


@pytest.mark.parametrize("plant", [MOVING, COUNTING], ids=["moments", "steps"])
def test_verdicts_on_all_at_once_are_those_one_after_another(plant):
    """Events late, twice, with other values, and of clocks that are ahead: 400 of them, and their rows' estimates."""
    chance, one = np.random.default_rng(0), network(plant)
    table, window, ahead = hg.files.EventTable(one, numbers=True), 5.0, 1.0
    for _ in range(400):
        time = float(chance.integers(40))
        arrival = max(time + chance.normal(2, 4), 0.0) if chance.random() < 0.7 else time
        values = np.array([float(chance.integers(2))])
        table.add(Reading("", "ab"[chance.integers(2)], int(chance.integers(2)), time, values), float(arrival))
    line = hg.Timeline(one, window, ahead=ahead, capacity=1000)
    for event in table.sort_events():
        line.push(*event)
    counts, _ = table.judge(window, ahead)
    assert counts == {name: line.counts[name] for name in "ab"}
    assert all(
        min(found[v] for found in counts.values()) > 0 for v in ("used", "duplicate", "late", "future", "conflict")
    )
    line.advance(1e6)
    final, (rows, measured) = line.final(), table.rows(window, ahead)
    np.testing.assert_array_equal(final.time, rows.time[measured])
    estimate = hg.run(one, *rows).estimates["a"]["f"]
    # Compiled apart: rounding.
    np.testing.assert_allclose(final.estimates["a"]["f"].mean, estimate.mean[measured], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("counts", "period", "expected"),
    [
        ([0, 1, 2, 3], 0, 0),
        ([0, 1, 5, 6], 0, 3),
        ([7, 8, 0, 1], 0, 0),  # restarted
        ([13, 14, 15, 0, 1], 16, 0),
        ([13, 15, 1, 2], 16, 2),
        ([254, 255, 3], 256, 3),
        ([65534, 65535, 0, 2], 1 << 16, 1),
        ([18, 0, 1, 2], 1 << 16, 0),  # joined again
    ],
)
def test_gaps_in_a_count_are_lost_messages(counts, period, expected):
    order = np.random.default_rng(0).permutation(len(counts))  # whatever overtook what
    assert count_missing_messages(np.arange(len(counts))[order], np.array(counts)[order], period) == expected


def test_stamps_that_nobody_set_are_left_out_and_those_of_another_clock_are_not():
    now, one = 1_790_000_000 * SECOND, network(MOVING)
    table = hg.files.EventTable(one)
    for k, late in enumerate((0, 1, 60 * 365 * 86400, 2)):
        at = now + k * SECOND
        table.add(Reading("", "a", k, at - late * SECOND, np.array([1.0])), at)
    table.finish("log")
    assert (len(table), table.refused) == (3, 1) and "near that of arrival" in table.reasons[0]
    # A simulation, whose clock begins at 0: all are.
    table = hg.files.EventTable(one)
    for k in (2, 0, 1):
        table.add(Reading("", "a", k, k * SECOND, np.array([1.0])), now + k * SECOND)
    table.finish("log")
    assert (len(table), table.refused) == (3, 0) and "of two clocks" in table.notes[0]
    np.testing.assert_array_equal(table.recording(window=0.0).time, [0, 1, 2])


def test_events_of_several_plants_are_told_apart():
    table = hg.files.EventTable(network(MOVING))
    for plant, time in (("x", 1), ("y", 5), ("x", 2)):
        table.add(Reading(plant, "a", None, time * SECOND, np.array([1.0])), time * SECOND)
    assert table.plants == ["x", "y"] and len(table.of("x")) == 2
    np.testing.assert_array_equal(table.of("x").recording().time, [0, 1])
    with pytest.raises(ValueError, match=r"events: expected those of one plant, as events.of\('x'\) has, got 'x', 'y'"):
        table.recording()
    with pytest.raises(ValueError, match="plant: expected one of 'x', 'y', got 'z'"):
        table.of("z")


def test_the_count_of_numbered_transmissions_says_what_was_lost(tmp_path):
    """As in a timeline: nothing is known of the first and after a restart; a lost message counts for the next."""
    sensor, rule = hg.LinearSensor([[1.0]], 0.01), hg.SendOnDelta(0.6, heartbeat=5, losses="numbered")
    link = hg.erasure(hg.perfect(), 0.7)
    one = hg.Network(COUNTING, {"a": hg.Node(sensor, link, {}, trigger=rule)})
    rows = (3, 0, 0.2, np.nan), (4, 2, 0.9, 0), (7, 9, -0.1, 2), (8, 11, 0.7, 0), (0, 15, 1.4, np.nan), (2, 21, 0.5, 1)
    (tmp_path / "events.csv").write_text(
        "node,sequence,time,values\n" + "".join(f"a,{n},{k},{v}\n" for n, k, v, _ in rows)
    )
    recording, measured = hg.files.read_messages(tmp_path / "events.csv", one).rows()
    np.testing.assert_array_equal(recording.measurements["a"][measured], [row[2:] for row in rows])


def test_a_link_counts_what_was_lost_around_the_wrap_of_a_count():
    """Of 4 bits, also where one had only been overtaken; of 16 a small one long before the end is a new start."""
    from heliograph.live import LinkCounts

    link = LinkCounts()
    for time, number in enumerate([13, 14, 0, 1]):
        link.count("used", number, float(time), 16)
    assert link.lost == 1
    link.count("used", 15, 1.5, 16)
    assert link.lost == 0
    link = LinkCounts()
    for time, number in enumerate([17, 18, 0, 1, 3]):
        link.count("used", number, float(time), 1 << 16)
    assert (link.lost, link.first) == (1, 0)
