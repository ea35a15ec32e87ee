"""The few types that signatures are written in; the tests check the shapes (a letter is one size within a call).

A public input that becomes an array: `covariance: ArrayLike`, checked by numerics/check and its shape in the docstring.
An array already, or returned: `def gain(p: Float[Array, "n n"], c: Float[Array, "m n"]) -> Float[Array, "n m"]`.
A state or a description made of arrays: `state: PyTree`; one number, Python's or an array's: `Scalar`.
"""

from collections.abc import Iterable, Mapping, Sequence
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


class NameWithUnit(str):
    """Name of a state, output or input with its unit; equal to, and hashed as, the name alone.

    Attributes:
        unit: unit, such as "m/s".
    """

    unit: str

    def __new__(cls, name: str, unit: str) -> "NameWithUnit":
        """Return the name as a text with an attribute `unit`."""
        named = super().__new__(cls, name)
        named.unit = unit
        return named

    def __reduce__(self) -> tuple[type["NameWithUnit"], tuple[str, str]]:
        """Return the class and its arguments, by which pickle makes the name with its unit again."""
        return NameWithUnit, (str(self), self.unit)


def unit_of(name: str) -> str:
    """Return the unit that a name carries, such as "m/s", or "" if it carries none."""
    return name.unit if isinstance(name, NameWithUnit) else ""


def rename(name: str, new: str) -> str:
    """Return the name `new` with the unit of `name`, if that carries one."""
    return NameWithUnit(new, name.unit) if isinstance(name, NameWithUnit) else new


def append_unit(name: str) -> str:
    """Return a name with its unit in parentheses, if it has one, as on an axis: "position (m)"."""
    unit = unit_of(name)
    return f"{name} ({unit})" if unit else str(name)


def units_in(names: Iterable[str]) -> dict[str, str]:
    """Return the units of names that have one, by name."""
    return {str(name): unit for name in names if (unit := unit_of(name))}
