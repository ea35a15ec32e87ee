"""Second moments of a map as tensors (m, m, p + 1, p + 1), which act on second moments of (y, 1)."""

import jax
import numpy as np

from heliograph.numerics.traced import library
from heliograph.numerics.types import Float
from heliograph.random_affine.moments.monomials import product_table

Tensor = Float[jax.Array | np.ndarray, "m m p+1 p+1"]
Matrix = Float[jax.Array | np.ndarray, "m p"]


def second_moment_tensor(matrix: Matrix, outputs: int, inputs: int) -> Tensor:
    """E[z_i z_j | y] = sum_ab T[i, j, a, b] Y_a Y_b, symmetric in (i, j) and in (a, b), from E[Sym^2(H)]."""
    rows = product_table(outputs + 1, 1, 1)[:-1, :-1]
    columns = product_table(inputs + 1, 1, 1)
    shares = np.where(np.eye(inputs + 1, dtype=bool), 1, 2)  # a coefficient of Y_a Y_b stands at (a, b) and at (b, a)
    return matrix[rows[:, :, None, None], columns] / shares


def symmetric_product(a: Matrix, b: Matrix) -> Tensor:
    """(A y)(B y)' as a tensor, made symmetric in the two factors y."""
    forward: Tensor = library(a, b).einsum("ia,jb->ijab", a, b)
    return (forward + forward.swapaxes(2, 3)) / 2


def drop_constant(tensor: Tensor) -> Tensor:
    """The tensor without its last row and column, those of the constant 1."""
    signal = np.arange(tensor.shape[-1]) < tensor.shape[-1] - 1
    signal_part: Tensor = library(tensor).where(signal[:, None] & signal, tensor, 0.0)
    return signal_part
