"""Joint moments of a random affine map, of one order."""

from functools import cache

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from heliograph.numerics.module import Module
from heliograph.random_affine.moments.monomials import exponents


class Moments(Module):
    """Joint moments of (G, n) of one order: the matrix E[Sym^k(H)].

    It takes the monomials of (y, 1) of degree k to the conditional expectations of those of (z, 1),
    E[mono_k(z) | y] = matrix mono_k(y). A map in series is the product of the matrices.

    Shapes: matrix (C(outputs + k, k), C(inputs + k, k)).
    """

    matrix: Float[jax.Array | np.ndarray, "rows columns"]
    outputs: int = eqx.field(static=True)
    inputs: int = eqx.field(static=True)
    order: int = eqx.field(static=True)

    @property
    def mean(self) -> Float[jax.Array | np.ndarray, "outputs+1 inputs+1"]:
        """E[H] of shape (outputs + 1, inputs + 1), read off the monomials z_i 1^(k-1)."""
        return self.lower(1)

    def lower(self, order: int) -> Float[jax.Array | np.ndarray, "rows columns"]:
        """E[Sym^order(H)] of a lower order, whose monomials are among these."""
        matrix: jax.Array | np.ndarray = self.matrix[_among(self.outputs, self.inputs, self.order, order)]
        return matrix

    def expect(self, y_moments: Float[jax.Array | np.ndarray, " columns"]) -> Float[jax.Array | np.ndarray, " rows"]:
        """E[mono_k(z)] from E[mono_k(y)], for y independent of the map."""
        return self.matrix @ y_moments


@cache
def _among(outputs: int, inputs: int, high: int, low: int) -> tuple[np.ndarray, ...]:
    """Return positions of monomials of degree `low` in (z, 1) and (y, 1), times powers of 1, among degree `high`."""
    items = [
        [i for i, powers in enumerate(exponents(size + 1, high)) if powers[-1] >= high - low]
        for size in (outputs, inputs)
    ]
    return np.ix_(*items)
