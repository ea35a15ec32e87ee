"""A stream refuses what is not its filter's, with one line, and stays as it was."""

import numpy as np
import pytest

import heliograph as hg

PLANT = hg.LinearPlant([[0.9, 0.2], [0.0, 0.8]], 0.1, [1.0, -1.0], 1.0, [[1.0], [0.0]], inputs=["push"])
SENSOR = hg.LinearSensor(np.eye(2), 0.5)
REFUSED = [
    ([1.0], [0.0], r"measurement: expected 2 numbers, got shape \(1,\)"),
    (1.0, [0.0], r"measurement: expected 2 numbers, got shape \(\)"),
    ([1.0, 2.0, 3.0], [0.0], r"measurement: expected 2 numbers, got shape \(3,\)"),
    ([[1.0, 2.0]], [0.0], r"measurement: expected 2 numbers, got shape \(1, 2\)"),
    ([1.0, np.inf], [0.0], "measurement: expected numbers, or NaN for what is missing, got"),
    (None, [0.0], "measurement: expected 2 numbers, got None"),
    ([None, 1.0], [0.0], r"measurement: expected 2 numbers, got \[None, 1.0\]"),
    (["1", "2"], [0.0], r"measurement: expected 2 numbers, got \['1', '2'\]"),
    ([1j, 2.0], [0.0], "measurement: expected 2 numbers, got"),
    ([[1.0], [1.0, 2.0]], [0.0], "measurement: expected 2 numbers, got"),
    ([1.0, 2.0], (), r"inputs \['push'\]: expected 1 number, got none"),
    ([1.0, 2.0], [0.0, 1.0], r"inputs \['push'\]: expected 1 number, got shape \(2,\)"),
    ([1.0, 2.0], [np.nan], "inputs: expected finite numbers, got"),
    ([1.0, 2.0], [-np.inf], "inputs: expected finite numbers, got"),
    ([1.0, 2.0], "1", r"inputs \['push'\]: expected 1 number, got '1'"),
]


def filters():
    return {"kalman": hg.kalman_filter(PLANT, SENSOR), "linear": hg.linear_filter(PLANT, SENSOR, hg.perfect(2))}


@pytest.mark.parametrize("name", filters())
def test_what_does_not_fit_changes_nothing(name):
    stream, other = hg.Stream(filters()[name]), hg.Stream(filters()[name])
    for z, u, message in REFUSED:
        with pytest.raises(ValueError, match=message) as caught:
            stream.push(z, u)
        assert "\n" not in str(caught.value)
    assert stream.steps == 0
    for z in ([0.5, 1.0], [np.nan, 2.0], np.array([1, 2])):  # whole numbers will do
        np.testing.assert_array_equal(stream.push(z, [0.3]).mean, other.push(z, 0.3).mean)


def test_a_filter_that_hears_nothing_takes_any_measurement():
    stream = hg.Stream(hg.open_loop_filter(PLANT))
    for z in ([1.0], [1.0, 2.0], np.nan):
        stream.push(z, [0.0])
    with pytest.raises(ValueError, match="measurement: expected numbers, got None"):
        stream.push(None, [0.0])


def test_past_the_end_of_what_varies_it_stops():
    channels = hg.over_time([hg.hop(1.0, 0.1 * (k + 1), dimension=2) for k in range(3)])
    stream = hg.Stream(hg.linear_filter(PLANT, SENSOR, channels))
    for _ in range(3):
        last = stream.push([1.0, 0.0], [0.0])
    with pytest.raises(ValueError, match="step: expected one of the 3 that the filter covers, counted from 0, got 3"):
        stream.push([1.0, 0.0], [0.0])
    assert stream.steps == 3 and np.all(np.isfinite(last.mean))


def test_a_polynomial_filter_goes_on_only_where_it_has_settled():
    plant, sensor = hg.LinearPlant([[0.7]], 1.0, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.5)
    unsettled = hg.Stream(hg.polynomial_filter(plant, sensor, hg.hop(hg.Rayleigh(1.0), 0.1), 4))
    for _ in range(4):
        unsettled.push(1.0)
    with pytest.raises(ValueError, match="step: expected one of the 4"):
        unsettled.push(1.0)


def test_a_network_refuses_filters_that_do_not_fit_it():
    item = hg.kalman_filter(PLANT, SENSOR)
    with pytest.raises(ValueError, match="filter 'f': expected one that hears the 1 numbers that arrive, got one that"):
        hg.Node(hg.LinearSensor([[1.0, 0.0]], 0.5), hg.perfect(), {"f": item})
    still = hg.LinearPlant(PLANT.matrix, 0.1, [1.0, -1.0], 1.0)
    node = hg.Node(SENSOR, hg.perfect(2), {"f": item})
    with pytest.raises(ValueError, match="filter 'f' of node 'a': expected the plant's 0 inputs"):
        hg.Network(still, {"a": node})
    with pytest.raises(ValueError, match="fused 'all': expected one that hears the 4 numbers that arrive"):
        hg.Network(PLANT, {"a": node, "b": node}, {"all": item})
    hg.Network(PLANT, {"a": node, "b": node}, {"all": hg.filters.sequential_filter([item, item])})
