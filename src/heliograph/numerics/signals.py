"""Signals to stop, SIGINT and SIGTERM: who handles them within a block, and blocks that they do not interrupt."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import current_thread, main_thread
from types import FrameType

STOPPING = signal.SIGINT, signal.SIGTERM


@contextmanager
def handlers(handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Within a block of the main thread, handle the signals to stop so, but for those that the process ignores.

    A process in the background ignores SIGINT: nobody's Ctrl-C is meant for it.
    """
    before = {number: signal.getsignal(number) for number in STOPPING}
    try:
        for number, known in before.items():
            if known is not signal.SIG_IGN:
                signal.signal(number, handler)
        yield
    finally:
        for number, known in before.items():
            signal.signal(number, known)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Let no signal to stop part what the block does: the first one that comes is raised again at its end.

    Only the main thread is interrupted by signals; in others this does nothing.
    """
    noted: list[int] = []
    if current_thread() is not main_thread():
        yield
        return
    with handlers(lambda number, _: noted.append(number)):
        yield
    if noted:
        signal.raise_signal(noted[0])
