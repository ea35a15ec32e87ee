"""Second moments of a map as tensors (m, m, p + 1, p + 1), which act on second moments of (y, 1)."""

import jax
import numpy as np

from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Float

Tensor = Float[jax.Array | np.ndarray, "m m p+1 p+1"]
Matrix = Float[jax.Array | np.ndarray, "m p"]


def symmetric_product(a: Matrix, b: Matrix) -> Tensor:
    """Return (A y)(B y)' as a tensor, made symmetric in the two factors y."""
    forward: Tensor = library(a, b).einsum("ia,jb->ijab", a, b)
    return (forward + forward.swapaxes(2, 3)) / 2


def drop_constant(tensor: Tensor) -> Tensor:
    """Return the tensor with zeros in the last row and column of its last two axes, those of the constant 1."""
    is_signal = np.arange(tensor.shape[-1]) < tensor.shape[-1] - 1
    signal_part: Tensor = library(tensor).where(is_signal[:, None] & is_signal, tensor, 0.0)
    return signal_part
