"""Double precision without flipping JAX's global switch: the scope every public computation runs in."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import fail, shown
from heliograph.numerics.compiler import quickly_compiled
from heliograph.numerics.forked import check_process
from heliograph.numerics.types import PyTree

P = ParamSpec("P")
R = TypeVar("R")


def to_numpy(tree: PyTree) -> PyTree:
    """Turn every concrete numeric JAX array of a pytree into a NumPy array; leave keys and traced values alone."""

    def convert(leaf: object) -> object:
        if isinstance(leaf, jax.core.Tracer) or not isinstance(leaf, jax.Array):
            return leaf
        return leaf if jnp.issubdtype(leaf.dtype, jax.dtypes.extended) else np.asarray(leaf)

    return jax.tree.map(convert, tree)


def in_float64(function: Callable[P, R]) -> Callable[P, R]:
    """Run a function in the float64 scope and hand NumPy arrays back.

    Inside a trace it changes nothing, so that the same object can be called by a user and by a compiled scan (which may
    have chosen single precision).
    """

    @wraps(function)
    def scoped(*args: P.args, **kwargs: P.kwargs) -> R:
        if _traced((args, kwargs)):
            return function(*args, **kwargs)
        check_process()
        with jax.enable_x64(True):
            result: R = to_numpy(function(*args, **kwargs))
        return result

    return scoped


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function once per structure and shapes of its arguments, run it in float64, hand NumPy arrays back.

    Numbers in the arguments become arrays first, so that a step counter does not compile anew at each step. Inside a
    trace it is the plain function.
    """
    jitted = quickly_compiled(function)

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if _traced((args, kwargs)):
            return function(*args, **kwargs)
        check_process()
        with jax.enable_x64(True):
            result: R = to_numpy(jitted(*jax.tree.map(_as_array, args), **jax.tree.map(_as_array, kwargs)))
        return result

    return call


def _traced(tree: PyTree) -> bool:
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def _as_array(leaf: object) -> object:
    result = np.asarray(leaf) if isinstance(leaf, int | float) else leaf
    if isinstance(result, np.ndarray) and result.dtype.kind in "OUS":
        raise fail("argument", "numbers that a double can hold", shown(leaf))
    return result
