"""Matrices of a plant that depend on its inputs: a time step, a distance travelled."""

from collections.abc import Callable
from typing import NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
from typing_extensions import TypeAliasType

from heliograph.numerics.check import fail
from heliograph.numerics.module import Module
from heliograph.numerics.types import ArrayLike

MatrixFunction = TypeAliasType("MatrixFunction", Callable[[jax.Array], ArrayLike])  # a matrix of the input u


class OfInputs(Module):
    """A matrix M(u) of the plant's inputs; whatever takes it for a constant array is refused in one line.

    Args:
        function: M, written with jax.numpy.
        name: name of the matrix, for errors.
        inputs: names of the inputs.
    """

    function: MatrixFunction
    name: str = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, u: jax.Array) -> jax.Array:
        """M(u)."""
        return jnp.asarray(self.function(u))

    def _refuse(self, *_: object, **__: object) -> NoReturn:
        """Raise ValueError: here the matrix must be a constant."""
        raise fail(self.name, "a constant one, as what is computed before data needs", f"one of {list(self.inputs)}")

    __array__ = __jax_array__ = __matmul__ = __rmatmul__ = __getitem__ = __len__ = __iter__ = _refuse


def matrix_of(matrix: object, u: jax.Array) -> jax.Array:
    """Return a constant matrix, or the value of one that depends on inputs."""
    return matrix(u) if isinstance(matrix, OfInputs) else jnp.asarray(matrix)
