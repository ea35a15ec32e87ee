"""Numbers that are known (NumPy float64) and numbers that JAX traces: arithmetic written once for both.

A model's moments are plain numbers in ordinary use, and functions of traced parameters under `jax.grad`, `jax.jvp` or
`jax.jit`. What is decided by a number's value (is it zero, is it certain) is decided for known numbers only.
"""

import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.scipy.linalg
import jax.scipy.special
import numpy as np
import scipy


def is_traced(*values: object) -> bool:
    """Return whether some number in these arrays or lists of numbers is traced."""
    return any(
        isinstance(leaf, jax.core.Tracer)
        for value in values
        if not isinstance(value, np.ndarray | float | int)  # asked of each number of a model: known at a look
        and not isinstance(value, Iterator)  # which is no tree of numbers to JAX
        for leaf in jax.tree.leaves(value)
    )


def warn_of_single(name: str, value: object) -> None:
    """Warn of an array of single precision with an entry that was rounded to it, as JAX makes 0.1 by default.

    The double that the shortest decimal of an entry means, which the user will have written, is another number then.
    """
    if isinstance(value, jax.core.Tracer) or getattr(value, "dtype", None) != np.float32:
        return
    numbers: np.ndarray = np.asarray(value)
    finite = numbers[np.isfinite(numbers)]
    meant = finite.astype(str).astype(float)
    rounded = np.flatnonzero(meant != finite)
    if len(rounded):
        example = f"{meant[rounded[0]]:g} in it is {float(finite[rounded[0]]):.10g}"
        warnings.warn(
            f"{name}: expected double precision, got a JAX array of single precision of shape {numbers.shape}, "
            f"{example}; make it with np.asarray, or after jax.config.update('jax_enable_x64', True)",
            stacklevel=2,
        )


def traced_shape(name: str, function: Callable[..., Any], *arguments: object) -> tuple[int, ...]:
    """Return the shape of a function's result, traced in double precision; warn of arrays in it that have less."""
    with jax.enable_x64(True):
        made = jax.make_jaxpr(lambda *values: jnp.asarray(function(*values)))(*arguments)
    for constant in made.consts:
        if isinstance(constant, jax.Array):
            warn_of_single(name, constant)
    shape: tuple[int, ...] = made.out_avals[0].shape
    return shape


def library(*values: object) -> Any:
    """Return numpy for known numbers, jax.numpy where one is traced."""
    return jnp if is_traced(*values) else np


def scipy_for(*values: object) -> Any:
    """Return scipy, or jax.scipy where a number is traced."""
    return jax.scipy if is_traced(*values) else scipy


def plain(value: Any) -> float | jax.Array:
    """Return a known number as a Python float, a traced one unchanged."""
    number: float | jax.Array = value if is_traced(value) else float(value)
    return number


def stacked(parts: Sequence[object]) -> jax.Array | np.ndarray:
    """Stack numbers or arrays of one shape along a new first axis."""
    array: jax.Array | np.ndarray = library(parts).stack(parts)
    return array


def is_zero(value: Any) -> bool:
    """Return whether a number is known to be zero."""
    return not is_traced(value) and not np.any(value)


def placed(size: tuple[int, ...], places: Any, values: Any) -> jax.Array | np.ndarray:
    """Return an array of zeros of shape `size` with `values` added at `places` (an index of its leading axes).

    Values at repeated places add up.
    """
    if is_traced(values):
        return jnp.zeros(size).at[places].add(values)
    table = np.zeros(size)
    np.add.at(table, places, values)
    return table
