"""Forecasts from a start that nobody knows: the limit of ever larger covariances, and nothing before it was heard."""

import json
import warnings

import numpy as np
import pytest

import heliograph as hg
from heliograph.serving import Fleet, InMemoryStore, NetworkProgram, Options, Service, parse_threshold

F, Q, SENSOR = [[1.0, 1.0], [0.0, 1.0]], np.diag([1.0, 0.1]), hg.LinearSensor([[1.0, 0.0]], 15.0, outputs=["y"])
DATA = np.cumsum(np.random.default_rng(0).normal(size=40))


def trend(start=hg.diffuse):
    """A level and its slope."""
    return hg.kalman_filter(hg.LinearPlant(F, Q, [0.0, 0.0], start, states=["level", "slope"]), SENSOR)


def network(filter):
    return hg.Network(filter.plant, {"a": hg.Node(SENSOR, hg.perfect(1), {"k": filter})})


def test_once_it_was_heard_the_forecast_is_the_limit():
    """By two rows all is known; of a covariance c the limit differs by 1 / c, and elimination leaves c eps."""
    for rows in (2, 3, 40):
        found, near = (hg.forecast(trend(start).run(DATA[:rows]), 3) for start in (hg.diffuse, 1e8 * np.eye(2)))
        for part in ("states", "outputs", "received"):
            np.testing.assert_allclose(getattr(found, part).mean, getattr(near, part).mean, rtol=1e-6, atol=1e-6)
            covariances = getattr(found, part).covariance, getattr(near, part).covariance
            np.testing.assert_allclose(*covariances, rtol=2e-6, atol=1e-6)
            assert getattr(found, part).claim == "exact"


def test_before_it_was_heard_bands_are_endless_and_probabilities_none():
    for rows in (0, 1):
        found = hg.forecast(trend().run(DATA[:rows][:, None]), 2)
        for part in (found.states, found.outputs, found.received):
            low, high = part.interval(0.8)
            assert np.isinf(part.deviation).all() and (low == -np.inf).all() and (high == np.inf).all()
            assert np.isnan(part.below(1.0)).all() and np.isnan(part.quantile(0.5)).all()
    known = hg.diffuse(["slope"], 4.0)  # the level is known, its slope is not
    part = hg.forecast(trend(known).run(np.zeros((0, 1))), 1).states
    assert np.isinf(part.deviation).all()  # the level one step ahead has the slope in it
    with pytest.raises(ValueError, match=r"paths: expected a state that is known, got .* \(hg.diffuse\)"):
        hg.forecasting.crossing(trend().run(DATA[:1]), "level", 1.0, 3)


def test_live_objects_and_lists_of_them_begin_with_nothing():
    filter = trend()
    streams, timeline = [hg.Stream(filter) for _ in range(3)], hg.Timeline(network(filter), 5.0)
    for k in range(3):
        timeline.push("a", k, k, [DATA[k]])
        for stream in streams[:k]:
            stream.push([DATA[k]])
    together = hg.forecast(streams, [1, 4])
    assert np.isinf(together.states.deviation[2]).all() and np.isfinite(together.states.deviation[0]).all()
    for i, stream in enumerate(streams):
        np.testing.assert_array_equal(
            together.of_source(i).outputs.covariance, hg.forecast(stream, [1, 4]).outputs.covariance
        )
    alone = hg.forecast(filter.run(DATA[:3]), [1, 4])
    np.testing.assert_allclose(
        hg.forecast(timeline, [1, 4])["a"]["k"].states.covariance, alone.states.covariance, rtol=1e-12
    )


def test_a_service_says_nothing_of_what_it_has_not_heard():
    fleet = Fleet(NetworkProgram(network(trend())), Options(window=5.0))
    served = Service(fleet, InMemoryStore(), forecast=[2], thresholds=(parse_threshold("level>1"),))
    told = []
    for k in range(2):
        body = {"plant": "p", "node": "a", "sequence": k, "time": k, "values": [float(DATA[k])]}
        *_, output = served.take([json.dumps(body).encode()])
        told.append(json.loads(output.body)["forecast"][0]["estimates"]["a"]["k"])
    assert (told[0]["claim"], told[0]["covariance"], "thresholds" in told[0]) == ("none", None, False)
    assert told[1]["claim"] == "exact" and 0 < told[1]["thresholds"]["level>1"]["by"] < 1


def test_what_is_judged_begins_where_it_was_heard():
    filter = trend()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "a/k: no valid covariance from step 0")  # it says so of the first row
        one = hg.backtest(network(filter), {"a": DATA}, [1], skip=0).of("a", "k", "y", 1)
    assert one.compared == len(DATA) - 2 and np.isfinite(one.crps.value)
    left = hg.forecasting.residuals(filter, DATA)
    assert np.isnan(left.values[:2]).all() and np.isfinite(left.values[2:]).all()
    smoothed = hg.forecasting.disturbances(filter, DATA)
    near = hg.forecasting.disturbances(trend(1e8 * np.eye(2)), DATA)
    assert np.isnan(smoothed.state_noise[:2]).all()
    np.testing.assert_allclose(smoothed.state_noise[2:], near.state_noise[2:], rtol=1e-5, atol=1e-7)
