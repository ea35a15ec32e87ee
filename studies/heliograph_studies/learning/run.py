"""The example as a folder of results."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from heliograph.report.results import Json, Results, report_results
from heliograph_studies.demo.recording import find_recording
from heliograph_studies.learning.compute import BATCH, BATCHES, Coverage, compute
from heliograph_studies.learning.plaza import PIECES, Numbers, plaza, plaza_section
from heliograph_studies.learning.setting import ROWS

if TYPE_CHECKING:
    from heliograph.report.page import Page

PARTS = "learning.parts"  # what is counted so far, beside the results


class Outcome(NamedTuple):
    """Coverage by row and form, and the numbers of the recorded drive."""

    coverage: dict[str, Coverage]
    drive: Numbers


def example(out: Path, seed: int = 0, batches: int = BATCHES) -> None:
    """Fit recordings under each law and form, count what intervals cover, and write the table to `out`/learning.

    Each batch of recordings is kept in `out`/learning.parts: a run that was stopped goes on from there.

    Raises:
        ValueError: a folder that cannot be written, or one that holds something else.
        ModuleNotFoundError: an extra of `recordings`, `report` is not installed.
    """
    find_recording()  # a missing extra is told before the work starts
    stages = batches * len(ROWS) + PIECES
    report_results(Path(out) / "learning", stages, partial(work, Path(out) / PARTS, seed, batches), results)


def work(parts: Path, seed: int, batches: int, advance: Callable[[str], None]) -> Outcome:
    """The recorded drive first, which takes two minutes, then the table."""
    drive = plaza(parts, advance)
    return Outcome(compute(parts, seed, batches, advance), drive)


def results(outcome: Outcome) -> Results:
    """Everything that the folder holds."""
    from heliograph_studies.learning.page import learning_figures, learning_page

    coverage, drive = outcome

    def page(drawings: Mapping[str, bytes]) -> "Page":
        local = learning_page(coverage, drawings)
        return replace(local, sections=[*local.sections[:-1], plaza_section(drive), local.sections[-1]])

    return Results(learning_figures(coverage), page, {**summary(coverage), "plaza": drive})


def summary(coverage: dict[str, Coverage]) -> dict[str, Json]:
    """coverage.ROW.FORM.METHOD.PARAMETER in percent; recordings and the share left out by row and form."""
    table: dict[str, dict[str, Json]] = {}
    counted: dict[str, dict[str, Json]] = {}
    for key, item in coverage.items():
        row, form = key.split(".")
        table.setdefault(row, {})[form] = item.covered
        counted.setdefault(row, {})[form] = {"recordings": item.recordings, "left_out": item.left_out}
    return {"nominal": 95.0, "batch": BATCH, "coverage": table, "recordings": counted}
