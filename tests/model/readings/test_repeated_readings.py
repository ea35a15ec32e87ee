"""Stuck sensors: how many equal readings noise and resolution allow, what is refused, what is named by chance."""

import numpy as np
import pytest
from scipy.stats import norm

import heliograph as hg
from tests.laws import LAWS

PLANT = hg.LinearPlant([[1.0]], 0.01, [0.0], 1.0)
SENSOR = hg.LinearSensor([[1.0]], 0.25, outputs=["v"], resolution=0.1)


def limits_of(sensor, stuck, link=None):
    """Limits of a node with this sensor."""
    return hg.Node(sensor, hg.perfect(len(sensor.outputs)) if link is None else link, {}, stuck=stuck).limits


def stuck_recording(steps=1000, first=400, last=500):
    """A walk of deviation .1, its readings, of which those from the first on are equal to it."""
    rng = np.random.default_rng(0)
    x = np.cumsum(0.1 * rng.standard_normal(steps))
    z = np.round((x + 0.5 * rng.standard_normal(steps)) / 0.1) * 0.1
    z[first:last] = z[first]
    return x, z


def test_how_many_equal_readings_the_law_allows():
    """p = 2 Phi(q / 2 s) - 1 is that of the q about the mean; n is the least with p^(n - 1) <= 1e-9."""
    p = 2 * norm.cdf(0.1 / 2 / 0.5) - 1
    (n,) = limits_of(SENSOR, True).stuck
    assert p ** (n - 1) <= 1e-9 < p ** (n - 2) and n == 10
    both = hg.LinearSensor(np.ones((2, 1)), np.diag([0.25, 1e-4]), outputs=["v", "w"], resolution=[0.1, 0.01])
    p = 2 * norm.cdf(0.5) - 1
    n, m = limits_of(both, [True, True]).stuck
    assert n == 10 and p ** (m - 1) <= 1e-9 < p ** (m - 2)
    np.testing.assert_array_equal(limits_of(both, [None, 7]).stuck, [np.inf, 7])
    assert limits_of(both, None) is None and limits_of(both, [False, None]) is None


@pytest.mark.parametrize("law", LAWS)
def test_a_reading_equals_the_one_before_no_more_often_than_the_bound_says(law):
    """Of 200,000 readings at the worst place; four standard errors. The bound is reached by Gaussian noise there."""
    rng, (noise, draw) = np.random.default_rng(1), LAWS[law]
    for q in (0.3, 2.0, 4.0):
        (n,) = limits_of(hg.LinearSensor([[1.0]], noise, resolution=q), True).stuck
        highest = 1e-9 ** (1 / (n - 1))  # p is at most this
        inside = np.abs(draw(rng, 200_000)) < q / 2
        assert inside.mean() < highest + 4 * inside.std() / np.sqrt(inside.size)
        assert 1e-9 ** (1 / (n - 2)) < inside.mean() + 0.02 or law != "Gaussian"


def test_right_recordings_are_not_stuck():
    """240 recordings of three laws, five resolutions and four walks, 300 to 20,000 readings: none, where 1 % may be."""
    rng, named = np.random.default_rng(2), 0
    for noise, draw in LAWS.values():
        for q in (0.1, 0.3, 1.0, 2.0, 4.0):
            limits = limits_of(hg.LinearSensor([[1.0]], noise, resolution=q), True)
            for walk in (0.0, 0.01, 0.3, 3.0):
                for n in (300, 3000, 3000, 20_000):
                    x = np.cumsum(walk * rng.standard_normal(n)) + rng.uniform(-5, 5)
                    named += limits.screen(np.round((x + draw(rng, n)) / q)[:, None] * q).by("stuck").any()
    assert named == 0


def test_a_sensor_that_stands_is_refused_after_so_many_readings():
    """Of 200 walks whose sensor stands from reading 100 on: each is refused from the tenth equal reading on."""
    rng, limits = np.random.default_rng(3), limits_of(SENSOR, True)
    x = np.cumsum(0.1 * rng.standard_normal((200, 200)), axis=1)
    z = np.round((x + 0.5 * rng.standard_normal(x.shape)) / 0.1) * 0.1
    z[:, 100:] = z[:, [100]]
    first = [int(np.argmax(limits.screen(row[:, None]).by("stuck"))) - 100 for row in z]
    assert max(first) == 9 and min(first) >= 7  # the readings before may have been equal by chance


