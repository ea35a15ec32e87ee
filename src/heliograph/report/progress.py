"""Progress bars for work of known size, with estimates of the remaining time."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple, Protocol

import rich.console
import rich.progress

LINE_EVERY = 60.0  # seconds between lines, where stderr is no terminal


class Advance(Protocol):
    """Callback that reports which stage begins, or how much of the current one is done."""

    def __call__(self, what: str, done: int = 0, total: int = 0) -> None:
        """Report that stage `what` has begun, or that `done` of its `total` are done; total 0 means not known."""


@contextmanager
def _show_bar(*more: rich.progress.ProgressColumn) -> Iterator[rich.progress.Progress]:
    """Within the `with` block, show a bar on stderr with the stage and `more` columns; nothing without a terminal."""
    console = rich.console.Console(stderr=True)
    columns = rich.progress.TextColumn("{task.description}", markup=False), rich.progress.BarColumn(), *more
    with rich.progress.Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        yield bar


@contextmanager
def progress(stages: int) -> Iterator[Advance]:
    """Show a progress bar over stages of work; a new name begins the next stage and completes those before.

    The context provides advance(name of the stage, how much of it is done, how much there is). `stages`: how many there
    are; the bar counts a stage as one.
    """
    with _show_bar(rich.progress.TimeElapsedColumn()) as bar:
        task = bar.add_task("starting", total=stages)
        stage, begun = "", 0

        def advance(what: str, done: int = 0, total: int = 0) -> None:
            """Show on `bar` the stage `what` and how much of it is done; `begun` counts the stages that have begun."""
            nonlocal stage, begun
            if what != stage:
                stage, begun = what, begun + 1
            share = done / total if total else 0.0
            description = f"{what}: {done:,} of {total:,}" if total else what
            bar.update(task, description=description, completed=begun - 1 + share)

        yield advance


class _WorkDone(NamedTuple):
    """How much work was done at a time, in seconds of a clock."""

    done: int
    time: float


class Countdown:
    """Estimate of the remaining time, from the pace after each worker's first piece, which includes compilation.

    Args:
        workers: how many do pieces at once.
        clock: tells the time in seconds.
    """

    def __init__(self, workers: int = 1, clock: Callable[[], float] = time.monotonic):
        """Begin before any piece of work; `workers` do pieces side by side, and `clock` returns seconds."""
        self.workers, self.clock = workers, clock
        self.pieces = 0  # how many pieces were done since the first call of `note`
        self.first: int | None = None  # how much was done at the first call of `note`, such as by an earlier process
        self._newest = _WorkDone(0, 0.0)  # at the last call of `note`
        # When each worker had done its first piece: from then on the pace counts.
        self._after_first_pieces: _WorkDone | None = None

    def note(self, done: int) -> None:
        """Record how much is done now; this is called once at the beginning, and then after each piece of work."""
        self._newest = _WorkDone(done, self.clock())
        if self.first is None:
            self.first = done
        elif done > self.first:
            self.pieces += 1
        if self._after_first_pieces is None and self.pieces >= self.workers:
            self._after_first_pieces = self._newest

    def left(self, total: int) -> float | None:
        """Return the remaining seconds until `total` is done; None until every worker could do a second piece.

        The pace is that since each worker's first piece, which takes longer than others. Time that has passed since the
        last piece is subtracted.
        """
        start, newest = self._after_first_pieces, self._newest
        if start is None or self.pieces < 2 * self.workers:
            return None
        seconds_each = (newest.time - start.time) / (newest.done - start.done)
        return max(seconds_each * (total - newest.done) - (self.clock() - newest.time), 0.0)


def format_remaining(seconds: float | None) -> str:
    """Return a remaining time in words, such as "about 3 min left"; None means that it is not known yet."""
    if seconds is None:
        return "time left unknown yet"
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"about {seconds / size:.0f} {unit} left"
    return f"about {seconds:.0f} s left"


@contextmanager
def show_countdown(countdown: Countdown) -> Iterator[Callable[[str, int, int], None]]:
    """Show a bar on stderr with the time left, or print a line each minute where stderr is no terminal.

    The context provides a function show(what is being done, how much is done, how much there is). The caller also has
    to call `countdown.note`, since only it knows what a piece is.

    Args:
        countdown: knows the pace of the work.
    """
    columns = (
        rich.progress.MofNCompleteColumn(),
        rich.progress.TimeElapsedColumn(),
        rich.progress.TextColumn("{task.fields[left]}"),
    )
    last_line = time.monotonic()
    with _show_bar(*columns) as bar:
        task = bar.add_task("starting", total=1, left="")

        def show(what: str, done: int, total: int) -> None:
            """Update the bar; without a terminal, print a line every LINE_EVERY (60) seconds."""
            nonlocal last_line
            left = "" if countdown.first is None else format_remaining(countdown.left(total))
            bar.update(task, description=what, completed=done, total=total, left=left)
            if not bar.console.is_terminal and time.monotonic() - last_line >= LINE_EVERY:
                last_line = time.monotonic()
                print(f"{what}: {done} of {total}{left and ', '}{left}", file=sys.stderr)

        yield show


@contextmanager
def show_progress(what: str = "simulating") -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar with the time left, for `monte_carlo(..., progress=...)`.

    `countdown.note` records how much is done, from which the pace follows; `show` draws the bar.
    """
    countdown = Countdown()
    countdown.note(0)
    with show_countdown(countdown) as show:

        def progressed(done: int, total: int) -> None:
            """Show how much is done of how much, and the time left."""
            countdown.note(done)
            show(what, done, total)

        yield progressed
