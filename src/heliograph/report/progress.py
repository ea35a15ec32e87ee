"""Progress bars for work of known steps, and honest estimates of the time that is left."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

import rich.console
import rich.progress

LINE_EVERY = 60.0  # seconds between lines, where stderr is no terminal


class Advance(Protocol):
    """Hears what begins, or how much of what began is done."""

    def __call__(self, what: str, done: int = 0, total: int = 0) -> None:
        """`done` of `total`, where that can be said."""


@contextmanager
def _bar(*more: rich.progress.ProgressColumn) -> Iterator[rich.progress.Progress]:
    """A bar on stderr with what is being done, gone at the end; nothing where stderr is no terminal."""
    console = rich.console.Console(stderr=True)
    columns = rich.progress.TextColumn("{task.description}", markup=False), rich.progress.BarColumn(), *more
    with rich.progress.Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        yield bar


@contextmanager
def progress(stages: int) -> Iterator[Advance]:
    """A progress bar over stages of work; a new name begins the next stage, and those before it are done."""
    with _bar(rich.progress.TimeElapsedColumn()) as bar:
        task = bar.add_task("starting", total=stages)
        stage, begun = "", 0

        def advance(what: str, done: int = 0, total: int = 0) -> None:
            nonlocal stage, begun
            if what != stage:
                stage, begun = what, begun + 1
            shown = f"{what}: {done:,} of {total:,}" if total else what
            bar.update(task, description=shown, completed=begun - 1 + (done / total if total else 0))

        yield advance


class Countdown:
    """How long the rest will take, from the pace since every worker has done its first piece, which it compiled for."""

    def __init__(self, workers: int = 1, clock: Callable[[], float] = time.monotonic):
        self.workers, self.clock = workers, clock
        self.pieces = 0
        self.first: int | None = None  # what was there before
        self.warm: tuple[int, float] | None = None
        self.last = (0, 0.0)

    def note(self, done: int) -> None:
        """Take down how much is done now; called after each piece."""
        self.last = done, self.clock()
        if self.first is None:
            self.first = done
        elif done > self.first:
            self.pieces += 1
        if self.warm is None and self.pieces >= self.workers:
            self.warm = self.last

    def left(self, total: int) -> float | None:
        """Seconds for the rest; None until every worker could do a second piece."""
        if self.warm is None or self.pieces < 2 * self.workers:
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
def counting(countdown: Countdown) -> Iterator[Callable[[str, int, int], None]]:
    """A bar on stderr with the time left, or a line each minute where stderr is no terminal.

    The callable takes what is being done, how much of it is done and how much there is; the countdown hears of it from
    whoever knows what counts as a piece.
    """
    columns = (
        rich.progress.MofNCompleteColumn(),
        rich.progress.TimeElapsedColumn(),
        rich.progress.TextColumn("{task.fields[left]}"),
    )
    said = time.monotonic()
    with _bar(*columns) as bar:
        task = bar.add_task("starting", total=1, left="")

        def tell(what: str, done: int, total: int) -> None:
            nonlocal said
            left = "" if countdown.first is None else spoken(countdown.left(total))
            bar.update(task, description=what, completed=done, total=total, left=left)
            if not bar.console.is_terminal and time.monotonic() - said >= LINE_EVERY:
                said = time.monotonic()
                print(f"{what}: {done} of {total}{left and ', '}{left}", file=sys.stderr)

        yield tell


@contextmanager
def show_progress(what: str = "simulating") -> Iterator[Callable[[int, int], None]]:
    """A progress bar with the time left, for `monte_carlo(..., progress=...)`.

    The first chunk, which includes compilation, does not count for the estimate.

    Raises:
        ValueError: never; it only shows.
    """
    countdown = Countdown()
    countdown.note(0)
    with counting(countdown) as tell:

        def progressed(done: int, total: int) -> None:
            countdown.note(done)
            tell(what, done, total)

        yield progressed
