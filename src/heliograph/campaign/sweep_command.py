"""The command `sweep`: run a campaign, show how it goes, print its table and write its report."""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from textwrap import fill
from typing import Literal

import rich.box
import rich.console
import rich.table
from rich.text import Text

from heliograph.campaign.campaign_file import load_campaign
from heliograph.campaign.definition import Campaign
from heliograph.campaign.failed_jobs import FAILURES
from heliograph.campaign.run import CampaignRun, Progress, run_campaign
from heliograph.campaign.summary import SUMMARY, Score, make_score_cells, make_score_headers, read_summary
from heliograph.disk.quoted_text import visible
from heliograph.numerics.check import fail
from heliograph.report.progress import Countdown, show_countdown

FAILED = 1  # exit code: some work failed, the rest is there


def sweep(
    path: Path,
    out: Path,
    workers: int | None = None,
    scheduler: str | None = None,
    setting: int | None = None,
    chunk: int | None = None,
) -> int:
    """Run what is missing of a campaign, print its table and write its report; return the exit code.

    A campaign simulates a network in many settings, each in chunks of runs. Chunks that are stored already are not
    computed again.

    Args:
        path: path of the campaign's TOML file.
        out: the results folder.
        workers: number of worker processes; None for one a processor, or for none where a setting is named.
        scheduler: address of a Dask scheduler that is used instead; None for none.
        setting: number of the only setting to run, in this process; None for all.
        chunk: number of the only chunk of that setting; None for all.

    Returns:
        0, or FAILED if some work failed.

    Raises:
        ValueError: as `load_campaign` and `run_campaign`; a chunk without its setting.
        ModuleNotFoundError: an extra of `sweep`, `report`, `cluster` is not installed.
    """
    from heliograph.campaign.report_page import (
        write_campaign_report,  # a missing extra is reported before the work starts
    )

    campaign = load_campaign(path)
    only = _select_chunks(campaign, setting, chunk)
    if only is not None and workers is None:
        workers = 0  # so that a debugger can follow
    # Compute with a progress bar, then write the report from the new scores.
    with show_campaign_progress(workers or os.cpu_count() or 1) as progress:
        outcome = run_campaign(campaign, out, workers, scheduler, only, progress)
    # The table on the terminal, then how many chunks were done, and problems.
    scores = read_summary(out / SUMMARY)
    report = write_campaign_report(campaign, scores, out)
    print_scores(campaign, scores)
    console = rich.console.Console()
    console.print(_count_chunks(outcome), soft_wrap=True, highlight=False, markup=False)
    console.print(f"Report: {report}", soft_wrap=True, highlight=False, markup=False)
    _print_problems(outcome, out, with_traceback=only is not None)
    return FAILED if outcome.failures else 0


def _print_problems(outcome: CampaignRun, out: Path, with_traceback: bool) -> None:
    """Print damaged files, and failures with the way to repeat them, to stderr."""
    for file in outcome.damaged:
        print(f"heliograph: damaged, so it does not count as done: {file}", file=sys.stderr)
    for failure in outcome.failures:
        if with_traceback:
            print(failure.traceback, end="", file=sys.stderr)
        print(f"heliograph: failed: {visible(str(failure))}", file=sys.stderr)
    if outcome.failures:
        print(f"heliograph: {out / FAILURES} says how to run each of them again alone", file=sys.stderr)


def _select_chunks(campaign: Campaign, setting: int | None, chunk: int | None) -> list[tuple[int, int]] | None:
    """Return the pairs (setting, chunk) that --setting and --chunk ask for, or None for all."""
    if setting is None:
        if chunk is not None:
            raise fail("--chunk", "a --setting whose chunk it is", "none")
        return None
    if not 0 <= setting < len(campaign.settings):
        raise fail("--setting", f"a number from 0 to {len(campaign.settings) - 1}", setting)
    numbers = [planned_chunk.number for planned_chunk in campaign.chunks(setting)]
    if chunk is None:
        return [(setting, number) for number in numbers]
    if chunk not in numbers:
        raise fail("--chunk", f"a number from 0 to {numbers[-1]}", chunk)
    return [(setting, chunk)]


def _count_chunks(run: CampaignRun) -> str:
    """Return in words how many chunks (runs of a setting, stored together) were computed, and how many were there."""
    if not run.computed and not run.failures:
        return f"{run.folder}: nothing to compute, all {run.already} chunks are already there"
    return f"{run.folder}: {run.computed} chunks computed, {run.already} were already there"


ROWS = 30  # of the printed table; the file has all


@contextmanager
def show_campaign_progress(workers: int) -> Iterator[Progress]:
    """Show a campaign's progress as a bar on stderr, or a line each minute where stderr is no terminal.

    The context provides a function of (what is being done, how many chunks are done, how many there are).
    """
    countdown = Countdown(workers)
    with show_countdown(countdown) as show:

        def progress(what: str, done: int, total: int) -> None:
            """Show how many chunks are done; while simulating, `countdown` notes it to estimate the time left.

            The first time (`countdown.first` is None), also say how many chunks were there before.
            """
            if what == "simulating":
                if countdown.first is None and done:
                    print(f"{done} of {total} chunks are already there", file=sys.stderr)
                countdown.note(done)
            show(what, done, total)

        yield progress


def print_scores(campaign: Campaign, scores: Sequence[Score]) -> None:
    """Print the first ROWS rows of the table of scores: names to the left, numbers to the right."""
    table = rich.table.Table(box=rich.box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    first_number = len(campaign.parameters) + 3  # after the parameters, node, filter and claim
    for i, header in enumerate(make_score_headers(campaign)):
        side: Literal["left", "right"] = "right" if i >= first_number else "left"
        table.add_column(Text(fill(visible(header), 7)), overflow="fold", justify=side)
    for score in scores[:ROWS]:
        table.add_row(*(Text(visible(cell)) for cell in make_score_cells(campaign, score)))
    console = rich.console.Console()
    console.print(table)
    if len(scores) > ROWS:
        console.print(f"and {len(scores) - ROWS} more rows")
