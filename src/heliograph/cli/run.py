"""`heliograph run`: the filters of a network over measured data."""

import sys
import warnings
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from urllib.parse import quote

from cyclopts import Parameter

import heliograph
from heliograph.cli.app import estimates_option, measured_option, path_option
from heliograph.cli.reading import Measured, ReadingOptions, read_measured
from heliograph.files.stores.address import StoreAddress

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import numpy as np

    from heliograph.files.estimates.forecasts import ByFilter
    from heliograph.files.recording import Recording
    from heliograph.model.estimate import Estimate
    from heliograph.report.progress import Advance
    from heliograph.simulation.network import Network
    from heliograph.simulation.results.record import Record
    from heliograph.smoothing import FixedInterval, FixedLag

    Write = Callable[[Record, Path | StoreAddress], None]
    Horizons = int | list[float | np.timedelta64 | np.datetime64]


BAGS = {".mcap", ".db3", ".bag"}


def run(
    network: str,
    /,
    *,
    measurements: Annotated[Path | StoreAddress, measured_option()],
    out: Annotated[Path | StoreAddress | None, estimates_option()] = None,
    report: Annotated[Path | None, path_option("Folder of figures, and a page on estimates and links.")] = None,
    smooth: Annotated[str, Parameter(help="Estimates given later data too: of all rows (all), or of so many.")] = "",
    lag: Annotated[float | None, Parameter(help="Of messages: also estimates given what came so much later.")] = None,
    forecast: Annotated[str, Parameter(help="How far ahead: 12 rows, or 5s,1min, or dates; marked as such.")] = "",
    predicted: Annotated[
        bool, Parameter(help="Also what was predicted of each row from those before it.", negative="")
    ] = False,
    reading: ReadingOptions | None = None,
) -> None:
    """Run the filters of your own network over measured data.

    A file of events has the columns node, sequence, time, arrival, and the measured values: in any order, late, twice.
    A bag (.mcap, .db3, .bag, or a folder), a vehicle's log (.mf4, .blf, .asc, .ulg), a log or a table of somebody
    else's making is events too, by the `sources` of the network's file. The estimates are those of the events that a
    timeline uses, in the order of measuring; with --lag, those of a lag later go to a second file, OUT.lagged. Of
    several plants each has a file, OUT.PLANT, and a page of its own behind the report's overview, which has the most
    doubted first; in a store each has its name in the column `plant`, and those of a lag go to the
    table TABLE_lagged.

    Parameters
    ----------
    network:
        A Python file or module that holds a heliograph.Network: my_network.py, or my_network.py:name where it
        holds several. The name may be that of a function that returns one.
    """
    from dataclasses import replace

    from heliograph.numerics.check import fail
    from heliograph.numerics.times.dates import horizons_in
    from heliograph.report.progress import progress

    # Check the options before JAX is imported.
    later, options = _parse_smoothing(smooth), reading or ReadingOptions()
    _check_options(measurements, out, report, lag, options)
    ahead = horizons_in(forecast) if forecast else None
    asked = [option for option, used in {"--forecast": ahead is not None, "--predicted": predicted}.items() if used]
    if asked and isinstance(out, Path) and out.suffix.lower() == ".mcap":
        raise fail(asked[0], "a table of estimates (--out FILE.csv or FILE.parquet)", str(out))
    with progress(4) as advance:
        advance("starting")
        from heliograph.files.network_file import load_module

        loaded, module = load_module(network)
        if not any(loaded.claims().values()):
            raise fail(f"network {network}", "at least one filter to run", "none")
        measured = read_measured(measurements, network, loaded, module, options, advance)
        if lag is not None and measured[0].events is None:
            raise fail("--lag", "messages or events", f"rows of time in {measurements}")
        # Each plant by itself.
        done = []
        for data in measured:
            advance(f"filtering {len(data.recording.time)} rows")
            record, doubts = _filter_rows(loaded, data.recording, later)
            if data.events is not None and data.events.dated and record.origin is not None:
                record = replace(record, units={"time": "s"} | record.units).with_origin(record.origin)
            place = out and _place(out, data.plant, len(measured) > 1)
            written = _select_rows(record, data.rows)
            lines = [*_describe_doubted(loaded, record), *data.summary]
            future = _make_forecasts(record, ahead, lines)
            each_row = heliograph.forecasting.predict_record(record, data.recording.inputs) if predicted else {}
            if place is not None:
                advance(f"writing {place}")
                write = _choose_writer(data, module)
                _write_rows(write, written, (future, _select_predicted(each_row, data.rows)), place, data)
                lines += _write_lagged(loaded, data, lag, options, place, write)
            doubted = [*data.warnings, *record.failures(), *doubts]
            done.append((data, record, written, place, doubted, lines, (future, each_row)))
    # Report, then warnings and a summary.
    if report is not None:
        plants = {data.plant: (record, data.recording, *ahead_of_each) for data, record, *_, ahead_of_each in done}
        _write_report(network, loaded, plants, report)
    for _, _, written, place, doubts, lines, _ in done:
        _print_lines(list(dict.fromkeys(doubts)), [*_describe_results(written, place, report), *lines])


def _parse_smoothing(word: str) -> "FixedInterval | FixedLag | None":
    """Read the option: "all" for the fixed interval, a number for a lag, nothing for none."""
    from heliograph.numerics.check import fail
    from heliograph.smoothing import FixedInterval, FixedLag

    if word == "":
        return None
    if word == "all":
        return FixedInterval()
    if not (word.isascii() and word.isdecimal()):
        raise fail("--smooth", "all, or how many later rows", repr(word))
    return FixedLag(int(word))


