"""Times of rows at every door: dates by which a table knows them are used, and judged as those that are given are."""

import datetime
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import heliograph as hg

YEARS = [*range(1871, 1876), 1890, *range(1891, 1895)]
FLOW = np.array([1120.0, 1160.0, 963.0, 1210.0, 1160.0, 1140.0, 1050.0, 1120.0, 1160.0, 1210.0])
SENSOR = hg.LinearSensor([[1.0]], 15099.0)


def network_of(q=1469.0):
    plant = hg.LinearPlant([[1.0]], q, [1000.0], 1e5)
    return hg.Network(plant, {"a": hg.Node(SENSOR, hg.perfect(), {"f": hg.kalman_filter(plant, SENSOR)})})


NETWORK = network_of()
FILTER = NETWORK.nodes["a"].filters["f"]
DOORS = {
    "run": lambda z: hg.run(NETWORK, {"a": z}),
    "filter.run": lambda z: FILTER.run(z),
    "rts_smoother": lambda z: hg.rts_smoother(FILTER, z),
    "smoother_steps": lambda z: hg.smoothing.smoother_steps(FILTER, z),
    "simulation_smoother": lambda z: hg.smoothing.simulation_smoother(FILTER, z, draws=2),
    "log_likelihood": lambda z: hg.log_likelihood(FILTER, z),
    "predict_rows": lambda z: hg.forecasting.predict_rows(FILTER, z),
    "residuals": lambda z: hg.forecasting.residuals(FILTER, z, lags=2),
    "whitened_innovations": lambda z: hg.simulation.whitened_innovations(z, FILTER),
    "backtest": lambda z: hg.backtest(NETWORK, {"a": z}, [1], skip=2),
    "predictive": lambda z: hg.learning.predictive(NETWORK.plant, SENSOR, hg.perfect(), z),
    "fit": lambda z: hg.fit(lambda: network_of(hg.free(100.0, "q")), z, starts=1),
}
MOMENTS = [f"{year}-01-01" for year in YEARS]
DATES = {
    "dates": pd.DatetimeIndex(MOMENTS),
    "dates in a zone": pd.DatetimeIndex(MOMENTS, tz="UTC"),
    "periods": pd.PeriodIndex([str(year) for year in YEARS], freq="Y"),
    "texts": pd.Index(MOMENTS),
    "days": pd.Index([datetime.date(year, 1, 1) for year in YEARS]),
}
SAID = r"^time: steps of 1 and 15 years: a plant without the input dt takes each for one; insert the rows"


@pytest.mark.parametrize("door", DOORS)
def test_unequal_dates_are_said_once_of_the_line_that_calls(door):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        DOORS[door](pd.Series(FLOW, index=DATES["dates"]))
    said = [w for w in caught if "steps of" in str(w.message)]
    assert len(said) == 1 and Path(hg.__file__).parent not in Path(said[0].filename).parents


@pytest.mark.parametrize("kind", DATES)
def test_dates_of_every_kind_are_those_of_rows(kind):
    tables = [pd.Series(FLOW, index=DATES[kind]), pd.DataFrame({"flow": FLOW}, index=DATES[kind])]
    if kind == "dates":
        tables.append(xr.DataArray(FLOW, dims="time", coords={"time": DATES[kind]}))
    for table in tables:
        with pytest.warns(UserWarning, match=SAID):
            record = hg.run(NETWORK, {"a": table})
        np.testing.assert_array_equal(record.time, np.array(MOMENTS, "datetime64[ns]"))
        with pytest.warns(UserWarning, match=SAID):
            filtered = FILTER.run(table)
        assert filtered.origin.time == np.datetime64("1894-01-01")


@pytest.mark.parametrize("door", DOORS)
def test_rows_out_of_order_are_refused(door):
    with pytest.raises(ValueError, match=r"^dates of measurements.*times that do not go backwards, got 1893-01-01"):
        DOORS[door](pd.Series(FLOW, index=DATES["dates"][::-1]))


