"""Room on the interpreter's stack, for functions that trace others."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

ROOM = 2**16 + 1  # references: just above half a MB, so that CPython maps one, of which half is left for other frames


def reserve_stack(function: Callable[P, R]) -> Callable[P, R]:
    """Return the same function, called by a frame so large that its chunk of stack has room for all inner frames.

    CPython maps memory for its stack in chunks of 16 KB, and gives a chunk back as soon as it holds no frame. Tracing
    goes a hundred frames up and down for each operation. Across the end of a chunk, it would map memory each time,
    which takes about an eighth of the time of a first Monte Carlo simulation, depending on the caller's depth.

    Args:
        function: one that calls deeply and often.
    """

    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        """Return the result of `function`; only the size of this call's frame matters."""
        return function(*args, **kwargs)

    # The frame of `call` has room for ROOM references (half a MB), but needs almost none of it itself.
    call.__code__ = call.__code__.replace(co_stacksize=ROOM)
    return wraps(function)(call)
