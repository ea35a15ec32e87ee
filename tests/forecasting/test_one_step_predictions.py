"""What each filter of a record predicted of each row: as the filter alone does, and as its estimates say."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.forecasting import predict_record, predict_rows


def network_of(*steered):
    moved = hg.LinearPlant([[0.9]], 0.5, [0.0], 2.0, *steered)
    sensor = hg.LinearSensor([[1.0]], 0.3, outputs=["y"])
    node = hg.Node(sensor, hg.perfect(1), {"f": hg.kalman_filter(moved, sensor)})
    return hg.Network(moved, {"a": node})


def test_a_record_predicts_as_its_filters_do():
    """Where nothing arrived the estimate is the prediction; elsewhere it lies nearer to what arrived."""
    network, z = network_of(), np.array([[1.0], [np.nan], [np.nan], [-2.0], [0.5]])
    times = np.arange("2024-01-01", "2024-01-06", dtype="datetime64[D]").astype("datetime64[ns]")
    record = hg.run(network, {"a": z}, time=times)
    found = predict_record(record)["a"]["f"]
    alone = predict_rows(network.nodes["a"].filters["f"], z)
    np.testing.assert_array_equal(found.time, times)
    np.testing.assert_allclose(found.received.mean, alone.received.mean, rtol=1e-13)
    np.testing.assert_allclose(found.states.covariance, alone.states.covariance, rtol=1e-13)
    estimate = record.estimates["a"]["f"]
    np.testing.assert_allclose(found.states.mean[1:3], estimate.mean[1:3], rtol=1e-13)
    np.testing.assert_allclose(found.states.covariance[1:3], estimate.covariance[1:3], rtol=1e-13)
    assert abs(estimate.mean[3, 0] + 2) < abs(found.states.mean[3, 0] + 2)
    np.testing.assert_allclose(found.outputs.covariance, found.states.covariance + 0.3, rtol=1e-13)


def test_rows_are_selected_and_others_refused():
    record = hg.run(network_of(), {"a": [[1.0], [np.nan], [3.0]]})
    found = predict_record(record)["a"]["f"]
    some = found.select(np.array([True, False, True]))
    assert some.time.tolist() == [0, 2]
    assert some.outputs.quantile(0.9).tolist() == found.outputs.quantile(0.9)[[0, 2]].tolist()
    with pytest.raises(hg.InputError, match="rows: expected 3 of true and false"):
        found.select([0, 2])


def test_what_no_run_made_is_refused():
    network = network_of([[1.0]])
    record = hg.run(network, {"a": [[1.0], [2.0]]}, [[0.0], [1.0]])
    assert predict_record(record, [[0.0], [1.0]])["a"]["f"].states.mean[1, 0] > 1
    with pytest.raises(hg.InputError, match="inputs: expected an array"):
        predict_record(record)
    with pytest.raises(hg.InputError, match="record: expected a Record"):
        predict_record(network)
    simulated = hg.simulate(network_of(), 3, 0)
    with pytest.raises(hg.InputError, match="without states"):
        predict_record(simulated)
