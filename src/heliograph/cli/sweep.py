"""`heliograph sweep` and `explore`: a network in many settings, and the results as an interactive page."""

from pathlib import Path
from typing import Annotated

import rich.console
from cyclopts import Parameter

from heliograph.cli.app_and_option_types import integer_option, path_option


def sweep(
    campaign: Annotated[Path, path_option()],
    /,
    *,
    out: Annotated[Path, path_option("Folder for the results; what is already there is not computed again.")],
    workers: Annotated[int | None, integer_option("Processes here; 0: this one; by default one a CPU.")] = None,
    scheduler: Annotated[str | None, Parameter(help="Address of a Dask scheduler to work on instead.")] = None,
    setting: Annotated[int | None, integer_option("Run only this setting, here in one process.")] = None,
    chunk: Annotated[int | None, integer_option("And of it only this chunk.")] = None,
) -> int:
    """Simulate a network in many settings, into one labelled store that survives any interruption.

    Parameters
    ----------
    campaign:
        A TOML file that names the network's function, the settings, and how many runs of each.
    """
    from heliograph.campaign.sweep_command import sweep

    return sweep(campaign, out, workers, scheduler, setting, chunk)


def explore(
    results: Annotated[Path, path_option("Folder that `heliograph sweep` wrote.")],
    /,
    *,
    out: Annotated[Path, path_option("Folder for explore.html.")],
) -> None:
    """Make one page of a campaign's results, to choose axes, settings, nodes and filters in; it works offline."""
    from heliograph.campaign.explore_page import write_explore_page_file
    from heliograph.disk.atomic_files import check_folder_writable

    check_folder_writable(out)
    page = write_explore_page_file(results, out)
    rich.console.Console().print(f"Page: {page}", soft_wrap=True, highlight=False, markup=False)
