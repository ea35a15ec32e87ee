"""One plant of `heliograph run`: its rows filtered and forecast, and its estimates written."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import quote

import heliograph
from heliograph.cli.measured_data import MeasuredPlant, ReadingOptions
from heliograph.files.stores.store_address import StoreAddress

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import numpy as np

    from heliograph.files.estimates.forecasts_table import ByFilter
    from heliograph.files.recordings.recording import Recording
    from heliograph.model.estimate import Estimate
    from heliograph.simulation.network import Network
    from heliograph.simulation.results.record import Record
    from heliograph.smoothing import FixedInterval, FixedLag

    Write = Callable[[Record, Path | StoreAddress], None]
    Horizons = int | list[float | np.timedelta64 | np.datetime64]


LEAST_CAPACITY = 1000  # of a replay, in rows


class FilteredPlant(NamedTuple):
    """What was measured of a plant, and what its filters made of it.

    Args:
        data: what was measured.
        record: all rows, filtered.
        written: those rows of the record in which something was measured: their estimates are written.
        forecasts: of rows after the last, by node and filter; {} where not asked for.
        predicted: of each row from those before it, likewise.
        doubted: lines on what filters doubt and what could not be read.
        said: lines for the summary.
    """

    data: MeasuredPlant
    record: "Record"
    written: "Record"
    forecasts: "ByFilter"
    predicted: "ByFilter"
    doubted: list[str]
    said: list[str]


def filter_plant(
    network: "Network",
    data: MeasuredPlant,
    smooth: "FixedInterval | FixedLag | None",
    horizons: "Horizons | None",
    predicts: bool,
) -> FilteredPlant:
    """Filter a plant's rows, and smooth them, forecast behind them and predict each of them where that is asked for.

    `data` holds the plant's measured rows and messages. `smooth`: how to smooth (whole interval, or a fixed lag), None
    for not. `horizons`: how far ahead to forecast, None for no forecasts. `predicts`: whether to predict each row from
    the rows before it. The result also has lines for the user on what was doubted and done.
    """
    record, doubts = filter_rows(network, data.recording, smooth)
    # Times of dated messages count from a date, in seconds.
    if data.events is not None and data.events.dated and record.origin is not None:
        record = record.with_units({"time": "s"} | record.units)
    said = [*_describe_doubted_values(network, record), *data.summary]
    # Forecasts after the last row.
    forecasts: ByFilter = {}
    if horizons is not None:
        forecasts = _make_forecasts(record, horizons)
        said.append(_describe_forecasts(forecasts))
    return FilteredPlant(
        data=data,
        record=record,
        written=_select_rows_of_record(record, data.rows),
        forecasts=forecasts,
        predicted=heliograph.forecasting.predict_record(record, data.recording.inputs) if predicts else {},
        doubted=[*data.warnings, *record.failures(), *doubts],
        said=said,
    )


def write_plant_estimates(
    plant: FilteredPlant,
    target: Path | StoreAddress,
    network: "Network",
    module: "Mapping[str, object]",
    lag: float | None,
    options: ReadingOptions,
) -> list[str]:
    """Write a plant's estimates, and beside them those that use what came up to `lag` later; return lines on these.

    `lag` is in the unit of time; None writes no such estimates. `target`: the file, or the table of a store. `module`:
    the names in the network's file. `options`: how the data were read.
    """
    write = _make_estimates_writer(plant.data, module)
    predicted = _select_times_of_predictions(plant.predicted, plant.data.rows)
    _write_estimates(write, plant.written, plant.forecasts, predicted, target, plant.data)
    return _write_lagged_estimates(network, plant.data, lag, options, target, write)


def choose_output_of_plant(out: Path | StoreAddress, plant: str, several: bool) -> Path | StoreAddress:
    """Return where a plant's estimates go: with several plants, a file with the plant's name; a store holds all."""
    if isinstance(out, StoreAddress) or not several:
        return out
    return out.with_name(f"{out.stem}.{quote(plant, safe='')}{out.suffix}")


def choose_lagged_output(target: Path | StoreAddress) -> Path | StoreAddress:
    """Return where lagged estimates go: a file or table of their own beside `target`."""
    if isinstance(target, Path):
        return target.with_suffix(f".lagged{target.suffix}")
    return target.with_table(f"{target.table_for_estimates}_lagged")


def filter_rows(
    network: "Network",
    recording: "Recording",
    smooth: "FixedInterval | FixedLag | None" = None,
    after: "Record | None" = None,
) -> tuple["Record", list[str]]:
    """Return the record of the filtered rows, and the warnings that were given meanwhile as lines.

    Args:
        network: the network, whose filters are run.
        recording: the rows.
        smooth: how to smooth the estimates; None for not.
        after: the record of the earlier rows of the same recording, from whose end the filters go on; None if the rows
            are the first.
    """
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always", UserWarning)
        record = heliograph.run(network, *recording, smooth=smooth, after=after)
    return record, [str(doubt.message) for doubt in doubts]


def _describe_doubted_values(network: "Network", record: "Record") -> list[str]:
    """Return a line for each output on how many of its values filters doubted, and their bias.

    Only filters that weigh values by how likely they are can doubt them.
    """
    from heliograph.report.diagnosis.sensor_output_health import summarise_weighed_outputs

    return [str(output) for output in summarise_weighed_outputs(network, record)]


def _select_rows_of_record(record: "Record", rows: "np.ndarray | None") -> "Record":
    """Return some of the rows of a record, and of its smoothed estimates, which are of its last rows.

    Args:
        record: results of filters on a recording, a row for each time. What it says of all rows together is left out:
            reports between nodes, quantizers (`uplinks`), and the weights that filters gave to innovations (`weighed`).
        rows: a mask (rows,); None for all.
    """
    from dataclasses import replace

    import numpy as np

    if rows is None or rows.all():
        return record

    def select(estimate: "Estimate") -> "Estimate":
        """Return the rows of an estimate that the mask `rows` selects, with its modes' probabilities if it has any."""
        return replace(
            estimate,
            mean=np.asarray(estimate.mean)[rows],
            covariance=np.asarray(estimate.covariance)[rows],
            modes=None if estimate.modes is None else np.asarray(estimate.modes)[rows],
        )

    # Smoothed estimates cover the last rows only: they take the end of the mask.
    smoothed = record.smoothed
    return replace(
        record,
        time=record.time[rows],
        truth=None if record.truth is None else np.asarray(record.truth)[rows],
        measurements={node: z[rows] for node, z in record.measurements.items()},
        estimates={
            node: {name: select(estimate) for name, estimate in filters.items()}
            for node, filters in record.estimates.items()
        },
        smoothed=None if smoothed is None else _select_rows_of_record(smoothed, rows[-len(smoothed.time) :]),
        reports={},
        uplinks={},
        weighed={},
    )


