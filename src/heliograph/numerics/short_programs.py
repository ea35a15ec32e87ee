"""Programs that are to be short rather than fast: what is the same for many points is written once, in a loop."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import jax

_short: ContextVar[bool] = ContextVar("short", default=False)


@contextmanager
def write_short_programs(short: bool = True) -> Iterator[None]:
    """Write what is traced within as short programs, if `short`."""
    token = _short.set(short)
    try:
        yield
    finally:
        _short.reset(token)


def evaluate_at_points(function: Callable[[jax.Array], jax.Array], points: jax.Array) -> jax.Array:
    """Return f of each point (points, n), as rows (points, p): side by side, or one after another in a loop."""
    values: jax.Array = jax.lax.map(function, points) if _short.get() else jax.vmap(function)(points)
    return values


def writes_short_programs() -> bool:
    """Return whether what is traced is written as short programs."""
    return _short.get()
