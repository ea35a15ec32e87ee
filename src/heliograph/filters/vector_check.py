"""A measurement or an input as a user gives it: real numbers along one axis, as many as the filter takes."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import fail, show_value
from heliograph.numerics.masked_arrays import fill_masked
from heliograph.numerics.types import Array, ArrayLike, Float


def check_vector(name: str, value: ArrayLike, length: int | None) -> Float[Array, " length"]:
    """Return real numbers along one axis as an array of floats; a scalar is accepted for a length of one.

    Args:
        name: what the numbers are, for error messages.
        value: numbers as a user gives them; masked entries are read as NaN.
        length: how many there must be; None for any number.

    Raises:
        ValueError: what is no such vector.
    """
    expected = "numbers" if length is None else f"{length} number{'s' * (length != 1)}"
    try:  # is it traced? The error of converting such a value explains its whole origin, which takes ten milliseconds
        traced = isinstance(value, jax.core.Tracer)
        numbers: Array = jnp.asarray(value, dtype=float) if traced else np.asarray(fill_masked(value))
    except jax.errors.TracerArrayConversionError:  # traced numbers in a list
        numbers = jnp.asarray(value, dtype=float)
    except (TypeError, ValueError, OverflowError):  # rows of different lengths, a set of arrays, a key
        raise fail(name, expected, show_value(value)) from None
    # Concrete values: real numbers only, in double precision.
    if isinstance(numbers, np.ndarray):
        if numbers.dtype.kind not in "fiub":
            raise fail(name, expected, show_value(value))
        numbers = numbers.astype(np.float64)
    # A scalar stands for a vector of length one.
    numbers = numbers[None] if numbers.ndim == 0 and length in (1, None) else numbers
    if numbers.ndim != 1 or length not in (len(numbers), None):
        raise fail(name, expected, f"shape {numbers.shape}" if numbers.size else "none")
    return numbers
