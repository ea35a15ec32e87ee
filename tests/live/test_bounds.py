"""What a timeline costs and refuses: rows replayed, rows held, what is final, and one clear line for bad input."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph
import heliograph as hg

SENSOR = hg.LinearSensor([[1.0]], 0.1)
LINK = hg.perfect()


def drifting(noise=lambda u: 0.3 * jnp.diag(u[1:]), move=lambda x, u: x + u[0] * u[1]):
    return hg.Plant(move, noise, [0.0], 1.0, inputs=["speed", "dt"])


def network_of(plant, channel=LINK):
    return hg.Network(plant, {"a": hg.Node(SENSOR, channel, {"f": hg.cubature_filter(plant, SENSOR, channel)})})


@pytest.fixture(scope="module")
def network():
    return network_of(drifting())


def test_a_push_replays_its_row_and_those_after_it(network, monkeypatch):
    timeline, stepped = hg.Timeline(network, 100.0), []
    state_table = timeline._fleet.state_table
    step = state_table.step_slots_in_place
    monkeypatch.setattr(state_table, "step_slots_in_place", lambda *rows: (stepped.append(rows), step(*rows))[1])
    pushes = (1.0, 1), (3.0, 2), (5.0, 3), (2.0, 6), (4.5, 8), (0.5, 14), (2.0, 14)  # the last one is a copy
    for time, rows in pushes:
        timeline.push("a", 0, time, 1.0, 6.0)
        assert len(stepped) == rows


def test_each_row_is_final_once_and_in_order_and_no_more_are_held_than_allowed(network):
    whole, small = hg.Timeline(network, 1e6), hg.Timeline(network, 1e6, capacity=5)
    moments = np.cumsum(np.random.default_rng(0).exponential(1.0, 300))
    final = []
    for i, time in enumerate(moments):
        for timeline in (whole, small):
            assert timeline.push("a", i, time, np.sin(time)) == "used"
        if i % 5 == 4:
            final.append(small.final())
    assert small.push("a", 0, moments[-7], 0.0) == "late" and whole.push("a", 0, moments[-7], 0.0) == "used"
    assert small.forced == 295 and whole.forced == 0 and len(small._plant.rows.held) == 6
    small.advance(2e6)
    final.append(small.final())
    assert len(small.final().time) == 0
    np.testing.assert_array_equal(np.concatenate([part.time for part in final]), moments)
    dt = np.diff(moments, prepend=0.0)
    expected = hg.run(network, {"a": np.sin(moments)}, np.column_stack([np.zeros(300), dt])).estimates["a"]["f"]
    values = np.concatenate([part.estimates["a"]["f"].mean for part in final])
    np.testing.assert_allclose(values, expected.mean, rtol=1e-10, atol=1e-13)


def test_what_is_older_than_the_window_is_used_if_nothing_newer_is_final(network):
    """After an outage an in-order filter takes what comes next, however late."""
    timeline = hg.Timeline(network, window=1.0)
    assert timeline.push("a", 0, 1.0, 1.0, 1.0) == "used"
    assert timeline.push("a", 1, 2.0, 1.0, 50.0) == "used"  # 48 s on its way
    assert timeline.push("a", 2, 1.5, 1.0, 50.0) == "late"
    assert timeline.push("a", 3, 51.0, 1.0, 50.0) == "future"
    assert timeline.counts["a"] == {"used": 2, "duplicate": 0, "conflict": 0, "late": 1, "future": 1, "implausible": 0}
    assert hg.Timeline(network, 1.0, ahead=2.0).push("a", 3, 51.0, 1.0, 50.0) == "used"


REFUSED = [
    (("b", 0, 1.0, 1.0), "node of an event: expected one of a, inputs, got 'b'"),
    (("a", 0.5, 1.0, 1.0), r"event of 'a', sequence: expected a whole number from 0 to 2\^63 - 1, got 0.5"),
    (("a", 2**63, 1.0, 1.0), r"event of 'a', sequence: expected a whole number from 0 to 2\^63 - 1, got 9223"),
    (("a", -1, 1.0, 1.0), r"event of 'a', sequence: expected a whole number from 0 to 2\^63 - 1, got -1"),
    (("a", 0, np.nan, 1.0), "event of 'a', time: expected a finite number, got nan"),
    (("a", 0, "1", 1.0), "event of 'a', time: expected a finite number, got '1'"),
    (("a", 0, 1.0, [1.0, 2.0]), r"event of 'a': expected 1 number, got shape \(2,\)"),
    (("a", 0, 1.0, [np.inf]), r"event of 'a': expected finite numbers, or NaN for what is missing, got \[inf\]"),
    (("a", 0, 1.0, "x"), "event of 'a': expected 1 number, got 'x'"),
    (("a", 0, 1.0, 1.0, np.inf), "event of 'a', arrival: expected a finite number, got inf"),
    (("inputs", 0, 1.0, [1.0, 2.0]), r"event of 'inputs': expected 1 number, got shape \(2,\)"),
]


def test_what_is_no_event_is_said_in_one_line_and_changes_nothing(network, monkeypatch):
    timeline = hg.Timeline(network, 5.0)
    timeline.push("a", 0, 1.0, 1.0)
    before = timeline.save()
    for event, message in REFUSED:
        with pytest.raises(ValueError, match=message):
            timeline.push(*event)
    assert timeline.save() == before
    with pytest.raises(ValueError, match=r"snapshot: expected what save returned, got b'x'"):
        hg.Timeline.restore(network, b"x")
    node = network.nodes["a"]
    quieter = hg.Node(hg.LinearSensor([[1.0]], 0.05), node.channel, node.filters)
    for other, what in (
        (hg.Network(network.plant, {"b": node}), r"nodes: b .*nodes: a "),
        (hg.Network(network.plant, {"a": quieter}), "numbers of node 'a'"),
    ):
        with pytest.raises(ValueError, match=f"snapshot: expected the state of what is here .*{what}"):
            hg.Timeline.restore(other, before)
    monkeypatch.setattr(heliograph, "__version__", "0.0.1")
    same = hg.Network(network.plant, {"a": node})
    with pytest.raises(ValueError, match=r"what is here \(heliograph: 0.0.1\)"):
        hg.Timeline.restore(same, before)


def test_in_steps_times_are_steps():
    plant = hg.model.over_time([hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0) for _ in range(4)])
    node = hg.Node(SENSOR, LINK, {"f": hg.linear_filter(plant, SENSOR, LINK)})
    timeline = hg.Timeline(hg.Network(plant, {"a": node}), 5.0)
    for time in (0.5, -1.0, 4.0):
        with pytest.raises(ValueError, match="event of 'a', time: expected a step, a whole number from 0 to 3, got"):
            timeline.push("a", 0, time, 1.0)
    with pytest.raises(ValueError, match="start: expected 0 where time counts steps, got 1"):
        hg.Timeline(hg.Network(plant, {"a": node}), 5.0, start=1.0)


@pytest.mark.parametrize(
    ("plant", "what"),
    [
        (drifting(noise=lambda u: jnp.full((1, 1), 0.2)), "noise over 0 and then 1"),  # as much at every step
        (drifting(move=lambda x, u: x - u[1] * x), "Jacobian over 0.25 and then 0.75"),  # Euler's
    ],
)
def test_a_plant_whose_intervals_cannot_be_cut_is_informed(plant, what):
    with pytest.warns(UserWarning, match=f"timeline: predictions depend on when others are asked for: {what}"):
        hg.Timeline(network_of(plant), 5.0)


def test_continuous_time_refuses_what_goes_by_steps():
    bursts = hg.gilbert_elliott(hg.hop(1.0, 0.05), hg.hop(0.3, 0.05), 0.1, 0.3)
    plant = drifting()
    remembering = hg.Network(plant, {"a": hg.Node(SENSOR, bursts, {"f": hg.filters.open_loop_filter(plant)})})
    with pytest.raises(ValueError, match=r"timeline: expected no part that goes by steps .* that remembers, at node"):
        hg.Timeline(remembering, 5.0)
    with pytest.raises(ValueError, match="node names: expected none called 'inputs'"):
        hg.Timeline(hg.Network(plant, {"inputs": network_of(plant).nodes["a"]}), 5.0)
    with pytest.raises(ValueError, match="window: expected a number of at least 0, got -1"):
        hg.Timeline(network_of(plant), -1.0)
