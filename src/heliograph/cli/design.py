"""`heliograph design`: optimal powers of a network and their value, as a page and a network that runs."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from heliograph.cli.app_and_option_types import choose_results_folder, path_option

if TYPE_CHECKING:
    from heliograph.files.design_file import DesignFile
    from heliograph.report.pages.design import DesignResults
    from heliograph.report.progress import Advance
    from heliograph.report.results_folder import ResultsContent

NAME = "design"


def design(
    task: Annotated[Path, path_option()],
    /,
    *,
    out: Annotated[Path, path_option("Folder for the page, its figures and the designed network; made if missing.")],
) -> None:
    """Choose the powers of a network for the least error, or the least power for a target error, and report.

    Parameters
    ----------
    task:
        A TOML file that names the network, the budget or the target error, and what is free.
    """
    from heliograph.disk.kept_inputs import refuse_replacing
    from heliograph.disk.quoted_text import visible
    from heliograph.files.design_file import read_design
    from heliograph.report.results_folder import write_results

    # Read and check everything before the computation starts.
    target = choose_results_folder("design", out, NAME) / NAME
    file = read_design(task)
    refuse_replacing([task], [], target)

    def results_of(designed: "DesignResults") -> "ResultsContent":
        """Return the content of the results folder of a design: figures, page, summary and networks."""
        from heliograph.report.pages.design import make_design_results

        return make_design_results(designed)

    designed = write_results(target, count_stages(file), lambda advance: compute_design(file, advance), results_of)
    best = designed.design
    print(visible(f"{target / 'report.html'}: error {best.error:.6g} at power {best.total:.6g}"))
    print(visible(best.certificate.words))


def count_stages(file: "DesignFile") -> int:
    """Return the approximate number of steps of `compute_design`, for its progress bar.

    They are the design, the rows of the map, the budgets of the front, and about three changes for each node. `file`:
    the design task, with its network, and map and front if these are asked for.
    """
    from heliograph.planning.design_comparisons import POINTS

    rows = 0 if file.map is None else len(file.map.y)
    return 1 + rows + len(file.front or range(POINTS)) + 3 * len(file.network.nodes)


def compute_design(file: "DesignFile", advance: "Advance") -> "DesignResults":
    """Return what a task of a design asks for, computed: the designed powers, and what surrounds them.

    That is the powers before, the least error over total powers around the design's own, what changes of the network
    are worth, and a map of the error over sites of a node if the task has one. `advance` is called with the progress.
    `file`: the task, with its network and problem.
    """
    import heliograph as hg
    from heliograph.files.design_file import make_designed_source
    from heliograph.planning.design_comparisons import list_totals_about
    from heliograph.report.pages.design import SOURCE, DesignResults

    # The design, and the powers before it.
    advance("designing")
    best = hg.design(file.problem)
    before = hg.power(file.network, best.problem.criterion.horizon).mean
    # Further results, each with its own progress.
    sites, totals = file.map, file.front or list_totals_about(best.total)
    return DesignResults(
        reference=file.reference,
        source=file.source,
        design=best,
        before={name: before.get(name, float("nan")) for name in best.powers},
        front=hg.planning.error_over_power(file.problem, totals, advance),
        changes=hg.planning.worth_of_changes(best, file.exponent, advance),
        map=None if sites is None else hg.planning.error_over_sites(best, sites.build, sites.x, sites.y, advance),
        written=make_designed_source(file, SOURCE, best.powers),
    )
