"""`heliograph run`: the filters of a network over measured data."""

import sys
import warnings
from collections.abc import Mapping
from importlib import import_module
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

import heliograph
from heliograph.cli.app import path_option

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from heliograph.files.event_table import EventTable
    from heliograph.files.recording import Recording
    from heliograph.model.estimate import Estimate
    from heliograph.report.progress import Advance
    from heliograph.simulation.network import Network
    from heliograph.simulation.results.record import Record
    from heliograph.smoothing.modes import AbstractSmoothing

    Write = Callable[[Record, Path], None]


def read_mapped(
    measurements: Path, reference: str, network: "Network", module: Mapping[str, object], advance: "Advance"
) -> "EventTable | None":
    """Read the messages of a bag, or of a CSV file of which the sources name the topics; None for any other table."""
    from heliograph.files.messages import is_mapped, read_messages
    from heliograph.numerics.check import fail

    sources = module.get("sources")
    if not is_mapped(measurements, sources):
        return None
    if sources is None:
        hint = f"heliograph inspect {measurements} --network {reference} suggests them"
        raise fail(f"network {reference}", f"sources, for the topics of {measurements} ({hint})", "none")

    def progress(done: int, total: int) -> None:
        advance(f"reading {measurements.name}", done, total)

    return read_messages(measurements, network, sources, progress)


def run(
    network: str,
    /,
    *,
    measurements: Annotated[Path, path_option("CSV or Parquet: rows or events; or a bag.")],
    out: Annotated[Path | None, path_option("CSV, Parquet or MCAP to write: estimates with their claims.")] = None,
    report: Annotated[Path | None, path_option("Folder of figures, and a page on estimates and links.")] = None,
    smooth: Annotated[str, Parameter(help="Estimates given later data too: of all rows (all), or of so many.")] = "",
    window: Annotated[float | None, Parameter(help="Of events: how long one may be late; 10 unless given.")] = None,
    lag: Annotated[float | None, Parameter(help="Of events: also estimates given what came so much later.")] = None,
) -> None:
    """Run the filters of your own network over measured data.

    A file of events has the columns node, sequence, time, arrival, and the measured values: in any order, late, twice.
    Then the estimates are those that became final; with --lag, those of a lag later go to a second file, OUT.lagged.
    A bag (.mcap, .db3, .bag, or a folder) is events too, by the `sources` of the network's file; with --smooth or
    --report it is rows in the order of measuring.

    Parameters
    ----------
    network:
        A Python file or module that holds a heliograph.Network: my_network.py, or my_network.py:name where it
        holds several. The name may be that of a function that returns one.
    """
    from heliograph.report.progress import progress
    from heliograph.smoothing.modes import named_smoothing

    # Check the options before JAX is imported.
    later = named_smoothing(smooth)
    events = _events_requested(measurements, out, report, later is not None, window is not None or lag is not None)
    with progress(4) as advance:
        advance("starting")
        from heliograph.files.events import run_events

        loaded, write, messages = _loaded(network, measurements, advance)
        # Filter: events through a timeline, rows at once.
        if out is not None and (events or (messages is not None and later is None and report is None)):
            advance("filtering events")
            waits = 10.0 if window is None else window
            record, lines = run_events(measurements, loaded, out, waits, lag, messages, write)
            doubts: list[str] = []
        else:
            recording, record, lines, doubts = _filtered(loaded, measurements, messages, later, advance)
        if out is not None:
            advance(f"writing {out}")
            write(record, out)
    # Report, then warnings and a summary.
    if report is not None:
        _write_report(network, loaded, record, recording, report)
    if messages is not None:
        lines += messages.notes
        doubts += [messages.broken] if messages.broken else []
    _print_lines(list(dict.fromkeys([*record.failures(), *doubts])), [*_written(record, out, report), *lines])


def _print_lines(warnings: list[str], summary: list[str]) -> None:
    from heliograph.disk.quoting import visible

    for line in warnings:
        print(f"heliograph: warning: {visible(line)}", file=sys.stderr)
    for line in summary:
        print(visible(line))


def _events_requested(measurements: Path, out: Path | None, report: Path | None, smooths: bool, waits: bool) -> bool:
    """Decide whether the file is read as events; check first that the options fit together and files can be written."""
    from heliograph.files.bag import is_bag
    from heliograph.files.events import holds_events
    from heliograph.numerics.check import fail

    if out is None and report is None:
        raise fail("run", "a file for the estimates (--out FILE) or a folder for a report (--report DIR)", "neither")
    events = (is_bag(measurements) and not smooths and report is None) or holds_events(measurements)
    if events and (out is None or report is not None or smooths):
        raise fail("--smooth and --report", f"rows of time, and --out FILE alone for events such as {measurements}",
                   "events")  # fmt: skip
    if not events and waits:
        raise fail("--window and --lag", "a file of events", f"rows of time in {measurements}")
    _check_places(measurements, out, report)
    return events


