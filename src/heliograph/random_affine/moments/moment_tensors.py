"""Second moments of a map as tensors (m, m, p + 1, p + 1), which act on second moments of (y, 1)."""

import jax
import numpy as np

from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Float

Tensor = Float[jax.Array | np.ndarray, "m m p+1 p+1"]
Matrix = Float[jax.Array | np.ndarray, "m p"]


def symmetric_product(a: Matrix, b: Matrix) -> Tensor:
    """Return T with sum_ab T[i, j, a, b] y_a y_b = (A y)_i (B y)_j, symmetric in a and b: (A_ia B_jb + A_ib B_ja) / 2.

    Shapes: a, b (m, p) -> (m, m, p, p).
    """
    forward: Tensor = library(a, b).einsum("ia,jb->ijab", a, b)
    return (forward + forward.swapaxes(2, 3)) / 2


def drop_constant(tensor: Tensor) -> Tensor:
    """Return the tensor with zeros in the last row and column of its last two axes, those of the constant 1.

    T acts on (y, 1) (y, 1)'. What is left acts on the block y y' alone.
    """
    is_signal = np.arange(tensor.shape[-1]) < tensor.shape[-1] - 1
    signal_part: Tensor = library(tensor).where(is_signal[:, None] & is_signal, tensor, 0.0)
    return signal_part
