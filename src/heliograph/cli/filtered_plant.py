"""One plant of `heliograph run`: its rows filtered, forecast, and written."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import quote

import heliograph
from heliograph.cli.reading import Measured, ReadingOptions
from heliograph.files.stores.address import StoreAddress

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import numpy as np

    from heliograph.files.estimates.forecasts import ByFilter
    from heliograph.files.recording import Recording
    from heliograph.simulation.network import Network
    from heliograph.simulation.results.record import Record
    from heliograph.smoothing import FixedInterval, FixedLag

    Write = Callable[[Record, Path | StoreAddress], None]
    Horizons = int | list[float | np.timedelta64 | np.datetime64]


class FilteredPlant(NamedTuple):
    """What was measured of a plant, and what its filters made of it, with lines on what they doubted and forecast.

    `written` are those rows of `record` whose estimates are asked for. `forecasts` are of rows behind the last,
    `predicted` of each row from those before it; {} where not asked for.
    """

    data: Measured
    record: "Record"
    written: "Record"
    forecasts: "ByFilter"
    predicted: "ByFilter"
    doubted: list[str]
    said: list[str]


def filter_plant(
    network: "Network",
    data: Measured,
    smooth: "FixedInterval | FixedLag | None",
    ahead: "Horizons | None",
    predicts: bool,
) -> FilteredPlant:
    """Filter a plant's rows; forecast as far `ahead`, and predict each row, where that is asked for."""
    from dataclasses import replace

    record, doubts = _filter_rows(network, data.recording, smooth)
    if data.events is not None and data.events.dated and record.origin is not None:
        record = replace(record, units={"time": "s"} | record.units).with_origin(record.origin)
    said = [*_describe_doubted(network, record), *data.summary]
    forecasts = _make_forecasts(record, ahead, said)
    predicted = heliograph.forecasting.predict_record(record, data.recording.inputs) if predicts else {}
    doubted = [*data.warnings, *record.failures(), *doubts]
    return FilteredPlant(data, record, _select_rows(record, data.rows), forecasts, predicted, doubted, said)


def write_plant(
    plant: FilteredPlant,
    place: Path | StoreAddress,
    network: "Network",
    module: "Mapping[str, object]",
    lag: float | None,
    options: ReadingOptions,
) -> list[str]:
    """Write a plant's estimates, and beside them those of a lag later where there is one; return lines on these."""
    write = _choose_writer(plant.data, module)
    predicted = _select_predicted(plant.predicted, plant.data.rows)
    _write_rows(write, plant.written, (plant.forecasts, predicted), place, plant.data)
    return _write_lagged(network, plant.data, lag, options, place, write)


def place_of_plant(out: Path | StoreAddress, plant: str, several: bool) -> Path | StoreAddress:
    """Return where a plant's estimates go: of several, each has a file of its name."""
    if isinstance(out, StoreAddress):
        return out
    return out.with_name(f"{out.stem}.{quote(plant, safe='')}{out.suffix}") if several else out


def _filter_rows(
    network: "Network", recording: "Recording", smooth: "FixedInterval | FixedLag | None"
) -> tuple["Record", list[str]]:
    """Filter rows; return the record, and what the filters doubted in lines."""
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always", UserWarning)
        record = heliograph.run(network, *recording, smooth=smooth)
    return record, [str(doubt.message) for doubt in doubts]


def _describe_doubted(network: "Network", record: "Record") -> list[str]:
    """Say of each output how many of its values the filters that weigh them doubted, and their bias, a line each."""
    from heliograph.report.outputs import weighed_outputs

    return [str(output) for output in weighed_outputs(network, record)]


def _select_rows(record: "Record", rows: "np.ndarray | None") -> "Record":
    """Return some of the rows of a record, and of what is smoothed, whose rows are the last ones."""
    from dataclasses import replace

    import numpy as np

    if rows is None or rows.all():
        return record
    estimates = {
        node: {
            name: replace(
                e,
                mean=np.asarray(e.mean)[rows],
                covariance=np.asarray(e.covariance)[rows],
                modes=None if e.modes is None else np.asarray(e.modes)[rows],
            )
            for name, e in filters.items()
        }
        for node, filters in record.estimates.items()
    }
    measurements = {node: z[rows] for node, z in record.measurements.items()}
    later = None if record.smoothed is None else _select_rows(record.smoothed, rows[-len(record.smoothed.time) :])
    truth = None if record.truth is None else np.asarray(record.truth)[rows]
    return replace(
        record,
        time=record.time[rows],
        truth=truth,
        measurements=measurements,
        estimates=estimates,
        smoothed=later,
        reports={},
        uplinks={},
        weighed={},
    )


