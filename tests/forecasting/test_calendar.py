"""Forecasts of data by year, quarter and month: their steps are of the calendar, not of seconds."""

import numpy as np
import pytest

import heliograph as hg

PLANT, SENSOR = hg.LinearPlant([[1.0]], 1.0, [0.0], 1.0), hg.LinearSensor([[1.0]], 1.0)
NETWORK = hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.perfect(1), {"k": hg.kalman_filter(PLANT, SENSOR)})})


def forecast(first, count, unit, months, horizons):
    start = np.datetime64(first, "M") + months * np.arange(count)
    time = start.astype(f"datetime64[{unit}]")
    record = hg.run(NETWORK, {"a": np.arange(float(count))}, time=time)
    return hg.forecast(record, horizons)["a"]["k"]


@pytest.mark.parametrize(
    ("unit", "months", "last", "ahead"),
    [
        ("M", 1, "2024-01", ["2024-02-01", "2024-03-01", "2024-04-01"]),
        ("M", 3, "2023-10", ["2024-01-01", "2024-04-01", "2024-07-01"]),
        ("Y", 12, "2023-01", ["2024-01-01", "2025-01-01", "2026-01-01"]),
    ],
)
def test_steps_ahead_are_firsts_of_months(unit, months, last, ahead):
    first = np.datetime64(last) - 23 * months
    found = forecast(first, 24, unit, months, 3)
    assert found.time.astype("datetime64[D]").astype(str).tolist() == ahead
    dated = forecast(first, 24, unit, months, [np.datetime64(ahead[0]), np.datetime64(ahead[2])])
    assert dated.steps.tolist() == [1, 3]


def test_a_date_between_the_steps_is_refused():
    with pytest.raises(hg.InputError, match="horizons: expected whole steps of 3 months"):
        forecast("2020-01", 24, "M", 3, [np.datetime64("2026-02")])


def test_texts_of_years_are_dates():
    record = hg.run(NETWORK, {"a": np.arange(5.0)}, time=["1871", "1872", "1873", "1874", "1875"])
    assert str(record.time[-1])[:10] == "1875-01-01"
    assert str(hg.forecast(record, 1)["a"]["k"].time[0])[:10] == "1876-01-01"
