"""Arithmetic written once for known numbers (NumPy float64) and for numbers that JAX traces.

A model's moments are plain numbers in ordinary use, and functions of traced parameters under `jax.grad`, `jax.jvp` or
`jax.jit`. What is decided by a number's value (is it zero, is it certain) is decided for known numbers only.
"""

import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import jax.scipy.linalg
import jax.scipy.special
import numpy as np
import scipy
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn


def is_traced(*values: object) -> bool:
    """Return whether some number in these arrays or trees is traced: it stands, in a JAX trace, for an unknown one."""
    return any(
        isinstance(leaf, jax.core.Tracer)
        for value in values
        if not isinstance(value, np.ndarray | float | int)  # most values; this check is faster than listing leaves
        and not isinstance(value, Iterator)  # an iterator is no tree of numbers to JAX
        for leaf in jax.tree.leaves(value)
    )


DOUBLE = "with np.asarray, or after jax.config.update('jax_enable_x64', True)"
MEANT_BITS = 12  # a number of at most so many bits, such as 2^-30, was written as it is


def find_rounded_to_single(value: object) -> tuple[float, float] | None:
    """Return the first number of an array that was rounded to single precision: the number as meant, and as it is.

    It is found by its value, so that it may stand in an array of double precision now. Single precision holds it
    exactly, it has more than MEANT_BITS bits, and the shortest decimal that rounds to it in single precision, probably
    what the user wrote, is another number in double precision: 0.1 has become 0.10000000149. Numbers of fewer bits
    (0.5, 2^-30) are taken as meant. Returns None if there is none.
    """
    numbers: np.ndarray = np.asarray(value)
    if numbers.dtype.kind != "f":
        return None
    finite = numbers[np.isfinite(numbers)].astype(float)
    with np.errstate(over="ignore", under="ignore"):
        as_single = finite.astype(np.float32)
    as_written = as_single.astype(str).astype(float)  # the shortest decimal that rounds to it in single precision
    # A number has more than MEANT_BITS bits if its mantissa, times 2 to that power, is no whole number.
    mantissa, _ = np.frexp(finite)
    has_many_bits = mantissa * 2.0**MEANT_BITS != np.floor(mantissa * 2.0**MEANT_BITS)
    (indices,) = np.nonzero((as_single == finite) & (as_written != finite) & has_many_bits)
    if not len(indices):
        return None
    first = indices[0]
    return float(as_written[first]), float(finite[first])


def warn_of_single(name: str, value: object) -> None:
    """Warn, once in a process, of a single-precision array with a number that was rounded, such as JAX's 0.1.

    `name`: which array it is. DOUBLE: how to make an array of double precision.
    """
    if isinstance(value, jax.core.Tracer) or getattr(value, "dtype", None) != np.float32:
        return
    rounded = find_rounded_to_single(value)
    if rounded is not None:
        got = f"a JAX array of single precision of shape {np.asarray(value).shape}"
        _warn_once(f"{name}: expected double precision, got {got}, {describe_rounded(rounded)}; make it {DOUBLE}")


def describe_rounded(rounded: tuple[float, float]) -> str:
    """Return in words which number was meant, and which it is, from these two: "0.1 is 0.1000000015"."""
    return f"{rounded[0]:g} is {rounded[1]:.10g}"


@cache
def _warn_once(text: str) -> None:
    """Warn once in a process, at the line that called the check of a user's array."""
    warnings.warn(text, stacklevel=4)


def constants(function: Callable[..., Any], *arguments: object) -> tuple[list[Any], tuple[int, ...]]:
    """Return the arrays that a function of JAX holds as constants, and its result's shape, from a trace of it.

    The trace is in double precision; `arguments` are examples, of which shapes and types count.
    """
    with jax.enable_x64(True):
        program = jax.make_jaxpr(lambda *values: as_real(function(*values)))(*arguments)
    shape: tuple[int, ...] = program.out_avals[0].shape
    return list(program.consts), shape


def trace_shape(name: str, function: Callable[..., Any], *arguments: object) -> tuple[int, ...]:
    """Return the shape of a function's result, traced in double precision; warn of single-precision arrays in it."""
    constants_of_function, shape = constants(function, *arguments)
    for constant in constants_of_function:
        if isinstance(constant, jax.Array):
            warn_of_single(name, constant)
    return shape


