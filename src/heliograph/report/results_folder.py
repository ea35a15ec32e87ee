"""Folder of results: computed with a progress bar, plotted, and written as a whole or not at all."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, TypeVar

from heliograph.disk.atomic_files import check_replaceable, whole_folder
from heliograph.numerics.process.optional_packages import check_installed
from heliograph.report.progress import Advance, progress

if TYPE_CHECKING:  # a missing extra is reported by `write_results`, in one line
    from matplotlib.figure import Figure

    from heliograph.report.pages.page import Page

SUMMARY = "summary.json"
NEEDS = ("jinja2", "matplotlib")
T = TypeVar("T")
Json: TypeAlias = "str | float | bool | Sequence[Json] | Mapping[str, Json] | None"


@dataclass(frozen=True)
class ResultsContent:
    """Results in the form in which they are written.

    Attributes:
        figures: figures by file name.
        page: function from every figure as SVG to the report.
        summary: all numbers, for JSON.
        write_data: function that writes other files into the folder.
    """

    figures: "Mapping[str, Figure]"
    page: "Callable[[Mapping[str, bytes]], Page]"
    summary: Mapping[str, Json]
    write_data: Callable[[Path], None] = lambda folder: None


def write_results(
    target: Path,
    stages: int,
    compute: Callable[[Advance], T],
    results_of: Callable[[T], ResultsContent],
    needs: Sequence[str] = (),
) -> T:
    """Compute, then write figures, report, data and summary to `target`.

    The folder replaces earlier results, and nothing else: a file that was added to them, or changed, is an error. A
    package that is missing is reported before the computation starts.

    Args:
        target: the folder of results.
        stages: number of stages of the computation, for the progress bar.
        compute: the computation, called with the callback that announces a stage.
        results_of: function from what was computed to its figures, page, summary and further files.
        needs: optional packages that are needed in addition to those for figures and pages.

    Returns:
        The value of `compute`.

    Raises:
        ValueError: a folder that cannot be written, or that holds something else.
        ModuleNotFoundError: an extra is not installed.
    """
    # Before the long computation: are the packages there (NEEDS: for figures and pages), and may the folder be
    # replaced?
    check_installed([*NEEDS, *needs])
    check_replaceable(target)
    # One stage more than the computation's: writing. `whole_folder` gives a temporary folder, which takes the place of
    # `target` at the end; after an error `target` is as before.
    with progress(stages + 1) as advance, whole_folder(target) as folder:
        outcome = compute(advance)
        advance("drawing and writing")
        write_into_folder(results_of(outcome), folder)
    return outcome


def write_into_folder(results: ResultsContent, folder: Path) -> None:
    """Write figures, report, data and summary into an existing folder.

    `results` has figures by file name, `page` (a function from all figures as SVG to the page), `write_data` (writes
    other files into the folder) and `summary`, all numbers for JSON.
    """
    # The SVG pictures come first: drawing them lays the figures out, and the PNG files use this layout.
    from heliograph.report.figures import png, svg

    pictures = {name: svg(figure) for name, figure in results.figures.items()}
    for name, figure in results.figures.items():
        figure.set_layout_engine("none")  # it is laid out already
        (folder / f"{name}.png").write_bytes(png(figure))
        (folder / f"{name}.svg").write_bytes(pictures[name])
    (folder / "report.html").write_text(results.page(pictures).html(), encoding="utf-8")
    results.write_data(folder)
    (folder / SUMMARY).write_text(json.dumps(results.summary, indent=2) + "\n", encoding="utf-8")
