"""A campaign on the terminal: progress with an honest estimate of the time that is left, and the table of scores."""

import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from textwrap import fill

import rich.box
import rich.console
import rich.progress
import rich.table

from heliograph.campaign.plan import Campaign
from heliograph.campaign.run import Tell
from heliograph.campaign.summary import Score

ROWS = 30  # of the printed table; the file has all
LINE_EVERY = 60.0  # seconds, where stderr is no terminal


class Countdown:
    """How long the rest will take, from the pace since every worker has done its first chunk, which it compiled for."""

    def __init__(self, workers: int, clock: Callable[[], float] = time.monotonic):
        self.workers, self.clock = workers, clock
        self.first: int | None = None  # chunks that were there before
        self.warm: tuple[int, float] | None = None
        self.last = (0, 0.0)

    def note(self, done: int) -> None:
        """Take down how many chunks are done now."""
        self.last = done, self.clock()
        if self.first is None:
            self.first = done
        if self.warm is None and done - self.first >= self.workers:
            self.warm = self.last

    def left(self, total: int) -> float | None:
        """Seconds for the rest; None until every worker could do a second chunk."""
        if self.warm is None or self.last[0] - self.warm[0] < self.workers:
            return None
        pace = (self.last[1] - self.warm[1]) / (self.last[0] - self.warm[0])
        return max(pace * (total - self.last[0]) - (self.clock() - self.last[1]), 0.0)


def spoken(seconds: float | None) -> str:
    """A time that is left, as one says it."""
    if seconds is None:
        return "time left unknown yet"
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"about {seconds / size:.0f} {unit} left"
    return f"about {seconds:.0f} s left"


@contextmanager
def showing(workers: int) -> Iterator[Tell]:
    """A progress bar on stderr; a line each minute where stderr is no terminal."""
    console = rich.console.Console(stderr=True)
    columns = (
        rich.progress.TextColumn("{task.description}"),
        rich.progress.BarColumn(),
        rich.progress.MofNCompleteColumn(),
        rich.progress.TimeElapsedColumn(),
        rich.progress.TextColumn("{task.fields[left]}"),
    )
    countdown, said = Countdown(workers), time.monotonic()
    with rich.progress.Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("starting", total=1, left="")

        def tell(what: str, done: int, total: int) -> None:
            nonlocal said
            left = ""
            if what == "simulating":
                if countdown.first is None and done:
                    print(f"{done} of {total} chunks are already there", file=sys.stderr)
                countdown.note(done)
                left = spoken(countdown.left(total))
            bar.update(task, description=what, completed=done, total=total, left=left)
            if not console.is_terminal and time.monotonic() - said >= LINE_EVERY:
                said = time.monotonic()
                print(f"{what}: {done} of {total}{left and ', '}{left}", file=sys.stderr)

        yield tell


def score_headers(campaign: Campaign) -> list[str]:
    """Headers of the table of scores."""
    return [*campaign.parameters, "node", "filter", "claim", "RMSE", "±", "NEES / dim", "±", "finite runs"]


def score_row(campaign: Campaign, score: Score) -> list[str]:
    """A row of the table of scores: values with their standard errors."""
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
            fill(header, 7), overflow="fold", justify="right" if i >= len(campaign.parameters) + 3 else "left"
        )
    for score in scores[:ROWS]:
        table.add_row(*score_row(campaign, score))
    console = rich.console.Console()
    console.print(table)
    if len(scores) > ROWS:
        console.print(f"and {len(scores) - ROWS} more rows")
