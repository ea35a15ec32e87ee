"""Forecasts in tables: rows behind those of a recording, marked as such, with what the sensors would measure."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from heliograph.files.estimates.estimates_table import estimate_columns, make_column_header
from heliograph.files.tables.table import write_table
from heliograph.model.estimate import Estimate
from heliograph.numerics.check import fail, instance, show_value
from heliograph.numerics.types import unit_of
from heliograph.simulation.results.record import Record

if TYPE_CHECKING:
    import heliograph

FORECAST = "forecast"  # the column that marks rows, and what stands before the names of outputs
ByFilter = Mapping[str, "Mapping[str, heliograph.forecasting.Forecast]"]  # by node and filter


def make_forecast_columns(
    record: Record, forecasts: ByFilter, predicted: ByFilter | None = None
) -> dict[str, np.ndarray]:
    """Return the columns of the estimates, with rows of forecasts below the rows of data.

    The column `forecast` is true in rows of forecasts. What each sensor would measure then stands in the columns
    forecast.OUTPUT and forecast.OUTPUT.sd (standard deviation), NaN in rows of data; the names begin with node and
    filter if there are several. `record`: a run over data. `forecasts`: by node and filter, after the last row of data.
    `predicted`: optional one-step predictions of rows of data, NaN in rows of forecasts. `_append_rows` puts the
    forecast's rows below those of the data, NaN where it has none.
    """
    # All forecasts have the same times.
    times = next(forecast for filters in forecasts.values() for forecast in filters.values()).time
    rows = len(record.time)
    # Take the forecast states as estimates of a record of their own, so that their columns are made in the same way.
    estimates = {
        node: {name: Estimate(f.states.mean, f.states.covariance, f.states.claim) for name, f in filters.items()}
        for node, filters in forecasts.items()
    }
    # Columns of data above, columns of forecasts below; a column that forecasts lack is filled up.
    above = estimate_columns(record, predicted)
    below = estimate_columns(replace(record, time=times, truth=None, estimates=estimates, smoothed=None))
    columns = {name: _append_rows(values, below.get(name), len(times)) for name, values in above.items()}
    is_forecast = np.arange(rows + len(times)) >= rows
    columns = {"time": columns.pop("time"), FORECAST: is_forecast, **columns}
    # Node and filter are part of a name where there are several of them.
    has_several_nodes = len(forecasts) > 1
    has_several_filters = any(len(filters) > 1 for filters in forecasts.values())
    for node, filters in forecasts.items():
        for name, forecast in filters.items():
            prefix = (f"{node}." if has_several_nodes else "") + (f"{name}." if has_several_filters else "")
            columns |= _make_output_columns(f"{prefix}{FORECAST}.", forecast, rows)
    return columns


def write_forecast(record: Record, forecasts: ByFilter, path: str | Path, predicted: ByFilter | None = None) -> None:
    """Write the estimates of a run, and below them rows of forecasts, to a CSV or Parquet file, whole or not at all.

    Rows of forecasts have 1 in the column `forecast`. The columns forecast.OUTPUT and forecast.OUTPUT.sd hold what each
    sensor would measure.

    Args:
        record: the result of `run`.
        forecasts: what `forecast` returned for it.
        path: the file, ending in .csv or .parquet.
        predicted: predictions of each row of data, as in `write_estimates`; None by default.

    Raises:
        ValueError: there is no record or no forecast, the format is another one, or the folder cannot be written.
        ModuleNotFoundError: Parquet without pyarrow (extra "tables").
    """
    instance("record", record, Record, "a Record")
    if not isinstance(forecasts, Mapping) or not all(isinstance(part, Mapping) and part for part in forecasts.values()):
        raise fail("forecasts", "those of `forecast`, by node and filter", show_value(forecasts))
    if not forecasts:
        raise fail("forecasts", "one at least", "none")
    write_table(make_forecast_columns(record, forecasts, predicted), path)


def _append_rows(above: np.ndarray, below: np.ndarray | None, rows: int) -> np.ndarray:
    """Return a column with `rows` more values: those in `below`, or if it is None, NaN (floats) or False (flags)."""
    if below is None:
        below = np.full(rows, np.nan if above.dtype.kind == "f" else False)
    return np.concatenate([above, below.astype(above.dtype)])


def _make_output_columns(prefix: str, forecast: "heliograph.forecasting.Forecast", rows: int) -> dict[str, np.ndarray]:
    """Return columns of what the sensor would measure, and of its standard deviations.

    Columns that would be all NaN are left out. `prefix` begins the names. Above the forecast stand `rows` rows of data,
    which are NaN.
    """
    if forecast.outputs is None:
        return {}
    columns = {}
    for i, output in enumerate(forecast.outputs.names):
        mean_and_deviation = {output: forecast.outputs.mean[:, i], f"{output}.sd": forecast.outputs.deviation[:, i]}
        for name, values in mean_and_deviation.items():
            if not np.isnan(values).all():
                header = prefix + make_column_header(name, unit_of(output))
                columns[header] = np.concatenate([np.full(rows, np.nan), values])
    return columns
