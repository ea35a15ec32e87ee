"""The command `heliograph`, and `python -m heliograph`, as a process: Ctrl-C ends it without a word from the start."""

import gc
import os
import signal
import sys
from typing import NoReturn

RARELY = 50_000, 20, 100  # what is imported and traced stays: the collector would look at it again and again


def command() -> NoReturn:
    """Run the command and end the process with its exit code."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, lambda *_: os._exit(130))  # while it is imported there is nothing to undo
    gc.set_threshold(*RARELY)
    from heliograph.cli import INTERRUPTED, main
    from heliograph.numerics.stack import with_room

    code = with_room(main)()
    if code == INTERRUPTED:  # what other threads still compute is not waited for
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    try:
        sys.stdout.flush()
    except OSError:  # it was said; the interpreter would say it again, in its own words, when it leaves
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done: an interpreter that leaves would die of it otherwise
    gc.freeze()  # the system takes all memory at once; the collector would look for what to free first
    sys.exit(code)


if __name__ == "__main__":
    command()
