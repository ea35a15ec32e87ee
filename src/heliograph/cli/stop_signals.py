"""Signals that end a command: the running code unwinds, so that no partial files are left."""

import signal
import sys
from _thread import interrupt_main
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Timer
from types import FrameType, TracebackType
from typing import NoReturn, TypeVar

from heliograph.numerics.process.stop_signals import STOPPING, handle_stop_signals

SIGNALLED = 128  # plus the signal's number: the exit code of what a signal ended
INTERRUPTED, TERMINATED = SIGNALLED + signal.SIGINT, SIGNALLED + signal.SIGTERM

T = TypeVar("T")
SOON = 0.01  # seconds


@contextmanager
def unwind_on_signals(stopped: list[int]) -> Iterator[None]:
    """Let SIGINT and SIGTERM unwind the running code, so that no temporary file is left; record each in `stopped`.

    A signal raises KeyboardInterrupt. If it comes while a callback of the compiler or a destructor runs, Python only
    reports the exception (`sys.unraisablehook`) and goes on. Such an interrupt is raised again by a timer.

    Args:
        stopped: list to which the number of each signal is appended.
    """

    def interrupt(number: int, _: FrameType | None) -> NoReturn:
        """Record a signal, and raise what `except Exception` does not catch."""
        stopped.append(number)
        raise KeyboardInterrupt

    def interrupt_later(what: "sys.UnraisableHookArgs") -> None:
        """Raise an interrupt again SOON seconds later if Python could not raise it; report other errors as before.

        `timers` holds the timers that were begun. They are cancelled at the end.
        """
        if issubclass(what.exc_type, KeyboardInterrupt):
            timer = Timer(SOON, interrupt_main)  # raised at once, it would be swallowed again
            timer.daemon = True
            timers.append(timer)
            timer.start()
        else:
            report_before(what)

    timers: list[Timer] = []
    report_before, sys.unraisablehook = sys.unraisablehook, interrupt_later
    try:
        with handle_stop_signals(interrupt):
            yield
    finally:
        for timer in timers:
            timer.cancel()
        sys.unraisablehook = report_before


class GentleStop:
    """A stop that keeps what there is: after `note_next_signal_only` the first signal is noted, the second unwinds.

    The exit code is that of the first: a second may be the interrupt that `unwind_on_signals` raises again where the
    first was swallowed. As a context it gives the signals back at its end.
    """

    def __init__(self) -> None:
        """Begin before any signal; the handlers of signals are not replaced yet."""
        self._number = 0  # of the first signal; 0 for none
        self._handlers: dict[int, object] = {}  # of each signal before `note_next_signal_only`, to be put back

    def __enter__(self) -> "GentleStop":
        """Return this object; signals have their handlers until `note_next_signal_only`."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Give the signals back the handlers that they had."""
        self._restore_handlers()

    @property
    def requested(self) -> bool:
        """Return whether a signal to stop (Ctrl-C, SIGTERM) came since `note_next_signal_only`, or during work."""
        return bool(self._number)

    @property
    def code(self) -> int:
        """Return the command's exit code: 0, or the one that says which signal stopped it."""
        return SIGNALLED + self._number if self._number else 0

    def note_next_signal_only(self) -> None:
        """From now on only note the next signal of STOPPING, and do not raise; ignored signals stay ignored.

        Nothing changes if a signal came already (`self._number`), or after an earlier call. `self._handlers` keeps the
        earlier handlers.

        It serves a search that has a best result so far: the next signal is to end it gently, which the search asks for
        (`requested`), and not to raise in the middle of a step.
        """
        if not self._handlers and not self._number:
            self._handlers = {number: signal.getsignal(number) for number in STOPPING}
            for number, handler in self._handlers.items():
                if handler is not signal.SIG_IGN:
                    signal.signal(number, self._note_signal)

    def raise_if_requested(self) -> None:
        """Raise KeyboardInterrupt if a signal to stop was noted: work that may stop here does."""
        if self._number:
            raise KeyboardInterrupt

    def run_unless_stopped(self, work: Callable[[], T]) -> T | None:
        """Return the value of work that may be left out, or None if a signal (`self._number`) came before its end.

        During the work a signal raises KeyboardInterrupt. If no signal was noted, the interrupt is not ours.
        """
        if self._number:
            return None
        try:
            with handle_stop_signals(self._raise_on_signal):
                return work()
        except KeyboardInterrupt:
            if not self._number:
                raise
        self._restore_handlers()
        return None

    def _raise_on_signal(self, number: int, _: FrameType | None) -> NoReturn:
        """Handle a signal during `run_unless_stopped`: note its number, and end the work by KeyboardInterrupt.

        `run_unless_stopped` catches it, and returns None in place of the work's result; the first signal's number gives
        the exit code of the command.
        """
        self._number = self._number or number
        raise KeyboardInterrupt

    def _note_signal(self, number: int, _: FrameType | None) -> None:
        """Handle a signal after `note_next_signal_only`: note it and go on; the next one has its usual effect."""
        self._number = self._number or number
        self._restore_handlers()

    def _restore_handlers(self) -> None:
        """Restore the signals' handlers (`self._handlers`) from before `note_next_signal_only`."""
        for number, handler in self._handlers.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        self._handlers = {}
