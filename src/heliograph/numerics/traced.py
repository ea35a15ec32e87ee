"""Numbers that are known (NumPy float64) and numbers that JAX traces: arithmetic written once for both.

A model's moments are plain numbers in ordinary use, and functions of traced parameters under `jax.grad`, `jax.jvp` or
`jax.jit`. What is decided by a number's value (is it zero, is it certain) is decided for known numbers only.
"""

from collections.abc import Iterator, Sequence
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
