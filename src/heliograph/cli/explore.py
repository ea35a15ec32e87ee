"""`heliograph explore`: a campaign's results as an interactive page."""

from pathlib import Path
from typing import Annotated

import rich.console

from heliograph.cli.app import place


def explore(
    results: Annotated[Path, place("Folder that `heliograph sweep` wrote.")],
    /,
    *,
    out: Annotated[Path, place("Folder for explore.html.")],
) -> None:
    """Make one page of a campaign's results, to choose axes, settings, nodes and filters in; it works offline."""
    from heliograph.campaign.explore import explore_results
    from heliograph.disk.output_file import check_output_folder

    check_output_folder(out)
    page = explore_results(results, out)
    rich.console.Console().print(f"Page: {page}", soft_wrap=True, highlight=False, markup=False)