def _make_forecasts(record: "Record", ahead: "Horizons") -> "ByFilter":
    """Return forecasts from a record's last row by node and filter; inputs stay what they are in that row.

    `ahead` says how far: a number of rows, or a list of spans of time, dates and numbers.
    """
    forecasts = heliograph.forecast(record, ahead, inputs="held")
    assert isinstance(forecasts, dict)  # the record is of a network
    return forecasts


def _describe_forecasts(forecasts: "ByFilter") -> str:
    """Return a line for the user on how far forecasts go, and with which inputs."""
    from heliograph.numerics.times.dates import format_times

    any_forecast = next(forecast for filters in forecasts.values() for forecast in filters.values())
    held = "" if any_forecast.inputs == "none" else ", inputs held at those of the last row"
    (last,) = format_times(any_forecast.time[-1:])
    return f"forecast: {len(any_forecast.steps)} rows beyond the data, to {last}{held}"


def _select_times_of_predictions(predicted: "ByFilter", rows: "np.ndarray | None") -> "ByFilter":
    """Return the predictions, by node and filter, of the rows in the mask `rows` (rows,); None takes all rows."""
    if rows is None or rows.all():
        return predicted
    selected = {}
    for node, filters in predicted.items():
        selected[node] = {name: forecast.select(rows) for name, forecast in filters.items()}
    return selected


