"""The demonstration as a folder of results, and its table on the terminal."""

from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import NamedTuple

import rich.box
import rich.console
import rich.table

from heliograph.files.recording import write_estimates
from heliograph.files.table import write_table
from heliograph.numerics.check import check_seed
from heliograph.report.progress import Advance
from heliograph.report.results import Json, Results, write_results
from heliograph.simulation.results.record import Record
from heliograph_studies.demo import robot
from heliograph_studies.demo.compute import NAMES, SEEDS, TABLE_HEADERS, Outcome, compute, table_rows
from heliograph_studies.demo.learned import learn, learned_line, learned_summary
from heliograph_studies.demo.recording import find_recording, read_recording
from heliograph_studies.demo.scores import Score
from heliograph_studies.demo.twin import Design, as_it_is, twins

NAME = "demo"
STAGES = 2 * SEEDS + 2  # of reading, computing and learning


class Evaluation(NamedTuple):
    """The filters behind the relays as they are, and behind relays that were designed."""

    outcome: Outcome
    designs: dict[str, Design]


def example(out: Path, seed: int = 0, recording: str = "plaza2") -> None:
    """Run the demonstration, print its table, and write estimates, figures, report and summary to `out`/demo.

    `recording`: the drive, "plaza1" or "plaza2".

    Raises:
        ValueError: a folder that cannot be written, or one that holds something else, no recording of this name.
        ModuleNotFoundError: an extra of `recordings`, `report`, `tables` is not installed.
    """
    check_seed(f"last of {SEEDS} seeds", check_seed("seed", seed) + SEEDS - 1)
    find_recording(recording)  # a missing extra is told before the work starts

    def work(advance: Advance) -> Evaluation:
        advance("reading the recording")
        drive = read_recording(recording)
        outcome = compute(drive, seed, advance)
        learned = learn(drive, advance)
        return Evaluation(replace(outcome, learned=learned), designs(outcome, advance))

    target = Path(out) / NAME
    print_table(write_results(target, STAGES, work, results, ("pyarrow",)).outcome, target)


def designs(outcome: Outcome, advance: Callable[[str], None] = lambda what: None) -> dict[str, Design]:
    """The relays as they are and the designed ones, over the same seeds."""
    trials = outcome.trials
    plain = as_it_is(outcome.recording, [trial.scores["relay_aware"] for trial in trials])
    return {"as_it_is": plain, **twins(outcome.recording, range(trials[0].seed, trials[-1].seed + 1), advance)}


def results(evaluation: Evaluation) -> Results:
    """Everything that the folder holds."""
    from heliograph_studies.demo.page import demo_figures, demo_page

    outcome = evaluation.outcome
    known = {**summary(outcome), "designs": {name: numbers(design) for name, design in evaluation.designs.items()}}
    return Results(demo_figures(outcome), partial(demo_page, *evaluation), known, partial(write_data, outcome))


def numbers(design: Design) -> dict[str, Json]:
    """RMSE and what is claimed (m), as means over the seeds, and the power of sensor and relay together (m^2)."""
    return {"rmse": design.rmse, "claimed": design.claimed, "power": design.power}


def write_data(outcome: Outcome, folder: Path) -> None:
    """Write what arrived with the odometry, and all estimates of the first seed."""
    trial, recording = outcome.trials[0], outcome.recording
    columns = {"time": recording.time}
    columns |= dict(zip(robot.network.inputs, recording.odometry.T, strict=True))
    columns |= dict(zip(robot.network.nodes["robot"].outputs, trial.received.T, strict=True))
    write_table(columns, folder / "measurements.csv")
    record = Record(recording.time, robot.network.states, None, {}, {"robot": trial.estimates})
    write_estimates(record, folder / "estimates.parquet")


def summary(outcome: Outcome) -> dict[str, Json]:
    """The scores by quantity and filter: of the first seed at the top, of all under `seeds`; what was `learned`."""
    quantities = [field.name for field in fields(Score)]
    trials = outcome.trials
    spread = {q: {n: [getattr(t.scores[n], q) for t in trials] for n in NAMES} for q in quantities}
    top: dict[str, Json] = {q: {n: values[0] for n, values in by_name.items()} for q, by_name in spread.items()}
    drive = outcome.recording
    start: dict[str, Json] = {"recording": drive.name.capitalize(), "rows": len(drive.time), "seed": trials[0].seed}
    learned: dict[str, Json] = {} if outcome.learned is None else {"learned": learned_summary(outcome.learned)}
    return {**start, **top, "seeds": {"seed": [t.seed for t in trials], **spread}, **learned}


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
    if outcome.learned is not None:
        console.print(learned_line(outcome.learned), highlight=False, markup=False)
    console.print(f"Report: {target / 'report.html'}", soft_wrap=True, highlight=False, markup=False)
