"""The example as a folder of results."""

from functools import partial
from pathlib import Path

from heliograph.examples.learning.compute import BATCH, BATCHES, Coverage, compute
from heliograph.examples.learning.setting import ROWS
from heliograph.report.results import Json, Results, write_results

NAME = "learning"
PARTS = "learning.parts"  # what is counted so far, beside the results


def example(out: Path, seed: int = 0, batches: int = BATCHES) -> None:
    """Fit recordings under each law and form, count what intervals cover, and write the table to `out`/learning.

    Each batch of recordings is kept in `out`/learning.parts: a run that was stopped goes on from there.

    Raises:
        ValueError: a folder that cannot be written, or one that holds something else.
        ModuleNotFoundError: the extra `report` is not installed.
    """
    target = Path(out) / NAME
    stages = batches * len(ROWS)
    write_results(target, stages, partial(compute, Path(out) / PARTS, seed, batches), results)
    print(f"Report: {target / 'report.html'}")


def results(coverage: dict[str, Coverage]) -> Results:
    """Everything that the folder holds."""
    from heliograph.examples.learning.page import learning_figures, learning_page

    page = partial(learning_page, coverage)
    return Results(learning_figures(coverage), page, summary(coverage), lambda folder: None)


def summary(coverage: dict[str, Coverage]) -> dict[str, Json]:
    """coverage.ROW.FORM.METHOD.PARAMETER in percent; recordings and the share left out by row and form."""
    table: dict[str, dict[str, Json]] = {}
    counted: dict[str, dict[str, Json]] = {}
    for key, one in coverage.items():
        row, form = key.split(".")
        table.setdefault(row, {})[form] = one.covered
        counted.setdefault(row, {})[form] = {"recordings": one.recordings, "left_out": one.left_out}
    return {"nominal": 95.0, "batch": BATCH, "coverage": table, "recordings": counted}