def _loaded(reference: str, measurements: Path, advance: "Advance") -> "tuple[Network, Write, EventTable | None]":
    """Load the network, the function that writes its estimates, and the events of the file's messages."""
    from heliograph.files.network_file import load_module
    from heliograph.numerics.check import fail

    network, module = load_module(reference)
    if not any(network.claims().values()):
        raise fail(f"network {reference}", "at least one filter to run", "none")
    messages = read_mapped(measurements, reference, network, module, advance)
    return network, _writer(messages, module), messages


def _writer(messages: "EventTable | None", module: "Mapping[str, object]") -> "Write":
    """Return the function that writes estimates: to a table, or to MCAP with the pose that the network's file names."""
    from heliograph.files.bag_output import write_bag
    from heliograph.files.recording import write_estimates

    origin = None if messages is None or messages.steps else messages.date

    def write(record: "Record", path: Path) -> None:
        if path.suffix.lower() == ".mcap":
            write_bag(record, path, origin, module.get("pose"))  # type: ignore[arg-type]  # it says what it expects
        else:
            write_estimates(record, path)

    return write


def _filtered(
    network: "Network",
    measurements: Path,
    messages: "EventTable | None",
    smooth: "AbstractSmoothing | None",
    advance: "Advance",
) -> tuple["Recording", "Record", list[str], list[str]]:
    """Filter rows; return them, the record, what the filters doubted in lines, and warnings."""
    from heliograph.files.recording import read_recording

    recording = read_recording(measurements, network) if messages is None else messages.recording()
    advance(f"filtering {len(recording.time)} rows")
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always", UserWarning)
        record = heliograph.run(network, *recording, smooth=smooth)
    return recording, record, _doubted(network, record), [str(doubt.message) for doubt in doubts]


def _written(record: "Record", out: Path | None, report: Path | None) -> list[str]:
    """Describe what was written where in a line, and the errors of each filter."""
    filters = [
        f"{node}/{name} ({_claim(estimate)})"
        for node, estimates in record.estimates.items()
        for name, estimate in estimates.items()
    ]
    places = " and ".join(str(path) for path in (out, report and report / "report.html") if path is not None)
    return [f"{places}: {len(record.time)} rows of {', '.join(filters)}", *_errors(record)]


def _errors(record: "Record") -> list[str]:
    """Compare each filter with the truth, a line each: RMSE by state, and NEES, which is 1 where the claim holds."""
    from heliograph.report.outputs import errors_of, rounded

    lines = []
    for errors in errors_of(record):
        rmse = ", ".join(
            f"of {state} {rounded(value, errors.rmse_error[state])}" for state, value in errors.rmse.items()
        )
        size = "" if isnan(errors.nees) else f"; NEES per state {errors.nees:.3g}"
        lines.append(f"{errors.node}/{errors.filter}: RMSE {rmse}{size}")
    return lines


def _doubted(network: "Network", record: "Record") -> list[str]:
    """Say of each output how many of its values the filters that weigh them doubted, and their bias, a line each."""
    from heliograph.report.outputs import weighed_outputs

    return [str(output) for output in weighed_outputs(network, record)]


def _claim(estimate: "Estimate") -> str:
    """Claim of the estimates, and of how many rows nothing is."""
    lost = int((estimate.claims == "none").sum())
    return estimate.claim if estimate.claim == "none" or not lost else f"{estimate.claim}, none of {lost} rows"


def _check_places(measurements: Path, out: Path | None, report: Path | None) -> None:
    """Check before the work starts that files can be written."""
    from heliograph.disk.whole_file import FORMATS, check_output
    from heliograph.numerics.check import fail

    if out is not None:
        check_output(out, (*FORMATS, ".mcap"))
        if out.resolve() == measurements.resolve():
            raise fail(f"output file {out}", "another file than the measurements", "the same")
    if report is not None:
        from heliograph.disk.whole_file import check_replaceable
        from heliograph.report.results import NEEDS, SUMMARY

        for name in NEEDS:
            import_module(name)
        check_replaceable(report, SUMMARY)


def _write_report(name: str, network: "Network", record: "Record", recording: "Recording", report: Path) -> None:
    from heliograph.report.health import Health, examine
    from heliograph.report.results import Results, write_results

    def results_of(health: Health) -> Results:
        from heliograph.report.run_page import run_results

        return run_results(health, name)

    count = sum(map(len, network.claims().values()))
    write_results(report, count, lambda advance: examine(network, record, recording.inputs, advance), results_of)
