"""A sender whose transmissions are numbered: how many were lost before a value is what its running count says."""

import warnings

import numpy as np
import pytest

import heliograph as hg

PLANT, SENSOR = hg.LinearPlant([[0.98]], 0.04, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.01)
LINK, RULE = hg.erasure(hg.perfect(), 0.7), hg.SendOnDelta(0.6, heartbeat=5, losses="numbered")


@pytest.fixture(scope="module")
def network():
    filters = {"event": hg.event_filter(PLANT, SENSOR, LINK, RULE, known=1, lost=1)}
    return hg.Network(PLANT, {"a": hg.Node(SENSOR, LINK, filters, trigger=RULE)})


# Running count, step, value, and what was lost since the value before; of the first nothing is known.
ROWS = (3, 0, 0.2, np.nan), (4, 2, 0.9, 0), (7, 9, -0.1, 2), (8, 11, 0.7, 0), (0, 15, 1.4, np.nan), (2, 21, 0.5, 1)


def estimate(line):
    result = line.estimates()["a"]["event"]
    return np.append(result.mean, result.covariance)


@pytest.mark.slow
def test_the_count_says_what_was_lost(network):
    """After a restart of the count nothing is known. A count that is given stands."""
    line, given, unknown = (hg.Timeline(network, window=4) for _ in range(3))
    for sequence, step, value, lost in ROWS:
        assert line.push("a", sequence, step, [value]) == "used"
        assert given.push("a", 0, step, [value, lost]) == "used"  # its running count says nothing
        unknown.push("a", 0, step, [value, np.nan])
        if not np.isnan(lost):
            np.testing.assert_array_equal(estimate(line), estimate(given))
    assert not np.array_equal(estimate(line), estimate(unknown))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_in_whatever_order_they_come(network, seed):
    """What comes between two values takes a lost one from the later of them; final ones count as they were."""
    rows = [(k, 2 * k, 0.3 * k, 0) for k in range(12) if k not in (4, 5, 8)]
    late, line = hg.Timeline(network, window=30), hg.Timeline(network, window=30)
    for sequence, step, value, _ in rows:
        line.push("a", sequence, step, [value])
    order = np.random.default_rng(seed).permutation(len(rows))
    for i in order:
        sequence, step, value, _ = rows[i]
        assert late.push("a", sequence, step, [value], arrival=22) == "used"
    np.testing.assert_array_equal(estimate(late), estimate(line))
    again = hg.Timeline.restore(network, late.save())
    assert late.push("a", 8, 16, [2.0], arrival=22) == again.push("a", 8, 16, [2.0], arrival=22) == "used"
    line.push("a", 8, 16, [2.0], arrival=22)
    np.testing.assert_array_equal(estimate(late), estimate(line))
    np.testing.assert_array_equal(estimate(again), estimate(line))


def test_what_is_refused_leaves_the_counts_as_they_were(network):
    line, clean = hg.Timeline(network, window=30), hg.Timeline(network, window=30)
    for timeline in (line, clean):
        timeline.push("a", 0, 0, [0.2])
        timeline.push("a", 3, 8, [0.9])
    assert line.push("a", 2, 6, [1e20], arrival=8) == "implausible"
    np.testing.assert_array_equal(estimate(line), estimate(clean))
    for timeline in (line, clean):
        timeline.push("a", 2, 6, [0.8], arrival=8)
    np.testing.assert_array_equal(estimate(line), estimate(clean))


@pytest.mark.slow
def test_a_count_of_messages_does_not_say_which_components_were_lost():
    plant = hg.LinearPlant(0.98 * np.eye(2), 0.04 * np.eye(2), [0.0, 0.0], np.eye(2))
    sensor, rule = hg.LinearSensor(np.eye(2), 0.01 * np.eye(2)), hg.SendOnDelta(0.6, region="each", losses="numbered")
    filters = {"event": hg.event_filter(plant, sensor, hg.perfect(2), rule, known=1, lost=1)}
    line = hg.Timeline(hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(2), filters, trigger=rule)}), window=3)
    with pytest.raises(ValueError, match="behind each value how many of its component were lost"):
        line.push("a", 0, 0, [0.2, 0.3])
    assert line.push("a", 0, 0, [0.2, np.nan, 0, np.nan]) == "used"


@pytest.mark.slow
@pytest.mark.parametrize("losses", ["known", "numbered"])
def test_a_value_that_is_refused_was_sent_and_is_no_silence(losses):
    """Silence after 1.0 says that y stayed within 0.6 of it: the variance at the next value would be 0.053.

    Where losses are known, a value that is refused tells as much as one that was lost. Where they are numbered, its
    number says that it came, so that more is known than of a lost one, of which the next number tells too late.
    """
    plant, sensor = hg.LinearPlant([[0.95]], 0.04, [1.0], 0.5), hg.LinearSensor([[1.0]], 0.1)
    link, rule = hg.erasure(hg.perfect(), 0.8), hg.SendOnDelta(0.6, heartbeat=6, losses=losses)
    filters = {"event": hg.event_filter(plant, sensor, link, rule)}
    network = hg.Network(plant, {"a": hg.Node(sensor, link, filters, trigger=rule, limits=(-50, 50), invalid=-999)})
    nothing = 0.0 if losses == "known" else np.nan
    z = np.array([[np.nan, nothing]] * 7)
    z[[0, 3, 6]] = [1.0, 0.0], [-999.0, 0.0], [1.2, 0.0]
    lost = z.copy()
    lost[3] = [np.nan, 1.0] if losses == "known" else [np.nan, np.nan]
    lost[6, 1] = 0.0 if losses == "known" else 1.0
    timeline, stream = hg.Timeline(network, 20.0), hg.Stream(filters["event"], limits=(-50, 50), invalid=-999)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what is refused is said
        refused, implausible, told = (
            hg.run(network, {"a": rows}).estimates["a"]["event"] for rows in (z, np.where(z == -999, 1e20, z), lost)
        )
        pushed = [stream.push(row) for row in z]
    assert [timeline.push("a", k, k, z[k]) for k in (0, 3, 6)] == ["used"] * 3
    assert (
        refused.covariance[3, 0, 0] > 2 * refused.covariance[2, 0, 0]
    )  # it left the interval: where it is now is open
    np.testing.assert_array_equal(refused.covariance, implausible.covariance)
    for other in (pushed[-1], timeline.estimates()["a"]["event"]):  # compiled apart: rounding only
        np.testing.assert_allclose(other.covariance, refused.covariance[-1], rtol=1e-9)
        np.testing.assert_allclose(other.mean, refused.mean[-1], rtol=1e-9)
    if losses == "known":
        # All weights hold the probability .8 that it came in place of .2 that it was lost: rounding only.
        np.testing.assert_allclose(refused.covariance, told.covariance, rtol=1e-13)
    assert refused.covariance[-1, 0, 0] > 0.1 < told.covariance[-1, 0, 0]