def test_equal_steps_and_tables_without_dates_pass_unsaid():
    frame = pd.DataFrame({"flow": FLOW})
    quiet = [frame, frame.set_index(np.arange(10) ** 2), frame.set_index(pd.date_range("2020", periods=10)), list(FLOW)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for table in quiet:
            FILTER.run(table)
            hg.run(NETWORK, {"a": table})


def test_a_forecast_goes_on_by_the_dates():
    days = pd.Series(FLOW, index=pd.date_range("2020-01-01", periods=10))
    for origin in (FILTER.run(days), hg.run(NETWORK, {"a": days})):
        ahead = hg.forecast(origin, 2)
        time = (ahead if hasattr(ahead, "time") else ahead["a"]["f"]).time
        np.testing.assert_array_equal(time, np.array(["2020-01-11", "2020-01-12"], "datetime64[ns]"))


def test_dates_that_differ_between_nodes_or_from_the_inputs_are_refused():
    plant = hg.LinearPlant([[1.0]], 1.0, [0.0], 1.0, input_matrix=[[1.0]], inputs=["u"])
    nodes = {name: hg.Node(SENSOR, hg.perfect(), {"f": hg.kalman_filter(plant, SENSOR)}) for name in "ab"}
    days = pd.date_range("2020-01-01", periods=10)
    z, later = pd.Series(FLOW, index=days), pd.Series(FLOW, index=days + pd.Timedelta("1D"))
    with pytest.raises(
        ValueError, match=r"^dates of measurements of node 'b': expected those of .*'a', got 2020-01-02"
    ):
        hg.run(hg.Network(plant, nodes), {"a": z, "b": later}, pd.DataFrame({"u": FLOW}))
    with pytest.raises(ValueError, match=r"^dates of inputs: expected those of measurements"):
        nodes["a"].filters["f"].run(z, pd.DataFrame({"u": FLOW}, index=later.index))


TIMES = {
    "dates": DATES["dates"],
    "zone": pd.Series(DATES["dates in a zone"]),
    "periods": DATES["periods"],
    "column of periods": pd.Series(DATES["periods"]),
    "texts": MOMENTS,
    "array of texts": np.array(MOMENTS),
    "months": [f"{year}-01" for year in YEARS],
    "quarters": [f"{year}Q1" for year in YEARS],
    "datetimes": [datetime.datetime(year, 1, 1) for year in YEARS],
    "days": tuple(datetime.date(year, 1, 1) for year in YEARS),
    "of NumPy": list(np.array(MOMENTS, "datetime64[D]")),
    "years of NumPy": np.array(MOMENTS, "datetime64[Y]"),
    "labelled": xr.DataArray(np.array(MOMENTS, "datetime64[ns]")),
    "masked": np.ma.array(np.array(MOMENTS, "datetime64[s]")),
}


@pytest.mark.parametrize("kind", TIMES)
def test_times_may_be_dates_of_any_kind(kind):
    with pytest.warns(UserWarning, match=SAID):
        record = hg.run(NETWORK, {"a": FLOW}, time=TIMES[kind])
    np.testing.assert_array_equal(record.time, np.array(MOMENTS, "datetime64[ns]"))


@pytest.mark.parametrize(
    ("times", "said"),
    [
        (["soon"] * 10, "time, row 1: expected a date as 2026"),
        ([*MOMENTS[:9], 3.0], "time, row 10: expected a date as 2026"),
        (MOMENTS[:9], r"time: expected 10 dates, got shape \(9,\)"),
        ([*MOMENTS[:9], None], "time: expected 10 dates, got .*1 of them missing"),
        (["2020-01-02", *["2020-01-01"] * 9], "time: expected times that do not go backwards"),
        (["2020-01-01T00:00Z", *["2020-01-01"] * 9], "time, row 2: expected a zone with every date or with none"),
        (np.array(["1500-01-01"] * 10, "datetime64[s]"), "time: expected dates from 1678 to 2262-04-11, got 1500"),
        (pd.timedelta_range("1s", periods=10), "time: expected numbers, or dates"),
        ("2020-01-01", "time: expected numbers, or dates"),
    ],
)
def test_times_that_are_none_are_refused_in_a_line(times, said):
    with pytest.raises(ValueError, match=f"^{said}"):
        hg.run(NETWORK, {"a": FLOW}, time=times)


@pytest.mark.parametrize("kind", [np.int64, np.uint64, object])
def test_whole_numbers_keep_every_digit(kind):
    """Doubles are 256 apart at today's nanoseconds since 1970: steps of 0, 256 and 0, none of them backwards."""
    ticks = [1_700_000_000_000_000_000 + 100 * i for i in range(4)]
    record = hg.run(NETWORK, {"a": np.ones((4, 1))}, time=np.array(ticks, dtype=kind))
    assert record.time.tolist() == ticks
    with pytest.raises(hg.InputError, match="got 1700000000000000000 after 1700000000000000100 in row 2"):
        hg.run(NETWORK, {"a": np.ones((4, 1))}, time=np.array([ticks[1], ticks[0], *ticks[2:]], dtype=kind))


@pytest.mark.parametrize("door", DOORS)
def test_numbers_that_are_still_packed_are_refused(door):
    """As xarray reads them with mask_and_scale=False: .1 of the numbers was meant, and -999 was used as a value."""
    packed = xr.Dataset(
        {"z": ("time", FLOW, {"scale_factor": 0.1, "_FillValue": -999.0})},
        {"time": ("time", np.arange(10.0), {"units": "days since 2000-01-01"})},
    )
    values, times = packed.z.drop_vars("time"), packed.z.copy()
    times.attrs.clear()
    for rows, said in ((values, "attribute 'scale_factor'"), (times, "'units' of 'days since 2000")):
        with pytest.raises(hg.InputError, match=rf"as xarray\.decode_cf makes them, got .*{said}"):
            DOORS[door](rows)
    decoded = xr.decode_cf(packed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        DOORS[door](decoded.z)


def test_spans_of_time_are_seconds_and_their_steps_are_said():
    """They were no times: an index of 0, 1 and 5 hours was rows 0, 1 and 2."""
    spans = pd.to_timedelta([0, 1, 5], "h")
    for rows in (pd.Series(FLOW[:3], index=spans), xr.DataArray(FLOW[:3], dims="time", coords={"time": spans})):
        with pytest.warns(UserWarning, match=r"^time: steps of 9000 and 14400: a plant without the input dt"):
            record = hg.run(NETWORK, {"a": rows})
        assert record.time.tolist() == [0.0, 3600.0, 18000.0]
    plant = hg.LinearPlant([[1.0]], 1.0, [0.0], 1.0, [[1.0]], inputs=["push"])
    two = hg.Network(plant, {"a": hg.Node(SENSOR, hg.perfect(), {"f": hg.kalman_filter(plant, SENSOR)})})
    pushes = pd.Series(np.zeros(3), index=pd.date_range("2026-01-01", periods=3))
    with pytest.raises(hg.InputError, match=r"times of inputs: expected spans of time, as .* has, got dates"):
        hg.run(two, {"a": pd.Series(FLOW[:3], index=spans)}, pushes.to_frame())


def test_dates_of_another_calendar_are_refused():
    """As of climate models: from 28 February 2000 to 1 March is one day there, and was two."""
    from types import SimpleNamespace

    class Day(SimpleNamespace):
        def isoformat(self):
            return self.text

    days = [Day(text="2000-02-28", calendar="noleap"), Day(text="2000-03-01", calendar="noleap")]
    with pytest.raises(hg.InputError, match="expected a date of the calendar standard, got 2000-02-28 of noleap"):
        hg.run(NETWORK, {"a": FLOW[:2]}, time=days)
    same = [Day(text=day.text, calendar="proleptic_gregorian") for day in days]
    assert hg.run(NETWORK, {"a": FLOW[:2]}, time=same).time.astype(str)[1] == "2000-03-01T00:00:00.000000000"


def test_text_is_no_number_at_any_door():
    """A list of texts was refused, and a table of the same texts was used."""
    texts = ["1120", "1160"]
    for rows in (texts, pd.Series(texts), pd.DataFrame({"z": texts}), pd.Series(texts, dtype="category"),
                 np.array(texts, dtype=object)):  # fmt: skip
        for door in ("run", "filter.run", "log_likelihood"):
            with pytest.raises(hg.InputError, match="expected an array of numbers, got"):
                DOORS[door](rows)
