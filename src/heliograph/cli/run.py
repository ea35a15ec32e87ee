"""`heliograph run`: the filters of a network over measured data."""

import sys
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

import heliograph
from heliograph.cli.app_and_option_types import estimates_option, measured_option, path_option
from heliograph.cli.filter_plant import (
    FilteredPlant,
    choose_lagged_output,
    choose_output_of_plant,
    filter_plant,
    write_plant_estimates,
)
from heliograph.cli.measured_data import MeasuredPlant, ReadingOptions, read_measured_plants
from heliograph.cli.run_in_blocks import PrintedLines, WrittenRowCounts, run_in_blocks
from heliograph.files.stores.store_address import StoreAddress

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from heliograph.report.progress import Advance
    from heliograph.simulation.network import Network
    from heliograph.simulation.results.record import Record
    from heliograph.smoothing import FixedInterval, FixedLag


BAGS = {".mcap", ".db3", ".bag"}
STAGES = 4  # that the progress bar shows: starting, reading, filtering, writing


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

    A long table of rows, from 16 MiB of CSV or 262,144 rows of Parquet on, is filtered in blocks, in the memory of one.
    --report, --smooth, --forecast and --predicted need all rows at once, and so do columns of the truth.

    A file of events has the columns node, sequence, time, arrival, and the measured values: in any order, late, twice.
    A bag (.mcap, .db3, .bag, or a folder), a vehicle's log (.mf4, .blf, .asc, .ulg, .log of candump), a log or a table
    of somebody else's making, or a folder of such files, each with a clock of its own, is events too, by the `sources`
    of the network's file. The estimates are those of the events that a timeline uses, in the order of measuring; with
    --lag, those of a lag later go to a second file, OUT.lagged. Of several plants each has a file, OUT.PLANT, and a
    page of its own behind the report's overview, which has the most doubted first; in a store each has its name in the
    column `plant`, and those of a lag go to the table TABLE_lagged.

    Parameters
    ----------
    network:
        A Python file or module that holds a heliograph.Network: my_network.py, or my_network.py:name where it
        holds several. The name may be that of a function that returns one.
    """
    from heliograph.numerics.times.dates import horizons_in
    from heliograph.report.progress import progress

    # Check the options before JAX is imported.
    smoother, options = _parse_smoothing(smooth), reading or ReadingOptions()
    # The options by which more than estimates of each row is made: they need all rows at once.
    more = {"--report": report, "--smooth": smooth, "--forecast": forecast, "--predicted": predicted}
    needing_all_rows = [name for name, value in more.items() if value]
    _check_options(measurements, out, report, lag, options, needing_all_rows)
    _refuse_losing_files(network, measurements, [out], lag, report)
    horizons = horizons_in(forecast) if forecast else None
    with progress(STAGES) as advance:
        advance("starting")
        loaded, module = _load_network(network)
        _refuse_replacing_inputs(measurements, out, loaded, module.get("sources"))
        said_of_blocks: PrintedLines | None = None  # of a long table, which is not read as a whole but in blocks
        if lag is None:
            said_of_blocks = run_in_blocks(loaded, module, measurements, out, needing_all_rows, options, advance)
        measured = list[MeasuredPlant]()
        if not said_of_blocks:
            measured = read_measured_plants(measurements, network, loaded, module, options, advance, lag)
        targets = [out and choose_output_of_plant(out, data.plant, several=len(measured) > 1) for data in measured]
        _refuse_losing_files(network, measurements, targets, lag, report)
        done = list[tuple[FilteredPlant, Path | StoreAddress | None]]()
        for data, target in zip(measured, targets, strict=True):
            advance(f"filtering {len(data.recording.time)} rows")
            plant = filter_plant(loaded, data, smoother, horizons, predicted)
            if target is not None:
                advance(f"writing {target}")
                plant.said.extend(write_plant_estimates(plant, target, loaded, module, lag, options))
            done.append((plant, target))
    # Report, then warnings and a summary.
    if report is not None:
        _write_report(network, loaded, [plant for plant, _ in done], report)
    lines = [
        (plant.doubted, [*_describe_results(plant.written, target, report), *plant.said]) for plant, target in done
    ]
    for doubted, summary in lines if said_of_blocks is None else [said_of_blocks]:
        _print_lines(list(dict.fromkeys(doubted)), summary)  # each warning once


def _load_network(reference: str) -> "tuple[Network, Mapping[str, object]]":
    """Return a network and the names in its file; raise ValueError if it has no filter to run."""
    from heliograph.files.network_file import load_module
    from heliograph.numerics.check import fail

    network, module = load_module(reference)
    if not any(network.claims().values()):
        raise fail(f"network {reference}", "at least one filter to run", "none")
    return network, module


def _parse_smoothing(word: str) -> "FixedInterval | FixedLag | None":
    """Return how to smooth: with all rows ("all"), with so many later rows (a number), or None for an empty word."""
    from heliograph.numerics.check import fail
    from heliograph.smoothing import FixedInterval, FixedLag

    if word == "":
        return None
    if word == "all":
        return FixedInterval()
    if not (word.isascii() and word.isdecimal()):
        raise fail("--smooth", "all, or how many later rows", repr(word))
    return FixedLag(int(word))


def _print_lines(warnings: list[str], summary: list[str]) -> None:
    """Print warnings to the standard error, and the summary to the standard output."""

    from heliograph.disk.quoted_text import visible

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
    wanted: "Sequence[str]",
) -> None:
    """Check that the options fit together and that files can be written.

    Args:
        measurements: the file or store that is read.
        out: file or store for the estimates; None if they are not stored.
        report: folder for a report; None without one.
        lag: estimates given what came up to this much later are stored too; at most the window. None without them.
        options: how measured data are read; its window is how late a message may be.
        wanted: the options that are given of --report, --smooth, --forecast and --predicted.
    """
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
    # These add rows and columns to a table; a bag has no place for them.
    tabular = [option for option in wanted if option in ("--forecast", "--predicted")]
    if tabular and isinstance(out, Path) and out.suffix.lower() == ".mcap":
        raise fail(tabular[0], "a table of estimates (--out FILE.csv or FILE.parquet)", str(out))
    _check_packages_and_files(measurements, out, report)


def _describe_results(record: "Record", out: Path | StoreAddress | None, report: Path | None) -> list[str]:
    """Return a line on what was written to `out` and `report`, and a line on the errors of each filter, if known."""
    written = WrittenRowCounts()
    written.add(record)
    targets = [path for path in (out, report and report / "report.html") if path is not None]
    return [written.describe(*targets), *_describe_estimation_errors(record)]


def _describe_estimation_errors(record: "Record") -> list[str]:
    """Return a line on the errors of each filter, if the true states are known; else no line.

    It has the root mean square error of each state, and the normalised error squared (NEES) per state, which is 1 if
    the covariance that the filter claims is that of its errors.
    """
    from heliograph.report.diagnosis.sensor_output_health import compute_filter_errors, round_to

    lines = []
    for errors in compute_filter_errors(record):
        known = {state: rmse for state, rmse in errors.rmse.items() if not isnan(rmse)}
        rmses = [f"of {state} {round_to(rmse, errors.rmse_error[state])}" for state, rmse in known.items()]
        nees = "" if isnan(errors.nees) else f"; NEES per state {errors.nees:.3g}"
        lines.append(f"{errors.node}/{errors.filter}: RMSE {', '.join(rmses)}{nees}")
    return lines


def _check_packages_and_files(
    measurements: Path | StoreAddress, out: Path | StoreAddress | None, report: Path | None
) -> None:
    """Check before the work starts that packages for these files are installed, and that they can be written.

    Args:
        measurements: the file or store that is read; its ending decides which packages are needed.
        out: the file or store for the estimates; None if they are not stored.
        report: the folder for a report; None without a report.
    """
    from heliograph.disk.atomic_files import FORMATS, check_writable
    from heliograph.files.logs.vehicle_log import PACKAGES
    from heliograph.files.text.text_file import find_extension
    from heliograph.numerics.process.optional_packages import check_installed
    from heliograph.report.results_folder import NEEDS

    # Packages by the endings of files: of logs (PACKAGES), of ROS bags, of Parquet tables; a report needs NEEDS.
    endings = {find_extension(path) for path in (measurements, out) if isinstance(path, Path)}
    needed = [package for ending in endings & PACKAGES.keys() for package in PACKAGES[ending]]
    if endings & BAGS:
        needed.append("rosbags")
    if ".parquet" in endings:
        needed.append("pyarrow")
    check_installed([*needed, *(NEEDS if report is not None else ())])
    # What is written: a table in a store or a file, and the folder of the report.
    if isinstance(out, StoreAddress):
        from heliograph.files.stores.store_tables import check_store

        check_store(out)
    elif out is not None:
        check_writable(out, (*FORMATS, ".mcap"))
    if report is not None:
        from heliograph.disk.atomic_files import check_replaceable

        check_replaceable(report)


def _refuse_losing_files(
    network: str,
    measurements: Path | StoreAddress,
    targets: "Sequence[Path | StoreAddress | None]",
    lag: float | None,
    report: Path | None,
) -> None:
    """Raise ValueError if a file that is read or written would be overwritten.

    `targets` says where estimates go. With a `lag`, lagged estimates are written beside them. `measurements` and the
    network's file are read, `report` is a folder that is replaced.
    """
    from heliograph.disk.kept_inputs import find_network_file, refuse_replacing

    later = [choose_lagged_output(target) for target in targets if target is not None and lag is not None]
    refuse_replacing([measurements, find_network_file(network)], [*targets, *later], report)


def _refuse_replacing_inputs(
    measurements: Path | StoreAddress, out: Path | StoreAddress | None, network: "Network", sources: object
) -> None:
    """Raise ValueError if estimates would replace one of the files that are read from a folder of measurements.

    `sources`, of the network's file, say which files of the folder are read; None if it has none.
    """
    from heliograph.files.messages.folder_of_message_files import is_message_folder, list_used_files
    from heliograph.files.sources.topic_reader import TopicReader
    from heliograph.numerics.check import fail

    if (
        sources is None
        or not isinstance(out, Path)
        or not (isinstance(measurements, Path) and is_message_folder(measurements))
    ):
        return
    if out.resolve() in [file.resolve() for file in list_used_files(measurements, TopicReader(sources, network))]:
        raise fail(f"output file {out}", "another file than the measurements", "one of them")


def _write_report(name: str, network: "Network", plants: "Sequence[FilteredPlant]", report: Path) -> None:
    """Examine the records of all plants and write the report, a page for each plant and one of all.

    A record holds the measurements and estimates of a run, and a diagnosis says how plausible both are. `plants` are
    the plants with their records and forecasts, `name` is that of the network, and `report` the folder to write.

    A report of one plant is a page; of several there is an overview, and a folder for each plant.
    """
    from dataclasses import replace

    from heliograph.report.diagnosis.health import Health
    from heliograph.report.diagnosis.recording_diagnosis import examine
    from heliograph.report.results_folder import ResultsContent, write_results

    def examine_plant(plant: "FilteredPlant", advance: "Advance") -> Health:
        """Return the diagnosis of a plant's record, completed by its forecasts, predictions and refused messages.

        Residuals, what was measured less what was predicted, are part of it if predictions were asked for.
        """
        record, inputs = plant.record, plant.data.recording.inputs
        residuals = heliograph.forecasting.record_residuals(record, inputs) if plant.predicted else {}
        health = examine(network, record, inputs, advance)
        refused = {} if plant.data.events is None else plant.data.events.refusals
        return replace(
            health, forecasts=plant.forecasts, predicted=plant.predicted, residuals=residuals, refused_messages=refused
        )

    def examine_plants(advance: "Advance") -> dict[str, Health]:
        """Return the diagnosis of each plant, by name."""
        return {plant.data.plant: examine_plant(plant, advance) for plant in plants}

    def results_of(health: dict[str, Health]) -> ResultsContent:
        """Return the content of the results folder: one plant's page, or an overview and folders of several plants."""
        from heliograph.report.pages.run import make_results_of_plants, make_run_results

        if len(health) > 1:
            return make_results_of_plants(health, name)
        (of_only_plant,) = health.values()
        return make_run_results(of_only_plant, name)

    # Progress is counted in filters of plants: each is examined by itself.
    count = len(plants) * sum(map(len, network.claims().values()))
    write_results(report, count, examine_plants, results_of)
