"""Forecasts of data by year, quarter and month: their steps are of the calendar, not of seconds."""

from datetime import datetime, timedelta

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
    first = np.datetime64(last, "M") - np.timedelta64(23 * months, "M")
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


@pytest.mark.parametrize(
    ("unit", "months", "span", "steps"),
    [
        ("M", 1, np.timedelta64(2, "Y"), 24),
        ("M", 3, np.timedelta64(6, "M"), 2),
        ("Y", 12, np.timedelta64(12, "M"), 1),
        ("Y", 12, np.timedelta64(3, "Y"), 3),
    ],
)
def test_spans_of_months_and_years_are_counted_on_the_calendar(unit, months, span, steps):
    assert forecast("2020-01", 24, unit, months, [span]).steps.tolist() == [steps]


@pytest.mark.parametrize("span", [np.timedelta64(1, "M"), np.timedelta64("NaT", "s")])
def test_a_month_is_no_span_between_days(span):
    days = np.arange("2000-01-01", "2000-01-13", dtype="datetime64[D]")
    record = hg.run(NETWORK, {"a": np.ones(12)}, time=days)
    with pytest.raises(hg.InputError, match=r"horizons: expected spans of weeks or shorter units"):
        hg.forecast(record, [span])


@pytest.mark.parametrize(
    ("unit", "horizons"),
    [
        ("Y", [1, 300]),  # would end in 1716, as 64 bits of nanoseconds overflow
        ("D", [1, 100_000]),  # in 1689
        ("D", [datetime(2600, 1, 1)]),  # in 2015: after the data
        ("D", [np.datetime64("2500-01-01")]),
        ("D", [timedelta(days=200_000)]),
        ("D", [np.timedelta64(50_000, "W")]),
        ("D", [np.timedelta64(2**62, "W")]),
    ],
)
def test_dates_that_nanoseconds_cannot_say_are_refused(unit, horizons):
    record = hg.run(NETWORK, {"a": np.ones(12)}, time=np.datetime64("2000-01-01", unit) + np.arange(12))
    with pytest.raises(hg.InputError, match=r"^horizons.* from 1678 to 2262-04-11"):
        hg.forecast(record, horizons)


def test_a_date_further_than_a_span_of_nanoseconds_is_counted_in_steps():
    """Three centuries are more nanoseconds than 64 bits hold; both dates are within them."""
    record = hg.run(NETWORK, {"a": np.ones(12)}, time=np.datetime64("1700-01-01") + np.arange(12))
    found = hg.forecast(record, [np.datetime64("2101-01-12")])["a"]["k"]
    assert found.steps.tolist() == [146_462]  # days from 1700-01-12
    assert str(found.time[0])[:10] == "2101-01-12"
