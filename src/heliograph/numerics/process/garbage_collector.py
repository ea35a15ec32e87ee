"""Python's garbage collector, off while modules are imported and functions traced, which keep nearly all they make."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def pause_collector() -> Iterator[None]:
    """Pause the collector of reference cycles within the block or the decorated function.

    It would look at all living objects again and again, which takes a third of the time of importing JAX or tracing a
    program. If threads overlap, the one that found it on switches it on again, so that it never stays off.
    """
    was_on = gc.isenabled()
    try:  # an interruption may come between any two statements
        gc.disable()
        yield
    finally:
        if was_on:
            gc.enable()
