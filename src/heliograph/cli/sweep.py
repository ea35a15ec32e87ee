"""`heliograph sweep`: a network in many settings."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from heliograph.cli.app import number, place


def sweep(
    campaign: Annotated[Path, place()],
    /,
    *,
    out: Annotated[Path, place("Folder for the results; what is already there is not computed again.")],
    workers: Annotated[int | None, number("Processes here; 0: this one; by default one a CPU.")] = None,
    scheduler: Annotated[str | None, Parameter(help="Address of a Dask scheduler to work on instead.")] = None,
    setting: Annotated[int | None, number("Run only this setting, here in one process.")] = None,
    chunk: Annotated[int | None, number("And of it only this chunk.")] = None,
) -> int:
    """Simulate a network in many settings, into one labelled store that survives any interruption.

    Parameters
    ----------
    campaign:
        A TOML file that names the network's function, the settings, and how many runs of each.
    """
    from heliograph.campaign.command import sweep

    return sweep(campaign, out, workers, scheduler, setting, chunk)
