"""The demonstration's command: compute, draw, write a folder that appears whole, print a table."""

import json
from dataclasses import fields
from pathlib import Path
from textwrap import fill
from typing import Any

import rich.box
import rich.console
import rich.progress
import rich.table

from heliograph.demo.compute import NAMES, SEEDS, TABLE_HEADERS, Outcome, Score, compute, table_rows
from heliograph.examples import plaza
from heliograph.examples.plaza_recording import read_recording
from heliograph.files.output_folder import check_replaceable, whole_folder
from heliograph.files.recording import write_estimates
from heliograph.files.table import write_table
from heliograph.report.progress import progress
from heliograph.simulation.record import Record

SUMMARY = "summary.json"  # also tells an earlier demonstration from other folders


def run_demo(out: Path, seed: int = 0) -> None:
    """Run the demonstration, print its table, and write estimates, figures, report and summary to `out`/demo.

    The folder appears whole or not at all, in place of an earlier demonstration's.

    Raises:
        ValueError: a folder that cannot be written, or one that holds something else.
        ModuleNotFoundError: an extra of `recordings`, `report`, `tables` is not installed.
    """
    import pyarrow  # noqa: F401  a missing extra is told before the work starts

    from heliograph.demo.page import demo_figures, demo_page
    from heliograph.report.figures import png, svg

    target = Path(out) / "demo"
    check_replaceable(target, SUMMARY)
    with progress(SEEDS + 3) as advance, whole_folder(target) as folder:
        advance("reading the recording")
        outcome = compute(read_recording(), seed, advance)
        advance("drawing")
        figures = demo_figures(outcome)
        drawings = {name: svg(figure) for name, figure in figures.items()}
        for name, figure in figures.items():
            (folder / f"{name}.png").write_bytes(png(figure))
            (folder / f"{name}.svg").write_bytes(drawings[name])
        advance("writing")
        (folder / "report.html").write_text(demo_page(outcome, drawings).html(), encoding="utf-8")
        write_data(outcome, folder)
    print_table(outcome, target)


def write_data(outcome: Outcome, folder: Path) -> None:
    """Write what arrived with the odometry, all estimates of the first seed, and the summary."""
    trial, recording = outcome.trials[0], outcome.recording
    columns = {"time": recording.time}
    columns |= dict(zip(plaza.plant.inputs, recording.odometry.T, strict=True))
    columns |= dict(zip(plaza.sensor.outputs, trial.received.T, strict=True))
    write_table(columns, folder / "measurements.csv")
    record = Record(recording.time, plaza.plant.states, None, {}, {"robot": trial.estimates})
    write_estimates(record, folder / "estimates.parquet")
    (folder / SUMMARY).write_text(json.dumps(summary(outcome), indent=2) + "\n", encoding="utf-8")


def summary(outcome: Outcome) -> dict[str, Any]:
    """The scores by quantity and filter: of the first seed at the top, of all seeds under `seeds`."""
    quantities = [field.name for field in fields(Score)]
    trials = outcome.trials
    spread = {q: {n: [getattr(t.scores[n], q) for t in trials] for n in NAMES} for q in quantities}
    top = {q: {n: values[0] for n, values in by_name.items()} for q, by_name in spread.items()}
    start = {"recording": "Plaza2", "rows": len(outcome.recording.time), "seed": trials[0].seed}
    return {**start, **top, "seeds": {"seed": [t.seed for t in trials], **spread}}


def print_table(outcome: Outcome, target: Path) -> None:
    """Print the table and where the report is."""
    seeds = f"{outcome.trials[0].seed} to {outcome.trials[-1].seed}"
    title = f"Position of the robot: relay seed {outcome.trials[0].seed}, and the range over seeds {seeds}"
    table = rich.table.Table(box=rich.box.SIMPLE_HEAD, pad_edge=False, padding=(0, 0, 0, 1), title=title)
    rows = table_rows(outcome)
    for header in TABLE_HEADERS:  # two lines each, so that the table fits 80 columns
        table.add_column(fill(header, 9), justify="right" if table.columns else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    console = rich.console.Console()
    console.print(table)
    console.print(f"Report: {target / 'report.html'}", soft_wrap=True, highlight=False)
