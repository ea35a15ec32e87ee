"""The command `heliograph`, and `python -m heliograph`, as a process: Ctrl-C ends it without a word from the start."""

import os

INTERRUPTED = 130

try:  # nothing is to undo while this is imported
    import atexit
    import gc
    import signal
    import sys
    from contextlib import suppress
except KeyboardInterrupt:
    os._exit(INTERRUPTED)

RARELY = 50_000, 20, 100  # what is imported and traced stays: the collector would look at it again and again


def command() -> None:
    """Run the command and end the process with its exit code.

    The process ends by `os._exit`, since the interpreter's own end would wait for threads, and free memory that threads
    of the compilers still use. So functions registered with `atexit` are called here, and output is flushed.
    """
    # While modules are imported there is nothing to undo, so a signal ends the process at once.
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda number, _: os._exit(128 + number))  # while it is imported nothing is to undo
    gc.set_threshold(*RARELY)
    from heliograph.cli import SIGNALLED, main
    from heliograph.numerics.process.interpreter_stack import reserve_stack

    try:
        code = reserve_stack(main)()
    except BaseException as error:
        code = _find_exit_code(error)
    for number in (signal.SIGINT, signal.SIGTERM):  # all is done
        signal.signal(number, signal.SIG_IGN)
    if code <= SIGNALLED:  # what was interrupted may still be used by other threads
        atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):  # it was said
            stream.flush()
    os._exit(code)


def _find_exit_code(error: BaseException) -> int:
    """Return the exit code of an exception, as the interpreter does: traces of errors are written to stderr."""
    if isinstance(error, SystemExit) and (error.code is None or isinstance(error.code, int)):
        return error.code or 0
    sys.excepthook(type(error), error, error.__traceback__)
    return 1


if __name__ == "__main__":
    command()
