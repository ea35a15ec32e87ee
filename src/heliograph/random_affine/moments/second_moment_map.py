"""Maps from second moments to matrices that dominate what a channel makes of them, and their sums and sizes."""

from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.linalg import contract
from heliograph.numerics.module import Module
from heliograph.numerics.numpy_or_jax import is_traced, library
from heliograph.random_affine.moments.moment_tensors import Matrix, Tensor, drop_constant


class QuadraticMap(Module):
    """A map from second moments W of (y, 1) to a matrix that dominates T_v(W) for every possible law v.

    Value: C:W + diag_i(sum_j R_ij:|W| d_i / d_j). The second term is zero where one law dominates all others; otherwise
    T_v(W) - C:W has entries within R:|W|, and a matrix with these row sums on the diagonal dominates it (Gershgorin,
    in units d of each component's own, d_i^2 = |C_ii:W| + R_ii:|W|).

    Shapes: center, radius (m, m, p + 1, p + 1).
    """

    center: Tensor
    radius: Tensor

    def __call__(self, second_moment: jax.Array, present: jax.Array) -> jax.Array:
        """Return a matrix above the second moment of z under every possible law, at W = E (y, 1)(y, 1)'.

        The entries of the second moment are within radius : |W| of center : W. By Gershgorin's theorem a diagonal of
        the row sums of radius : |W| is above any such difference. Rows are scaled by a unit for each component. Rows
        and columns of components that are not `present` are zero.
        """
        both_present = present[:, None] & present[None, :]
        center = self.evaluate_center(second_moment, present)
        radius = jnp.where(both_present, contract(self.radius, jnp.abs(second_moment)), 0.0)
        largest_variance = jnp.abs(jnp.diagonal(center)) + jnp.diagonal(radius)
        unit = jnp.sqrt(_one_unless_positive(largest_variance))
        return center + jnp.diag(unit * jnp.sum(radius / unit, axis=1))

    def evaluate_center(self, second_moment: jax.Array, present: jax.Array) -> jax.Array:
        """Return C:W, C the `center` and W the second moment of (y, 1); rows of components not `present` are zero.

        This is the second moment of z itself where the law is known, since the radius is then zero.
        """
        return jnp.where(present[:, None] & present[None, :], contract(self.center, second_moment), 0.0)


def _one_unless_positive(value: jax.Array) -> jax.Array:
    """Return positive numbers as they are and 1 in place of others, for use as a divisor."""
    return jnp.where(value > 0, value, 1.0)


def map_of_known_law(tensor: Tensor) -> QuadraticMap:
    """Return the map W -> T:W, (T:W)_ij = sum_ab T[i, j, a, b] W_ab, of one known law: its radius is zero."""
    return QuadraticMap(tensor, np.zeros(tensor.shape))


def signal_of_map(bound: QuadraticMap) -> QuadraticMap:
    """Return the map from W = E[(y, 1) (y, 1)'] that uses only the block E[y y'] of W: the rest is multiplied by 0."""
    return QuadraticMap(drop_constant(bound.center), drop_constant(bound.radius))


def size_of_map(moment_map: QuadraticMap) -> Any:
    """Return the size of a bound, one number: sqrt(sum_ia (C + R)[i, i, a, a]), with C its `center` and R its `radius`.

    This is the root of the trace of the bound at W = I. By it bounds of several maps are weighed when they are added.
    Any positive weights give a valid bound, so that JAX takes it as constant.
    """
    largest = stop_gradient(moment_map.center + moment_map.radius)
    return library(largest).sqrt(library(largest).einsum("iiaa->", largest))


def add_maps(*maps: QuadraticMap) -> QuadraticMap:
    """Return sum_i Q_i of bounds Q_i (`QuadraticMap`): centers and radii add up."""
    return reduce(lambda a, b: QuadraticMap(a.center + b.center, a.radius + b.radius), maps)


def scale_map(moment_map: QuadraticMap, factor: Any) -> QuadraticMap:
    """Return the bound Q (`QuadraticMap`) times a number of at least 0: center and radius are multiplied."""
    return QuadraticMap(factor * moment_map.center, factor * moment_map.radius)


def place_on_diagonal(block: QuadraticMap, start: int, outputs: int) -> QuadraticMap:
    """Return the bound of a part of z as a bound of all of z, which has `outputs` components, with zeros elsewhere.

    The part begins at component `start` of z. A bound has center and radius of shape (m, m, p + 1, p + 1).
    """
    before_and_behind = (start, outputs - start - block.center.shape[0])
    widths = [before_and_behind, before_and_behind, (0, 0), (0, 0)]
    center = library(block.center).pad(block.center, widths)
    radius = library(block.radius).pad(block.radius, widths)
    return QuadraticMap(center, radius)


def stop_gradient(value: Matrix) -> Matrix:
    """Return the value as a constant of JAX derivatives: it only chooses weights, units or a branch."""
    return jax.lax.stop_gradient(value) if is_traced(value) else value
