"""Signals to stop, SIGINT and SIGTERM: who handles them within a block, and blocks that they do not interrupt."""

import signal
from _thread import interrupt_main
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.machinery import ExtensionFileLoader
from threading import Timer, current_thread, main_thread
from types import FrameType

STOPPING = signal.SIGINT, signal.SIGTERM
SOON = 0.01  # seconds
IMPORTS = ExtensionFileLoader.exec_module.__code__.co_filename


@contextmanager
def handle_stop_signals(handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Call `handler` for the signals that stop a process, within a `with` block of the main thread.

    Afterwards the signals have the handlers again that they had. A signal that the process ignores stays ignored: a
    process in the background ignores SIGINT, since nobody's Ctrl-C is meant for it. While a module in C is imported
    the handler waits: such a module prints what is raised in the Python that it calls, or dies of it.
    """

    def handle_or_wait(number: int, frame: FrameType | None) -> None:
        """Pass a signal to the handler, or raise it again in SOON seconds while a C module is imported.

        An exception from the handler would leave that module half initialised.
        """
        if _is_loading_c_module(frame):
            timer = Timer(SOON, interrupt_main, (number,))
            timer.daemon = True
            timer.start()
        else:
            handler(number, frame)

    former_handlers = {number: signal.getsignal(number) for number in STOPPING}
    try:
        for number, former in former_handlers.items():
            if former is not signal.SIG_IGN:
                signal.signal(number, handle_or_wait)
        yield
    finally:
        for number, former in former_handlers.items():
            signal.signal(number, former)


def _is_loading_c_module(frame: FrameType | None) -> bool:
    """Return whether a C module is being loaded, which an exception would leave half initialised.

    One of the frames from `frame` outwards is then that of its loader, in the file IMPORTS.
    """
    while frame is not None:
        if frame.f_code.co_filename == IMPORTS and isinstance(frame.f_locals.get("self"), ExtensionFileLoader):
            return True
        frame = frame.f_back
    return False


@contextmanager
def hold_signals() -> Iterator[None]:
    """Hold signals to stop (Ctrl-C, SIGTERM) within the block; the first one is raised again at its end.

    Only the main thread is interrupted by signals. In other threads this does nothing.
    """
    noted: list[int] = []
    if current_thread() is not main_thread():
        yield
        return
    with handle_stop_signals(lambda number, _: noted.append(number)):
        yield
    if noted:
        signal.raise_signal(noted[0])
