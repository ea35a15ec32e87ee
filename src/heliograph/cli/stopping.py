"""Signals that end a command: the running code unwinds, so that no partial files are left."""

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
    """Let signals to stop unwind the running code, so that no temporary file is left; record each in `stopped`.

    An interrupt that arrives in a callback of the compiler, or in a destructor, is swallowed there: it is raised again
    by a timer.
    """

    # SIGINT raises KeyboardInterrupt, as usual, and is recorded.
    def interrupt(number: int, _: FrameType | None) -> NoReturn:
        stopped.append(number)
        raise KeyboardInterrupt

    # Interrupts that Python can only report are raised again a little later.
    def swallowed(what: "sys.UnraisableHookArgs") -> None:
        if issubclass(what.exc_type, KeyboardInterrupt):
            again.append(Timer(SOON, interrupt_main))  # not here: it would be swallowed once more
            again[-1].start()
        else:
            known(what)

    # Install the handlers, and restore the previous ones at the end.
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
