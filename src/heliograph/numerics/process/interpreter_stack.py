"""Room on the interpreter's stack, for functions that trace others."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

ROOM = 2**16 + 1  # references: just above half a MB, so that CPython maps one, of which half is left for other frames


def reserve_stack(function: Callable[P, R]) -> Callable[P, R]:
    """Return the same function, called by a frame so large that the chunk it needs has room for those within it.

    CPython maps memory for its stack in chunks of 16 KB, and gives a chunk back as soon as no frame is in it. Tracing
    goes a hundred frames up and down for each operation; where it does so across the end of a chunk, each time maps
    memory: an eighth of the time of a first Monte Carlo, more or less of it by how deep the caller stands.

    Args:
        function: one that calls deeply and often.
    """

    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        """Return the result of `function`; only the size of this call's frame matters."""
        return function(*args, **kwargs)

    # The frame of `call` is ROOM references large, half a MB, of which it needs next to nothing itself.
    call.__code__ = call.__code__.replace(co_stacksize=ROOM)
    return wraps(function)(call)
