"""`heliograph run`: the filters of a network over measured data."""

import sys
import warnings
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

import heliograph
from heliograph.cli.app import place

if TYPE_CHECKING:
    from heliograph.files.recording import Recording
    from heliograph.model.estimate import Estimate
    from heliograph.simulation.network import Network
    from heliograph.simulation.results.record import Record
    from heliograph.smoothing.modes import AbstractSmoothing


def run(
    network: str,
    /,
    *,
    measurements: Annotated[Path, place("CSV or Parquet: time, inputs and received measurements; or events.")],
    out: Annotated[Path | None, place("CSV or Parquet to write: estimates with their claimed covariances.")] = None,
    report: Annotated[Path | None, place("Folder for figures and a page on estimates, innovations and links.")] = None,
    smooth: Annotated[str, Parameter(help="Estimates given later data too: of all rows (all), or of so many.")] = "",
    window: Annotated[float | None, Parameter(help="Of events: how long one may be late; 10 unless given.")] = None,
    lag: Annotated[float | None, Parameter(help="Of events: also estimates given what came so much later.")] = None,
) -> None:
    """Run the filters of your own network over measured data.

    A file of events has the columns node, sequence, time, arrival, and the measured values: in any order, late, twice.
    Then the estimates are those that became final; with --lag, those of a lag later go to a second file, OUT.lagged.

    Parameters
    ----------
    network:
        A Python file or module that holds a heliograph.Network: my_network.py, or my_network.py:name where it
        holds several. The name may be that of a function that returns one.
    """
    from heliograph.disk.quoting import visible
    from heliograph.files.events import holds_events
    from heliograph.numerics.check import fail
    from heliograph.report.progress import progress
    from heliograph.smoothing.modes import named_smoothing

    # Check the options before JAX is imported.
    if out is None and report is None:
        raise fail("run", "a file for the estimates (--out FILE) or a folder for a report (--report DIR)", "neither")
    later, events = named_smoothing(smooth), holds_events(measurements)
    _check_requested(measurements, out, report, later is not None, events, window is not None or lag is not None)
    notes: list[str] = []
    doubtful: list[str] = []
    with progress(3) as advance:
        advance("starting")
        from heliograph.files.events import run_events
        from heliograph.files.network_file import load_network
        from heliograph.files.recording import read_recording, write_estimates

        # Filter: events through a timeline, rows at once.
        loaded = load_network(network)
        if not any(loaded.claims().values()):
            raise fail(f"network {network}", "at least one filter to run", "none")
        if events and out is not None:
            advance("filtering events")
            record, notes = run_events(measurements, loaded, out, 10.0 if window is None else window, lag)
        else:
            recording = read_recording(measurements, loaded)
            advance(f"filtering {len(recording.time)} rows")
            record, doubtful = _filtered(loaded, recording, later)
        if out is not None:
            advance(f"writing {out}")
            write_estimates(record, out)
    # Report, then warnings and a summary.
    if report is not None:
        _write_report(network, loaded, record, recording, report)
    for line in (*record.failures(), *doubtful):
        print(f"heliograph: warning: {visible(line)}", file=sys.stderr)
    for line in (*_written(record, out, report), *notes):
        print(visible(line))


def _check_requested(
    measurements: Path, out: Path | None, report: Path | None, smooths: bool, events: bool, waits: bool
) -> None:
    """Check before the work starts that the options fit together and that files can be written."""
    from heliograph.numerics.check import fail

    if events and (out is None or report is not None or smooths):
        raise fail("--smooth and --report", f"rows of time, and --out FILE alone for events such as {measurements}",
                   "events")  # fmt: skip
    if not events and waits:
        raise fail("--window and --lag", "a file of events", f"rows of time in {measurements}")
    _check_places(measurements, out, report)


def _filtered(
    network: "Network", recording: "Recording", smooth: "AbstractSmoothing | None"
) -> tuple["Record", list[str]]:
    """Return the record, and warnings."""
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always", UserWarning)
        record = heliograph.run(network, *recording, smooth=smooth)
    return record, [str(doubt.message) for doubt in doubts]


def _written(record: "Record", out: Path | None, report: Path | None) -> list[str]:
    """Describe what was written where, a line for each file."""
    filters = [
        f"{node}/{name} ({_claim(estimate)})"
        for node, estimates in record.estimates.items()
        for name, estimate in estimates.items()
    ]
    places = [path for path in (out, report and report / "report.html") if path is not None]
    return [f"{place}: {len(record.time)} rows of {', '.join(filters)}" for place in places]


def _claim(estimate: "Estimate") -> str:
    """Claim of the estimates, and of how many rows nothing is."""
    lost = int((estimate.claims == "none").sum())
    return estimate.claim if estimate.claim == "none" or not lost else f"{estimate.claim}, none of {lost} rows"


def _check_places(measurements: Path, out: Path | None, report: Path | None) -> None:
    """Check before the work starts that files can be written."""
    from heliograph.disk.output_file import check_output
    from heliograph.numerics.check import fail

    if out is not None:
        check_output(out)
        if out.resolve() == measurements.resolve():
            raise fail(f"output file {out}", "another file than the measurements", "the same")
    if report is not None:
        from heliograph.disk.output_file import check_replaceable
        from heliograph.report.results import NEEDS, SUMMARY

        for name in NEEDS:
            import_module(name)
        check_replaceable(report, SUMMARY)


def _write_report(name: str, network: "Network", record: "Record", recording: "Recording", report: Path) -> None:
    from heliograph.report.health import Health, examine
    from heliograph.report.results import Results, write_results

    def tell(health: Health) -> Results:
        from heliograph.report.run_page import run_results

        return run_results(health, name)

    count = sum(map(len, network.claims().values()))
    write_results(report, count, lambda advance: examine(network, record, recording.inputs, advance), tell)
