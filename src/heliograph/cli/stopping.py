"""Signals that end a command: what it was doing unwinds, so that nothing half done stays."""

import signal
import sys
from _thread import interrupt_main
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Timer
from types import FrameType
from typing import NoReturn

INTERRUPTED, TERMINATED = 130, 143  # 128 + the signal's number

SOON = 0.01  # seconds


@contextmanager
def stoppable(stopped: list[int]) -> Iterator[None]:
    """Have the signals to stop unwind what runs, so that no temporary file stays; notes each one to interrupt.

    An interrupt that comes while a compiler calls back, or while an object is removed, is swallowed there: it is
    raised again where that is told.
    """

    def interrupt(number: int, _: FrameType | None) -> NoReturn:
        stopped.append(number)
        raise KeyboardInterrupt

    def swallowed(what: "sys.UnraisableHookArgs") -> None:
        if issubclass(what.exc_type, KeyboardInterrupt):
            again.append(Timer(SOON, interrupt_main))  # not here: it would be swallowed once more
            again[-1].start()
        else:
            known(what)

    again: list[Timer] = []
    known, terminate = sys.unraisablehook, signal.signal(signal.SIGTERM, _terminate)
    received = signal.getsignal(signal.SIGINT)
    if received is not signal.SIG_IGN:  # as in the background, where nobody's Ctrl-C is meant
        signal.signal(signal.SIGINT, interrupt)
    sys.unraisablehook = swallowed
    try:
        yield
    finally:
        for timer in again:
            timer.cancel()
        sys.unraisablehook = known
        signal.signal(signal.SIGTERM, terminate)
        signal.signal(signal.SIGINT, received)


def _terminate(_: int, __: FrameType | None) -> None:
    raise SystemExit(TERMINATED)  # unwinds, so that no temporary file stays
