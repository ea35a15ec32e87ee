"""A timeline that absurd events come to is, bit for bit, one that they never came to; so is a recording."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.simulation.network_filters import AllFilters
from heliograph.simulation.recordings.implausible_data import step_plausibly
from tests.live.worlds import FADING, PLANT, SENSOR, events, forgetful, moving

ABSURD = [1e16, -1e20, 3.4e38, 1e155, -1e308]


def same(result, expected):
    for node, filters in expected.items():
        for name, estimate in filters.items():
            np.testing.assert_array_equal(result[node][name].mean, estimate.mean, f"{node}/{name}")
            np.testing.assert_array_equal(result[node][name].covariance, estimate.covariance, f"{node}/{name}")


@pytest.mark.slow
@pytest.mark.parametrize("make", [pytest.param(forgetful, marks=pytest.mark.slow), moving])
def test_absurd_events_leave_no_trace(make):
    """Of nodes and of inputs, newest and late ones, in a row of their own and in one that others have."""
    network = make()
    good, rng = events(network, 1, 30, make is moving), np.random.default_rng(2)
    clean, stained, refused = hg.Timeline(network, window=5.0), hg.Timeline(network, window=5.0), 0
    for i, event in enumerate(good):
        assert clean.push(*event[:4]) == "used"
        late = good[max(i - 3, 0)].time
        for node in (*network.names, "inputs")[: 3 if i % 3 == 0 else 0]:
            for time in (event.time, late):
                verdict = stained.push(node, 1000 + i, time, [rng.choice(ABSURD)])
                assert verdict in ("implausible", "conflict"), (node, time, verdict)
                refused += verdict == "implausible"
        assert stained.push(*event[:4]) == "used"
        same(stained.estimates(), clean.estimates())
    assert sum(counts["implausible"] for counts in stained.counts.values()) == refused > 20
    same(stained.lagged(2.0), clean.lagged(2.0))
    for timeline in (clean, stained):
        timeline.advance(1e3)
    result, expected = stained.final(), clean.final()
    np.testing.assert_array_equal(result.time, expected.time)
    same(result.estimates, expected.estimates)


def test_one_filter_alone_leaves_out_what_only_it_finds_implausible():
    """It believes noise of 1e-16: 1 is 1e8 of its deviations. The others use it, and it goes on with what it knew."""
    sure = hg.LinearSensor([[1.0]], 1e-16)
    lost = hg.linear_filter(hg.LinearPlant([[0.95]], 1e-16, [0.0], 1e-16), sure, hg.perfect())
    fine = hg.linear_filter(PLANT, SENSOR, FADING)
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, FADING, {"lost": lost, "fine": fine})})
    timeline = hg.Timeline(network, window=5.0)
    assert [timeline.push("a", k, k, [1.0]) for k in range(2)] == ["used", "used"]
    result = timeline.estimates()["a"]
    assert result["lost"].mean[0] == 0.0 and result["fine"].mean[0] > 0.5
    assert timeline.lagged(0.0)["a"]["lost"].mean[0] == 0.0
    with pytest.warns(UserWarning, match="filter 'lost' of 'a' alone: 2 rows .1, 2. are implausible, left out: more"):
        record = hg.run(network, {"a": np.ones((2, 1))})
    np.testing.assert_array_equal(record.estimates["a"]["lost"].mean, [[0.0], [0.0]])
    np.testing.assert_allclose(record.estimates["a"]["fine"].mean[-1], result["fine"].mean, atol=1e-14)


def limited():
    sensor = hg.LinearSensor([[1.0], [1.0]], np.eye(2), ["near", "far"])
    item = hg.linear_filter(PLANT, sensor, hg.perfect(2))
    node = hg.Node(sensor, hg.perfect(2), {"f": item}, limits=[(-5, 5), (None, None)], invalid=[-999])
    return hg.Network(PLANT, {"a": node}), hg.Network(PLANT, {"a": hg.Node(sensor, hg.perfect(2), {"f": item})})


def test_values_beyond_limits_count_as_not_arrived():
    network, free = limited()
    z = np.array([[0.3, 0.2], [6.0, 0.1], [-999, -999], [0.2, 0.4], [0.1, -999]])
    seen = np.where((np.abs(z) > 5), np.nan, z)
    timeline = hg.Timeline(network, window=10.0)
    verdicts = [timeline.push("a", k, k, row) for k, row in enumerate(z)]
    assert verdicts == ["used", "used", "implausible", "used", "used"]
    assert timeline.refused == {"a": {"limits": 1, "code": 3, "stuck": 0}}
    assert timeline.counts["a"]["implausible"] == 1
    again = hg.Timeline.restore(network, timeline.save())
    assert again.refused == timeline.refused and again.reasons == timeline.reasons != {}
    with pytest.warns(UserWarning, match="node 'a': . of 10 values count as not arrived, by") as said:
        record = hg.run(network, {"a": z})
    assert [str(warning.message).partition(", by ")[2] for warning in said] == [
        "limits; row 2: near 6 is outside -5 to 5",
        "code; row 3: near -999 is a code, far -999 is a code",
    ]
    assert [(one.component, one.reason, one.count, one.row) for one in record.refusals] == [
        (0, "limits", 1, 1),
        (0, "code", 1, 2),
        (1, "code", 2, 2),
    ]
    record_ = hg.run(free, {"a": seen})
    same(record.estimates, record_.estimates)
    np.testing.assert_array_equal(record.measurements["a"], seen)
    last = timeline.estimates()["a"]["f"].mean
    np.testing.assert_allclose(last, record_.estimates["a"]["f"].mean[-1], atol=1e-14)  # two programs


@pytest.mark.parametrize("smooth", [None, hg.smoothing.FixedInterval()])
def test_absurd_rows_of_a_recording_leave_no_trace(smooth):
    item, other = hg.linear_filter(PLANT, SENSOR, FADING), hg.cubature_filter(PLANT, SENSOR, FADING)
    node = hg.Node(SENSOR, FADING, {"f": item, "g": other})
    network = hg.Network(PLANT, {"a": node, "b": node})
    z = {name: np.random.default_rng(0).normal(size=(12, 1)) for name in "ab"}
    clean, stained = ({name: rows.copy() for name, rows in z.items()} for _ in range(2))
    for name, row, value in (("a", 3, 1e20), ("a", 7, -1e308), ("b", 3, 1e155)):
        clean[name][row], stained[name][row] = np.nan, value
    record = hg.run(network, clean, smooth=smooth)
    with pytest.warns(UserWarning, match="implausible") as said:
        outcome = hg.run(network, stained, smooth=smooth)
    words = "implausible, as if not arrived: more than 1e6 deviations from what was expected"
    lines = [str(single.message) for single in said]
    assert [line.partition(words)[0] for line in lines] == ["node 'a': 2 rows (4, 8) are ", "node 'b': row 4 is "]
    same(outcome.estimates, record.estimates)
    if smooth is not None:
        same(outcome.smoothed.estimates, record.smoothed.estimates)


def test_absurd_inputs_of_a_recording_are_named():
    plant = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0, [[1.0]], inputs=["push"])
    item = hg.linear_filter(plant, SENSOR, FADING)
    network = hg.Network(plant, {"a": hg.Node(SENSOR, FADING, {"f": item})})
    u = np.zeros((6, 1))
    u[2] = 1e200
    with pytest.warns(UserWarning, match="inputs: row 3 is implausible: with it the mean loses its digits"):
        hg.run(network, {"a": np.full((6, 1), np.nan)}, u)


def test_the_step_without_implausible_data_is_the_same_code_as_that_with_all():
    plant = hg.Plant(lambda x, u: jnp.arctan(x), 0.1, [0.0], 1.0)
    sensor = hg.Sensor(jnp.arctan, 0.1)
    node = hg.Node(sensor, hg.perfect(), {"extended": hg.extended_filter(plant, sensor)})
    network = hg.Network(plant, {"a": node})
    filters = AllFilters(network, judges=True)
    arguments = filters, filters.init(), [jnp.zeros((1, 1))], jnp.zeros(0), jnp.asarray(0)
    texts = [str(eqx.filter_make_jaxpr(step)(*arguments)[0]) for step in (AllFilters.step, step_plausibly)]
    written = [text.count(" atan ") for text in texts]
    assert written[0] == written[1] > 0, written