def _make_forecasts(record: "Record", ahead: "Horizons | None", lines: list[str]) -> "ByFilter":
    """Forecast each estimate from the last row, and add a line on how far and with which inputs; {} unless asked."""
    if ahead is None:
        return {}
    forecasts = heliograph.forecast(record, ahead, inputs="held")
    assert isinstance(forecasts, dict)  # of a network
    some = next(forecast for filters in forecasts.values() for forecast in filters.values())
    held = "" if some.inputs == "none" else ", inputs held at those of the last row"
    lines.append(f"forecast: {len(some.steps)} rows behind the data, to {some.time[-1]}{held}")
    return forecasts


def _select_predicted(predicted: "ByFilter", rows: "np.ndarray | None") -> "ByFilter":
    """Return what was predicted of some of the rows."""
    if rows is None or rows.all():
        return predicted
    return {
        node: {name: forecast.select(rows) for name, forecast in filters.items()} for node, filters in predicted.items()
    }


def _write_rows(
    write: "Write", record: "Record", ahead: "tuple[ByFilter, ByFilter]", place: Path | StoreAddress, data: "Measured"
) -> None:
    """Write estimates, with rows of forecasts below them and columns of what was predicted where there are any."""
    forecasts, predicted = ahead
    if not forecasts and not predicted:
        write(record, place)
        return
    from heliograph.files.estimates.forecasts import forecast_columns
    from heliograph.files.estimates.table import estimate_columns
    from heliograph.files.stores.tables import write_columns
    from heliograph.files.table import write_table

    columns = forecast_columns(record, forecasts, predicted) if forecasts else estimate_columns(record, predicted)
    if isinstance(place, Path):
        write_table(columns, place)
    else:
        write_columns(place, columns, data.plant, _find_origin(data))


def _write_lagged(
    network: "Network",
    data: "Measured",
    lag: float | None,
    options: ReadingOptions,
    place: Path | StoreAddress,
    write: "Write",
) -> list[str]:
    """Write the estimates of a lag later beside the others, and say so; nothing without a lag."""
    if lag is None or data.events is None:
        return []
    from heliograph.live.recorded import play
    from heliograph.model.plant import TIME_STEP

    window, ahead = options.limits
    start = float(data.recording.time[0]) if TIME_STEP in network.inputs else 0.0  # the initial law is of that moment
    capacity = max(1000, len(data.events))
    played = play(network, data.events.sort_events(), window, lag, start, ahead, capacity).lagged
    if played is None:
        return []
    path = (
        place.with_suffix(f".lagged{place.suffix}")
        if isinstance(place, Path)
        else place.named(f"{place.written_table}_lagged")
    )
    write(played, path)
    return [f"{path}: {len(played.time)} rows, each given what came {lag:g} later"]


def _choose_writer(data: "Measured", module: "Mapping[str, object]") -> "Write":
    """Return what writes estimates: to a store, a table, or to MCAP with the pose that the network's file names."""
    from heliograph.files.bags.output import write_bag
    from heliograph.files.estimates.table import estimate_columns, write_estimates
    from heliograph.files.stores.tables import write_columns

    origin = _find_origin(data)

    def write(record: "Record", path: Path | StoreAddress) -> None:
        if isinstance(path, StoreAddress):
            write_columns(path, estimate_columns(record), data.plant, origin)
        elif path.suffix.lower() == ".mcap":
            write_bag(record, path, origin, module.get("pose"))  # type: ignore[arg-type]  # it says what it expects
        else:
            write_estimates(record, path)

    return write


def _find_origin(data: "Measured") -> "np.datetime64 | None":
    """Return the date of time 0, of messages whose times are dates."""
    messages = data.events
    return None if messages is None or messages.steps or messages.numbers else messages.date
