"""The few types that signatures are written in; the tests check the shapes (a letter is one size within a call).

A public input that becomes an array: `covariance: ArrayLike`, checked by numerics/check and its shape in the docstring.
An array already, or returned: `def gain(p: Float[Array, "n n"], c: Float[Array, "m n"]) -> Float[Array, "n m"]`.
A state or a description made of arrays: `state: PyTree`; one number, Python's or an array's: `Scalar`.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import numpy as np
import numpy.typing
from jaxtyping import Bool, Float, Int, Key, PyTree, Shaped
from typing_extensions import TypeAliasType

Array: TypeAlias = jax.Array | np.ndarray
if TYPE_CHECKING:
    ArrayLike: TypeAlias = numpy.typing.ArrayLike
else:  # what a user gives is judged by numerics/check, in one clear line
    ArrayLike = Any
Names = TypeAliasType(
    "Names", Sequence[str] | Mapping[str, str]
)  # of states, inputs, outputs; a mapping gives each its unit
Scalar: TypeAlias = float | Float[Array, ""]

__all__ = ["Array", "ArrayLike", "Bool", "Float", "Int", "Key", "Names", "PyTree", "Scalar", "Shaped"]