def _place(out: Path | StoreAddress, plant: str, several: bool) -> Path | StoreAddress:
    """Return where a plant's estimates go: of several, each has a file of its name."""
    if isinstance(out, StoreAddress):
        return out
    return out.with_name(f"{out.stem}.{quote(plant, safe='')}{out.suffix}") if several else out


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


def _print_lines(warnings: list[str], summary: list[str]) -> None:
    from heliograph.disk.quoting import visible

    for line in warnings:
        print(f"heliograph: warning: {visible(line)}", file=sys.stderr)
    for line in summary:
        print(visible(line))


def _check_options(
    measurements: Path | StoreAddress,
    out: Path | StoreAddress | None,
    report: Path | None,
    lag: float | None,
    options: ReadingOptions,
) -> None:
    """Check that the options fit together and files can be written."""
    from heliograph.numerics.check import fail, scalar

    if out is None and report is None:
        raise fail("run", "a file for the estimates (--out FILE) or a folder for a report (--report DIR)", "neither")
    window, _ = options.limits
    if lag is not None:
        scalar("lag", lag, 0)
        if lag > window:
            raise fail("lag", f"a number from 0 to the window, {window:g}", lag)
        if out is None:
            raise fail("--lag", "a file for the estimates (--out FILE)", "none")
    _check_places(measurements, out, report)


def _find_origin(data: "Measured") -> "np.datetime64 | None":
    """Return the date of time 0, of messages whose times are dates."""
    messages = data.events
    return None if messages is None or messages.steps or messages.numbers else messages.date


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


def _filter_rows(
    network: "Network", recording: "Recording", smooth: "FixedInterval | FixedLag | None"
) -> tuple["Record", list[str]]:
    """Filter rows; return the record, and what the filters doubted in lines."""
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always", UserWarning)
        record = heliograph.run(network, *recording, smooth=smooth)
    return record, [str(doubt.message) for doubt in doubts]


def _describe_results(record: "Record", out: Path | StoreAddress | None, report: Path | None) -> list[str]:
    """Describe what was written where in a line, and the errors of each filter."""
    filters = [
        f"{node}/{name} ({_claim(estimate)})"
        for node, estimates in record.estimates.items()
        for name, estimate in estimates.items()
    ]
    places = " and ".join(str(path) for path in (out, report and report / "report.html") if path is not None)
    return [f"{places}: {len(record.time)} rows of {', '.join(filters)}", *_describe_errors(record)]


def _describe_errors(record: "Record") -> list[str]:
    """Compare each filter with the truth, a line each: RMSE by state, and NEES, which is 1 where the claim holds."""
    from heliograph.report.outputs import compare_with_truth, round_to

    lines = []
    for errors in compare_with_truth(record):
        rmse = ", ".join(
            f"of {state} {round_to(value, errors.rmse_error[state])}" for state, value in errors.rmse.items()
        )
        size = "" if isnan(errors.nees) else f"; NEES per state {errors.nees:.3g}"
        lines.append(f"{errors.node}/{errors.filter}: RMSE {rmse}{size}")
    return lines


def _describe_doubted(network: "Network", record: "Record") -> list[str]:
    """Say of each output how many of its values the filters that weigh them doubted, and their bias, a line each."""
    from heliograph.report.outputs import weighed_outputs

    return [str(output) for output in weighed_outputs(network, record)]


def _claim(estimate: "Estimate") -> str:
    """Claim of the estimates, and of how many rows nothing is."""
    lost = int((estimate.claims == "none").sum())
    return estimate.claim if estimate.claim == "none" or not lost else f"{estimate.claim}, none of {lost} rows"


def _check_places(measurements: Path | StoreAddress, out: Path | StoreAddress | None, report: Path | None) -> None:
    """Check before the work starts that files can be read and written, and that what that takes is installed."""
    from heliograph.disk.whole_file import FORMATS, check_output
    from heliograph.files.logs.log import PACKAGES
    from heliograph.numerics.check import fail
    from heliograph.numerics.process.extras import check_installed
    from heliograph.report.results import NEEDS

    kinds = {path.suffix.lower() for path in (measurements, out) if isinstance(path, Path)}
    needs = [package for kind in kinds & PACKAGES.keys() for package in PACKAGES[kind]]
    needs += [*(["rosbags"] if kinds & BAGS else []), *(["pyarrow"] if ".parquet" in kinds else [])]
    check_installed([*needs, *(NEEDS if report is not None else ())])
    if isinstance(out, StoreAddress):
        from heliograph.files.stores.tables import check_store

        check_store(out)
    elif out is not None:
        check_output(out, (*FORMATS, ".mcap"))
        if isinstance(measurements, Path) and out.resolve() == measurements.resolve():
            raise fail(f"output file {out}", "another file than the measurements", "the same")
    if report is not None:
        from heliograph.disk.whole_file import check_replaceable
        from heliograph.report.results import SUMMARY

        check_replaceable(report, SUMMARY)


def _write_report(
    name: str, network: "Network", plants: "Mapping[str, tuple[Record, Recording, ByFilter, ByFilter]]", report: Path
) -> None:
    """Examine the records of all plants and write the report, a page for each plant and one of all."""
    from dataclasses import replace

    from heliograph.report.health import Health, examine
    from heliograph.report.results import Results, write_results

    def examined(advance: "Advance") -> dict[str, Health]:
        return {
            plant: replace(examine(network, record, recording.inputs, advance), forecasts=future, predicted=each_row)
            for plant, (record, recording, future, each_row) in plants.items()
        }

    def results_of(health: dict[str, Health]) -> Results:
        from heliograph.report.pages.run import make_results_of_plants, make_run_results

        (first, *more) = health.values()
        return make_results_of_plants(health, name) if more else make_run_results(first, name)

    count = len(plants) * sum(map(len, network.claims().values()))
    write_results(report, count, examined, results_of)
