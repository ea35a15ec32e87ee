"""Forecasts in tables: marked rows below those of the data, states and outputs with their deviations."""

import numpy as np

import heliograph as hg
from heliograph.files import read_table, write_forecast


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