def test_missing_readings_and_codes_end_no_run():
    limits = hg.Node(SENSOR, hg.perfect(), {}, invalid=-1, stuck=3).limits
    z = np.array([5.0, np.nan, 5.0, -1.0, 5.0, 5.0, 6.0, 5.0])[:, None]
    screened = limits.screen(z)
    np.testing.assert_array_equal(screened.by("stuck")[:, 0], [0, 0, 0, 0, 1, 1, 0, 0])
    np.testing.assert_array_equal(screened.by("code")[:, 0], [0, 0, 0, 1, 0, 0, 0, 0])
    # The same in two pieces.
    first = limits.screen(z[:3])
    np.testing.assert_array_equal(limits.screen(z[3:], first.repeats).values, screened.values[3:])


def test_a_recording_a_stream_and_a_timeline_refuse_the_same():
    """91 of 100 equal readings: the first nine are used. The estimates are those of a recording without the others."""
    x, z = stuck_recording()
    item = hg.kalman_filter(PLANT, SENSOR)
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.perfect(), {"k": item}, stuck=True)})
    assert network.claims()["a"]["k"] == "nominal"
    with pytest.warns(
        UserWarning,
        match="node 'a': 92 of 1000 values count as not arrived, by stuck; row 409: v -1.9 is stuck: 10 equal readings",
    ):
        record = hg.run(network, {"a": z[:, None]})
    stream, timeline = hg.Stream(item, stuck=True), hg.Timeline(network, window=0.0)
    for k in range(450):
        stream.push([z[k]])
        timeline.push("a", k, k, [z[k]])
    # Saved in the midst of the run, both go on.
    stream = hg.Stream.restore(item, stream.save(), stuck=True)
    timeline = hg.Timeline.restore(network, timeline.save())
    for k in range(450, 1000):
        estimate = stream.push([z[k]])
        timeline.push("a", k, k, [z[k]])
    assert (
        stream.refused["stuck"].tolist() == [92]
        and timeline.refused["a"]["stuck"] == 92
        and timeline.counts["a"]["implausible"] == 92
    )
    assert timeline.reasons["a"] == "v -1.9 is stuck: 10 equal readings in a row or more"
    mean = record.estimates["a"]["k"].mean
    np.testing.assert_allclose(estimate.mean, mean[-1], rtol=1e-12)
    np.testing.assert_allclose(timeline.estimates()["a"]["k"].mean, mean[-1], rtol=1e-12)
    assert estimate.claim == "nominal"
    # Squared errors over what is claimed, while the sensor stands: 1 where the claim holds.
    every = item.run(z[:, None])
    covariance = record.estimates["a"]["k"].covariance[:, 0, 0]
    nees = [np.mean((m[400:500] - x[400:500]) ** 2 / p[400:500]) for m, p in
            ((mean[:, 0], covariance), (every.means[:, 0], every.covariances[:, 0, 0]))]  # fmt: skip
    assert nees[0] < 2 and nees[1] > 15


@pytest.mark.parametrize("stuck", [1, "x", 2.5, [True, True], -3, [None, 3], [1.5], 10**7])
def test_what_is_no_count_is_refused(stuck):
    for make in (lambda: limits_of(SENSOR, stuck), lambda: hg.Stream(hg.kalman_filter(PLANT, SENSOR), stuck=stuck)):
        with pytest.raises(ValueError, match="stuck: expected True, a whole number of equal readings from 2 to"):
            make()


def test_what_does_not_say_is_refused():
    with pytest.raises(ValueError, match=r"a sensor with resolution=, or after how many equal readings, got no resol"):
        limits_of(hg.LinearSensor([[1.0]], 0.25), True)
    with pytest.raises(ValueError, match="a link that delivers readings as they are, or a number of equal readings"):
        limits_of(SENSOR, True, hg.hop(1.0, 0.1))
    with pytest.raises(ValueError, match="ends a run of equal readings before 1,000,000"):
        limits_of(hg.LinearSensor([[1.0]], 0.01, resolution=1.0), True)
    assert limits_of(SENSOR, True, hg.erasure(hg.perfect(), 0.8)).stuck.tolist() == [10]
    assert limits_of(SENSOR, 4, hg.hop(1.0, 0.1)).stuck.tolist() == [4]
