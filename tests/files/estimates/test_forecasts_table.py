"""Forecasts in tables: marked rows below those of the data, states and outputs with their deviations."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.files import read_table, write_estimates, write_forecast


def test_rows_of_forecasts_are_marked(tmp_path):
    plant = hg.LinearPlant([[1.0]], 1.0, [0.0], 4.0, states=["level"])
    sensor = hg.LinearSensor([[2.0]], 0.5, outputs=["flow"])
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(1), {"f": hg.kalman_filter(plant, sensor)})})
    record = hg.run(network, {"a": [1.0, 2.0]})
    forecasts = hg.forecast(record, 2)
    write_forecast(record, forecasts, tmp_path / "out.csv")
    columns = read_table(tmp_path / "out.csv")
    assert columns["forecast"].tolist() == [0, 0, 1, 1]
    assert columns["time"].tolist() == [0, 1, 2, 3]
    result = forecasts["a"]["f"]
    np.testing.assert_array_equal(columns["level"][2:], result.states.mean[:, 0])
    np.testing.assert_array_equal(columns["forecast.flow"][2:], result.outputs.mean[:, 0])
    np.testing.assert_array_equal(columns["forecast.flow.sd"][2:], result.outputs.deviation[:, 0])
    assert np.isnan(columns["forecast.flow"][:2]).all()


def test_what_was_predicted_of_each_row_stands_beside_the_estimates(tmp_path):
    """A state and an output of one name stay apart; rows of forecasts have none; other rows are refused."""
    plant = hg.LinearPlant([[1.0]], 1.0, [0.0], 4.0, states=["level"])
    sensor = hg.LinearSensor([[2.0]], 0.5, outputs=["level"])
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(1), {"f": hg.kalman_filter(plant, sensor)})})
    record = hg.run(network, {"a": [1.0, np.nan, 2.0]})
    predicted = hg.forecasting.predict_record(record)
    write_estimates(record, tmp_path / "out.csv", predicted)
    columns, law = read_table(tmp_path / "out.csv"), predicted["a"]["f"]
    np.testing.assert_array_equal(columns["predicted.level"], law.states.mean[:, 0])
    np.testing.assert_array_equal(columns["predicted.level.sd"], law.states.deviation[:, 0])
    np.testing.assert_array_equal(columns["predicted.output.level"], law.outputs.mean[:, 0])
    assert columns["predicted.output.level"][1] == 2 * columns["level"][1]
    assert columns["predicted.output.level.sd"][0] == np.sqrt(4 * 5.0 + 0.5)
    write_forecast(record, hg.forecast(record, 2), tmp_path / "ahead.csv", predicted)
    assert np.isnan(read_table(tmp_path / "ahead.csv")["predicted.level"]).tolist() == [False] * 3 + [True] * 2
    with pytest.raises(hg.InputError, match="predicted: expected 3 rows, as the record has, got 2 rows"):
        write_estimates(record, tmp_path / "out.csv", {"a": {"f": hg.forecast(record, 2)["a"]["f"]}})
    with pytest.raises(hg.InputError, match="predicted: expected what predict_record returns"):
        write_estimates(record, tmp_path / "out.csv", law)
