"""Forecasts of many sources side by side: bit by bit those of each alone, and for the cost of a prediction each."""

import time
from functools import partial

import numpy as np
import pytest

import heliograph as hg

PLANT = hg.LinearPlant([[0.95, 0.2], [0, 0.9]], np.diag([0.1, 0.2]), [0, 0], np.eye(2), [[0.0], [1.0]],
                       states=["x", "v"], inputs=["force"])  # fmt: skip
SENSOR = hg.LinearSensor([[1.0, 0.0]], 0.3, outputs=["x"])
PARTS = "states", "outputs", "received"


def same(found, alone, rtol=0.0):
    """Whether two forecasts are one another's, bit by bit unless a tolerance is given."""
    for name in PARTS:
        of, other = getattr(found, name), getattr(alone, name)
        assert (of is None) == (other is None)
        if of is None:
            continue
        assert (of.names, of.claim) == (other.names, other.claim)
        for key in ("mean", "covariance", "weights", "part_means", "part_variances"):
            np.testing.assert_allclose(getattr(of, key), getattr(other, key), rtol=rtol, atol=rtol)
        np.testing.assert_allclose(of.quantile(0.9), other.quantile(0.9), rtol=rtol, atol=rtol)
    np.testing.assert_array_equal(found.time, alone.time)
    assert (found.steps.tolist(), found.inputs) == (alone.steps.tolist(), alone.inputs)


def results(filter, count=3):
    """Results of one filter on recordings of other lengths, so that they end at other steps."""
    rng = np.random.default_rng(3)
    return [filter.run(rng.normal(size=(4 + i, 1)), rng.normal(size=(4 + i, 1))) for i in range(count)]


def test_results_of_one_filter_are_forecast_as_each_alone():
    sources = results(hg.kalman_filter(PLANT, SENSOR))
    found = hg.forecast(sources, [1, 4], inputs="held")
    assert found.states.mean.shape == (3, 2, 2) and found.outputs.interval(0.8)[0].shape == (3, 2, 1)
    assert found.time.tolist() == [[4.0, 7.0], [5.0, 8.0], [6.0, 9.0]]
    for i, source in enumerate(sources):
        same(found.of_source(i), hg.forecast(source, [1, 4], inputs="held"))
    np.testing.assert_array_equal(found.states.below(0.5)[1], found.of_source(1).states.below(0.5))
    same(found.select([False, True]).of_source(2), hg.forecast(sources[2], [4], inputs="held"))


def test_inputs_are_those_of_all_or_of_each():
    sources, rows = results(hg.kalman_filter(PLANT, SENSOR)), np.arange(12.0).reshape(3, 4, 1)
    each, one = hg.forecast(sources, 4, inputs=rows), hg.forecast(sources, 4, inputs=rows[1])
    for i, source in enumerate(sources):
        same(each.of_source(i), hg.forecast(source, 4, inputs=rows[i]))
        same(one.of_source(i), hg.forecast(source, 4, inputs=rows[1]))


@pytest.mark.parametrize("make", [hg.filters.imm_filter, partial(hg.filters.particle_filter, particles=20)])
def test_modes_and_particles_are_mixtures_side_by_side(make):
    """Also where sums of many (particles) have another order side by side."""
    plant, sensor = hg.LinearPlant([[1.0]], 1.0, [0.0], 4.0), hg.LinearSensor([[1.0]], 0.1)
    filter = make(plant, sensor, hg.markov_fading([1.0, -1.0], [[0.95, 0.05], [0.05, 0.95]], noise=0.1))
    sources = [filter.run([[value]]) for value in (9.0, -2.0)]
    found = hg.forecast(sources, 2)
    for i, source in enumerate(sources):
        same(found.of_source(i), hg.forecast(source, 2), 1e-12)


def test_angles_and_a_clock_in_time_are_of_each():
    plant = hg.LinearPlant([[1.0]], 0.01, [3.0], 0.01, [[1.0]], inputs=["dt"], circular=["x0"])
    filter = hg.cubature_filter(plant, hg.LinearSensor([[1.0]], 0.01, circular=["y0"]))
    sources = [filter.run([[3.1], [-3.1]], [[0.5], [0.5]]), filter.run([[2.0]], [[0.5]])]
    found = hg.forecast(sources, [0.2, 1.0])
    for i, source in enumerate(sources):
        same(found.of_source(i), hg.forecast(source, [0.2, 1.0]))


def world():
    """Two nodes, their filters, and what is fused of them by intersection."""
    filters = {"best": hg.kalman_filter(PLANT, SENSOR)}
    nodes = {name: hg.Node(SENSOR, hg.perfect(1), filters) for name in ("a", "b")}
    return hg.Network(PLANT, nodes, {"ci": hg.Fusion("best", hg.CovarianceIntersection())})


