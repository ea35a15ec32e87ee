"""`heliograph design`: powers of a network, and what they are worth, as a page and a network that runs."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from heliograph.cli.app import folder, place

if TYPE_CHECKING:
    from heliograph.files.design_file import DesignFile
    from heliograph.report.design_page import DesignResults
    from heliograph.report.progress import Advance

NAME = "design"


def design(
    task: Annotated[Path, place()],
    /,
    *,
    out: Annotated[Path, place("Folder for the page, its figures and the designed network; made if missing.")],
) -> None:
    """Choose the powers of a network for the least error, or the least power for an error, and report.

    Parameters
    ----------
    task:
        A TOML file that names the network, the budget or the wanted error, and what is free.
    """
    from heliograph.disk.quoting import visible
    from heliograph.files.design_file import read_design
    from heliograph.report.results import Results, write_results

    target = folder("design", out, NAME) / NAME
    asked = read_design(task)

    def tell(found: "DesignResults") -> Results:
        from heliograph.report.design_page import design_results

        return design_results(found)

    found = write_results(target, stages(asked), lambda advance: work(asked, advance), tell)
    print(visible(f"{target / 'report.html'}: error {found.design.error:.6g} at power {found.design.total:.6g}"))
    print(visible(found.design.certificate.words))


def stages(asked: "DesignFile") -> int:
    """About how many steps there are to tell of."""
    from heliograph.planning.front import POINTS

    rows = 0 if asked.map is None else len(asked.map.y)
    return 1 + rows + len(asked.front or range(POINTS)) + 3 * len(asked.network.nodes)


def work(asked: "DesignFile", advance: "Advance") -> "DesignResults":
    """The design, the front about it, what more would buy, and the map."""
    from heliograph.files.design_file import designed_source
    from heliograph.planning.front import about, error_over_power
    from heliograph.planning.purchases import purchases_of
    from heliograph.planning.sent import power
    from heliograph.planning.site_map import error_over_sites
    from heliograph.report.design_page import SOURCE, DesignResults

    advance("designing")
    network, task = asked.network, asked.task
    found = task.solve(network)
    horizon = None if task.error is None else task.error.horizon
    before = power(network, horizon).mean
    places = asked.map
    return DesignResults(
        reference=asked.reference,
        source=asked.source,
        design=found,
        before={name: before.get(name, float("nan")) for name in found.powers},
        front=error_over_power(network, task, asked.front or about(found.total), advance),
        purchases=purchases_of(network, task, found, asked.exponent, advance),
        map=None if places is None else error_over_sites(places.build, task, found, places.x, places.y, advance),
        written=designed_source(asked, SOURCE, found.powers),
    )
