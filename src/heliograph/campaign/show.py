"""Terminal output of a campaign: progress with an estimate of the remaining time, and the table of scores."""

import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from textwrap import fill

import rich.box
import rich.console
import rich.table
from rich.text import Text

from heliograph.campaign.plan import Campaign
from heliograph.campaign.run import Progress
from heliograph.campaign.summary import Score
from heliograph.disk.quoting import visible
from heliograph.report.progress import Countdown, counting

ROWS = 30  # of the printed table; the file has all


@contextmanager
def showing(workers: int) -> Iterator[Progress]:
    """Show a progress bar on stderr; a line each minute where stderr is no terminal."""
    countdown = Countdown(workers)
    with counting(countdown) as show:

        def progress(what: str, done: int, total: int) -> None:
            if what == "simulating":
                if countdown.first is None and done:
                    print(f"{done} of {total} chunks are already there", file=sys.stderr)
                countdown.note(done)
            show(what, done, total)

        yield progress


def score_headers(campaign: Campaign) -> list[str]:
    """Return the headers of the table of scores."""
    return [*campaign.parameters, "node", "filter", "claim", "RMSE", "±", "NEES / dim", "±", "finite runs"]


def score_row(campaign: Campaign, score: Score) -> list[str]:
    """Return a row of the table of scores: values with their standard errors."""
    setting = campaign.settings[score.setting]
    return [
        *(str(setting.get(name, "")) for name in campaign.parameters),
        score.node,
        score.filter,
        score.claim,
        *(_number(score.rmse, 4), _number(score.rmse_error, 1)),
        *(_number(score.nees_per_dimension, 3), _number(score.nees_error, 1)),
        f"{score.finite_runs}/{campaign.runs}",
    ]


def _number(value: float, digits: int) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}g}"


def print_scores(campaign: Campaign, scores: Sequence[Score]) -> None:
    """Print the first rows of the table."""
    table = rich.table.Table(box=rich.box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for i, header in enumerate(score_headers(campaign)):
        table.add_column(
            Text(fill(visible(header), 7)),
            overflow="fold",
            justify="right" if i >= len(campaign.parameters) + 3 else "left",
        )
    for score in scores[:ROWS]:
        table.add_row(*(Text(visible(cell)) for cell in score_row(campaign, score)))
    console = rich.console.Console()
    console.print(table)
    if len(scores) > ROWS:
        console.print(f"and {len(scores) - ROWS} more rows")