def test_timelines_and_records_of_a_network_are_forecast_by_node_and_filter():
    network, rng = world(), np.random.default_rng(5)
    sources = []
    for i in range(2):
        timeline = hg.Timeline(network, 5.0)
        for k in range(3 + i):
            timeline.push("inputs", k, k, rng.normal(size=1))
            timeline.push("a", k, k, rng.normal(size=1))
        sources.append(timeline)
    rows = {name: rng.normal(size=(6, 1)) for name in ("a", "b")}
    records = [hg.run(network, rows, rng.normal(size=(6, 1))) for _ in range(2)]
    for several in (sources, records):
        found = hg.forecast(several, 3, inputs="held")
        for i, source in enumerate(several):
            alone = hg.forecast(source, 3, inputs="held")
            assert {node: list(filters) for node, filters in found.items()} == {"a": ["best"], "b": ["best"],
                                                                                "fused": ["ci"]}  # fmt: skip
            for node, filters in alone.items():
                for name, one in filters.items():
                    same(found[node][name].of_source(i), one, 1e-12 if node == "fused" else 0.0)  # factored apart


def test_dates_are_those_of_all_or_refused():
    network, days = world(), np.arange("2026-01-01", "2026-01-09", dtype="datetime64[D]").astype("datetime64[ns]")
    records = [
        hg.run(network, {"a": np.zeros((count, 1)), "b": np.zeros((count, 1))}, np.zeros((count, 1)), days[:count])
        for count in (6, 6, 8)
    ]
    date = [np.datetime64("2026-01-10")]
    found = hg.forecast(records[:2], date, inputs="held")["a"]["best"]
    assert (
        found.steps.tolist() == [4] and found.time.astype("datetime64[D]").astype(str).tolist() == [["2026-01-10"]] * 2
    )
    with pytest.raises(ValueError, match="horizons: expected how far ahead, as the sources end at different dates"):
        hg.forecast(records, date, inputs="held")


def test_a_model_that_varies_ends_for_the_source_that_is_furthest():
    """Each is predicted by the sensor of its own step; no further than the model covers."""
    plant = hg.LinearPlant([[0.9]], 1.0, [0.0], 1.0)
    sensors = hg.model.over_time([hg.LinearSensor([[1.0 + k]], 0.1) for k in range(6)])
    filter = hg.kalman_filter(plant, sensors)
    sources = [filter.run(np.ones((rows, 1))) for rows in (1, 3)]
    found = hg.forecast(sources, 3)
    for i, source in enumerate(sources):
        same(found.of_source(i), hg.forecast(source, 3))
    with pytest.raises(ValueError, match="at most 3 steps, which the model covers"):
        hg.forecast(sources, 4)


REFUSED = [
    (lambda s: hg.forecast([], 3), "at least one source, got an empty list"),
    (lambda s: hg.forecast([s[0], "data"], 3), "forecast: expected a result of filter.run"),
    (lambda s: hg.forecast([s[0], *results(hg.kalman_filter(PLANT, SENSOR), 1)], 3, "held"), "forecast, source 1: exp"),
    (lambda s: hg.forecast(s, 3, inputs=np.zeros((2, 3, 1))), "shape \\(3, 3, 1\\)"),
    (lambda s: hg.forecast(s, 3, inputs="held").of_source(3), "source: expected a number from 0 to 2, got 3"),
    (lambda s: hg.forecast(s[0], 3, inputs="held").of_source(0), "source: expected the forecast of a list"),
    (lambda s: hg.forecasting.draw_paths(s, 3, "held"), "forecast: expected a result of filter.run or hg.run"),
]


@pytest.mark.parametrize(("call", "said"), REFUSED)
def test_what_cannot_be_forecast_together_is_one_line(call, said):
    with pytest.raises(ValueError, match=said) as refused:
        call(results(hg.kalman_filter(PLANT, SENSOR)))
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_ten_thousand_plants_cost_a_prediction_each():
    """0.5 us of a processor each, with what gathers their states 15, as a `Stream` takes for a row; 900 alone."""
    filter, count = hg.kalman_filter(PLANT, SENSOR), 10_000
    stream, result = hg.Stream(filter), filter.run(np.ones((5, 1)), np.ones((5, 1)))
    many = [result] * count

    def spent(call, repeats):
        began = time.process_time()
        for _ in range(repeats):
            call()
        return (time.process_time() - began) / repeats

    def least(call, repeats):
        return min(spent(call, repeats) for _ in range(3))

    hg.forecast(many, [1], inputs="held")
    each = least(lambda: hg.forecast(many, [1], inputs="held"), 1) / count
    assert each < 3 * least(lambda: stream.push([1.0], [0.0]), 500)
    assert each < least(lambda: hg.forecast(result, [1], inputs="held"), 50) / 10
