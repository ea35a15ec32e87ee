"""Products of matrices and of polynomials whose entries lie between a lowest and a highest value."""

import jax
import numpy as np

from heliograph.numerics.numpy_or_jax import library, scatter, stack_parts
from heliograph.numerics.types import Float
from heliograph.random_affine.moments.monomials import count_monomials, product_table

CORNERS = 2048  # corner laws evaluated one by one; above, intervals are combined (sound, but looser)

Entries = Float[jax.Array | np.ndarray, "..."]
Interval = tuple[Entries, Entries]


def multiply_matrices(second: Interval, first: Interval) -> Interval:
    """Return the interval (lowest, highest) of each entry of a matrix product, from those of its factors.

    With centres C and radii R, the product has the centre C2 C1 and the radius |C2| R1 + R2 (|C1| + R1).
    """
    low1, high1 = first
    low2, high2 = second
    c2, r2 = (high2 + low2) / 2, (high2 - low2) / 2
    c1, r1 = (high1 + low1) / 2, (high1 - low1) / 2
    absolute = library(c1, c2).abs
    center = c2 @ c1
    radius = absolute(c2) @ r1 + r2 @ (absolute(c1) + r1)
    return center - radius, center + radius


def multiply_interval_polynomials(a: Entries, first: int, b: Entries, second: int, variables: int) -> Entries:
    """Return the interval product of two homogeneous polynomials of degrees `first` and `second`.

    For each pair of monomials the least and the largest product of their ends is taken. These are summed over pairs
    that give the same monomial.

    Shapes: a (ends, n), b (ends, m) with two ends, or (n,), (m,) for certain coefficients.
    """
    table = product_table(variables, first, second)
    size = (count_monomials(variables, first + second),)
    products = a.reshape(-1, 1, a.shape[-1], 1) * b.reshape(1, -1, 1, b.shape[-1])
    lowest = scatter(size, table, products.min(axis=(0, 1)))
    highest = scatter(size, table, products.max(axis=(0, 1)))
    return stack_parts([lowest, highest])
