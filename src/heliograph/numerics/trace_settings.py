"""Settings of what is traced: programs to be short rather than fast, or to be differentiated, and numbers' precision.

A trace that is kept holds for the settings it was made under (`trace_settings`).
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import jax
import numpy as np
from jax.ad_checkpoint import checkpoint_name

from heliograph.numerics.types import PyTree

KEPT = "kept"  # name of numbers that `keep_for_derivatives` marks

_short: ContextVar[bool] = ContextVar("short", default=False)
_differentiated: ContextVar[bool] = ContextVar("differentiated", default=False)
_precision: ContextVar[type[np.floating[Any]]] = ContextVar("precision", default=np.float64)


def trace_settings() -> tuple[object, ...]:
    """Return all settings now, as part of the key of a trace that is kept."""
    return _short.get(), _differentiated.get(), _precision.get()


@contextmanager
def write_short_programs(short: bool = True) -> Iterator[None]:
    """Within the block, trace functions as short programs, with loops instead of copies, if `short` is True."""
    token = _short.set(short)
    try:
        yield
    finally:
        _short.reset(token)


def evaluate_at_points(function: Callable[[jax.Array], jax.Array], points: jax.Array) -> jax.Array:
    """Return f of each point (points, n), as rows (points, p).

    Within `write_short_programs`, f is traced once and called in a loop, which is a shorter program. Otherwise all
    points are evaluated at once (`vmap`), which is faster.
    """
    values: jax.Array = jax.lax.map(function, points) if writes_short_programs() else jax.vmap(function)(points)
    return values


def writes_short_programs() -> bool:
    """Return whether what is traced is written as short programs."""
    return _short.get()


@contextmanager
def write_for_derivatives() -> Iterator[None]:
    """Within the block, trace covariances so that derivatives are right also where a variance is zero.

    The numbers themselves are the same to rounding, by more operations: it is only for what is differentiated.
    """
    token = _differentiated.set(True)
    try:
        yield
    finally:
        _differentiated.reset(token)


def writes_for_derivatives() -> bool:
    """Return whether what is traced is written so that it can be differentiated where variances are zero."""
    return _differentiated.get()


def keep_for_derivatives(numbers: PyTree) -> PyTree:
    """Return the numbers with the mark KEPT, so that a derivative backwards over rows keeps them.

    Such a derivative computes a row's other numbers again. The mark is for what most models have the same in every row,
    such as factors of noises, which is then computed once.
    """
    mark: Callable[[Any, str], Any] = checkpoint_name  # untyped in JAX
    return jax.tree.map(lambda leaf: mark(leaf, KEPT), numbers)


@contextmanager
def use_precision(precision: type[np.floating[Any]]) -> Iterator[None]:
    """Within the block, use the tolerances of this precision, whatever the precision of the traced arrays.

    C code in single precision is written from functions that are traced in double precision.
    """
    token = _precision.set(precision)
    try:
        yield
    finally:
        _precision.reset(token)


def precision_in_use() -> type[np.floating[Any]]:
    """Return the precision whose rounding tolerances count; arrays of lower precision are rounded to their own."""
    return _precision.get()