def as_real(value: object) -> jax.Array:
    """Return the result of a user's function as an array of real numbers; whole numbers and flags become floats.

    Raises:
        TypeError: complex numbers.
    """
    numbers = jnp.asarray(value)
    if jnp.issubdtype(numbers.dtype, jnp.complexfloating):
        raise TypeError("complex numbers, where real ones are expected")
    return numbers if jnp.issubdtype(numbers.dtype, jnp.floating) else numbers.astype(float)


def library(*values: object) -> Any:
    """Return the module numpy for known numbers, or jax.numpy where one is traced: they have the same functions."""
    return jnp if is_traced(*values) else np


def scipy_for(*values: object) -> Any:
    """Return the module scipy for known numbers, or jax.scipy where one is traced."""
    return jax.scipy if is_traced(*values) else scipy


CALLS = frozenset((
    "jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr",
    "checkpoint", "remat", "remat2",
))  # fmt: skip


def called_program(operation: JaxprEqn) -> ClosedJaxpr | None:
    """Return the program that an operation of a traced function calls on its operands, or None if it calls none.

    CALLS: the operations that call one, such as a jitted function, or a function with its own derivative.
    """
    if operation.primitive.name not in CALLS:
        return None
    params = operation.params
    program = next(params[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in params)
    return ClosedJaxpr(program, ()) if isinstance(program, Jaxpr) else program  # a Jaxpr here has no constants


def plain(value: Any) -> float | jax.Array:
    """Return a known number as a float of Python, and one that JAX traces as it is."""
    number: float | jax.Array = value if is_traced(value) else float(value)
    return number


def stack_parts(parts: Sequence[object]) -> jax.Array | np.ndarray:
    """Stack numbers or arrays of one shape along a new first axis."""
    array: jax.Array | np.ndarray = library(parts).stack(parts)
    return array


def block_diagonal(blocks: Sequence[Any]) -> Any:
    """Return a matrix with these matrices along its diagonal and 0 elsewhere; JAX makes it if one is traced.

    SciPy's `block_diag` is not used, as it imports a whole library, which takes a sixth of a second at the start.
    """
    if is_traced(blocks):
        return jax.scipy.linalg.block_diag(*blocks)
    # The first row and column of each block, followed by the size of the whole.
    *tops, height = np.cumsum([0, *(block.shape[0] for block in blocks)])
    *lefts, width = np.cumsum([0, *(block.shape[1] for block in blocks)])
    matrix = np.zeros((height, width))
    for block, top, left in zip(blocks, tops, lefts, strict=True):
        matrix[top : top + block.shape[0], left : left + block.shape[1]] = block
    return matrix


def is_zero(value: Any) -> bool:
    """Return whether all numbers of an array are known to be zero; of traced ones nothing is known."""
    return not is_traced(value) and not np.any(value)


def scatter(size: tuple[int, ...], indices: Any, values: Any) -> jax.Array | np.ndarray:
    """Return an array of zeros of shape `size` with `values` added at `indices`, an index of its leading axes.

    Values at repeated indices are added up.
    """
    if is_traced(values):
        return jnp.zeros(size).at[indices].add(values)
    table = np.zeros(size)
    np.add.at(table, indices, values)
    return table


EQUAL = 1e-12  # relative: numbers that were computed in another order


def equal_to_rounding(a: Any, b: Any) -> bool:
    """Return whether arrays have one shape and entries equal to rounding (EQUAL); a traced one equals only itself."""
    if is_traced(a, b) or np.shape(a) != np.shape(b):
        return a is b
    x, y = np.asarray(a), np.asarray(b)
    return bool(np.all(np.abs(x - y) <= EQUAL * np.maximum(np.abs(x), np.abs(y))))


def within(own: Any, room: Any, believed: Any, radius: Any) -> bool:
    """Return whether probabilities `own`, each uncertain by +- `room`, lie within +- `radius` of those `believed`.

    It is False for traced numbers, which cannot be compared, and for arrays of different shapes.
    """
    if is_traced(own, room, believed, radius) or np.shape(own) != np.shape(believed):
        return False
    return bool(np.all(np.abs(own - believed) + room <= np.asarray(radius) + EQUAL))