def _write_estimates(
    write: "Write",
    record: "Record",
    forecasts: "ByFilter",
    predicted: "ByFilter",
    target: Path | StoreAddress,
    data: "MeasuredPlant",
) -> None:
    """Write a plant's estimates, with its forecasts as rows below them and its predictions as columns beside them.

    Args:
        write: writes estimates alone, to any target.
        record: the estimates.
        forecasts: forecasts after the last row, by node and filter; {} for none.
        predicted: what was predicted of each row, by node and filter; {} for none.
        target: the file or the table of a store.
        data: the plant's data, which have its name and the date of time 0.
    """
    if not forecasts and not predicted:
        write(record, target)
        return
    from heliograph.files.estimates.estimates_table import estimate_columns
    from heliograph.files.estimates.forecasts_table import make_forecast_columns
    from heliograph.files.stores.store_tables import write_columns_to_store
    from heliograph.files.tables.table import write_table

    columns = make_forecast_columns(record, forecasts, predicted) if forecasts else estimate_columns(record, predicted)
    if isinstance(target, Path):
        write_table(columns, target)
    else:
        write_columns_to_store(target, columns, data.plant, _find_date_of_time_zero(data))


def _write_lagged_estimates(
    network: "Network",
    data: "MeasuredPlant",
    lag: float | None,
    options: ReadingOptions,
    target: Path | StoreAddress,
    write: "Write",
) -> list[str]:
    """Write the estimates of each row given all that came up to a lag after it, in a file or table of their own.

    Such estimates use messages that come late, but wait no longer than the lag. They are found by replaying the
    messages as they came. Returned is a line for the user; none without a lag, and none for rows of time, which have no
    order of arrival. `target`: where the estimates are written; `write` writes a table there. `capacity`: rows that the
    replay holds at a time. `data`: the plant's messages. `options`: how late messages may be.
    """
    if lag is None or data.events is None:
        return []
    from heliograph.live.event_replay import replay_events
    from heliograph.model.plant import TIME_STEP

    window, ahead = options.limits
    # In continuous time the initial law of the state is that of the first row's time; in steps that of step 0.
    start = float(data.recording.time[0]) if TIME_STEP in network.inputs else 0.0
    capacity = max(LEAST_CAPACITY, len(data.events))  # with less room than rows the oldest become final early
    lagged = replay_events(network, data.events.sort_events(), window, lag, start, ahead, capacity).lagged
    if lagged is None:
        return []
    lagged_target = choose_lagged_output(target)
    write(lagged, lagged_target)
    return [f"{lagged_target}: {len(lagged.time)} rows, each given what came {lag:g} later"]


def _make_estimates_writer(data: "MeasuredPlant", module: "Mapping[str, object]") -> "Write":
    """Return the function that writes a plant's estimates to a store, a table, or a bag (MCAP).

    `module` holds the names in the network's file; its `pose` says which states are the pose in a bag.
    """
    from heliograph.files.bags.estimates_writer import write_bag
    from heliograph.files.estimates.estimates_table import estimate_columns, write_estimates
    from heliograph.files.stores.store_tables import write_columns_to_store

    origin = _find_date_of_time_zero(data)

    def write(record: "Record", path: Path | StoreAddress) -> None:
        """Write the estimates of a record to a store, a bag (.mcap) or a table, as the path says.

        `data` is the plant that was filtered, and `origin` the date of its time 0. `module` holds the names in the
        network's file; its `pose` says which states are the pose in a bag.
        """
        if isinstance(path, StoreAddress):
            write_columns_to_store(path, estimate_columns(record), data.plant, origin)
        elif path.suffix.lower() == ".mcap":
            write_bag(record, path, origin, module.get("pose"))  # type: ignore[arg-type]  # it says what it expects
        else:
            write_estimates(record, path)

    return write


def _find_date_of_time_zero(data: "MeasuredPlant") -> "np.datetime64 | None":
    """Return the date that the times of a plant's messages count from; None of rows, steps, and times without dates."""
    messages = data.events
    return None if messages is None or messages.steps or messages.numbers else messages.date
