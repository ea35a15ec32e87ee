"""Mean and covariance of f(x) from those of x: by cubature points or by the Jacobian."""

from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import check_count, fail
from heliograph.numerics.linalg import above_products, add, cholesky, symmetric, times, transpose
from heliograph.numerics.module import Module, readable, unwritten
from heliograph.numerics.over_runs import runs_last
from heliograph.numerics.types import Array

POINT_LIMIT = 20_000  # points of a tensor rule: more is refused with the number

Function = Callable[[jax.Array], jax.Array]


@readable
class Transformed(NamedTuple):
    """Moments of f(x): mean (m,), covariance (m, m) and cross covariance Cov(x, f(x)) of shape (n, m)."""

    mean: jax.Array
    covariance: jax.Array
    cross: jax.Array


@readable
class AbstractTransform(Module):
    """Rule that propagates a mean and a covariance through a function; every rule is exact for affine functions."""

    def apply(self, function: Function, mean: jax.Array, covariance: jax.Array) -> Transformed:
        """Moments of function(x) for x with mean (n,) and covariance (n, n)."""
        raise unwritten(self, "apply")


class Cubature(AbstractTransform):
    """Third-degree spherical-radial cubature: 2 n points mean +- sqrt(n) L e_j with equal weights.

    The unscented transform with kappa = 0. The mean is exact for polynomials of degree 3 of a Gaussian x, the
    covariance for degree 1.

    Source: Arasaratnam and Haykin, Cubature Kalman filters (2009), equations (30) to (36).
    """

    def apply(self, function: Function, mean: jax.Array, covariance: jax.Array) -> Transformed:
        """Propagate the points and take their sample moments."""
        offsets, points = _cubature_points(mean, cholesky(covariance))
        values = jax.vmap(function, in_axes=1, out_axes=1)(points)
        return _about(offsets, values, _center(values))


@runs_last
def _cubature_points(mean: jax.Array, factor: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Offsets sqrt(n) L (n, n), and the points mean + offsets, mean - offsets as columns (n, 2 n)."""
    offsets = mean.shape[0] ** 0.5 * factor
    return offsets, jnp.concatenate([mean[:, None] + offsets, mean[:, None] - offsets], axis=1)


@runs_last
def _center(values: jax.Array) -> jax.Array:
    return add([values[:, j] for j in range(values.shape[1])]) * (1 / values.shape[1])


@runs_last
def _about(offsets: jax.Array, values: jax.Array, center: jax.Array) -> Transformed:
    n = offsets.shape[0]
    weight, spread = 1 / (2 * n), values - center[:, None]
    cross = times(weight * offsets, transpose(values[:, :n] - values[:, n:]))
    return Transformed(center, weight * times(spread, transpose(spread)), cross)


class Linearization(AbstractTransform):
    """First-order expansion at the mean: f(m), J P J', P J' with the Jacobian by automatic differentiation."""

    def apply(self, function: Function, mean: jax.Array, covariance: jax.Array) -> Transformed:
        """Evaluate f and its Jacobian at the mean."""
        return Transformed(function(mean), *_linear_moments(covariance, jax.jacfwd(function)(mean)))


@runs_last
def _linear_moments(covariance: jax.Array, jacobian: jax.Array) -> tuple[jax.Array, jax.Array]:
    """J P J' and P J'."""
    cross = times(covariance, transpose(jacobian))
    return above_products(symmetric(times(jacobian, cross)), jacobian, covariance), cross


def linear_transform(matrix: Array, center: jax.Array, covariance: jax.Array) -> Transformed:
    """Moments of a linear function with this matrix and this value at the mean, which every transform reproduces."""
    return Transformed(center, *_linear_moments(covariance, jnp.asarray(matrix)))


class PolynomialMoments(AbstractTransform):
    """Exact mean and covariance of a polynomial of a Gaussian x.

    Degree 2 from the polynomial's coefficients, 1 + 2 n + n (n - 1) / 2 evaluations. Other degrees d by
    Gauss-Hermite quadrature: with d + 1 points in each of the n directions of the factor of P, products of two
    polynomials of degree d are integrated exactly; (d + 1)^n evaluations.

    Args:
        degree: of the polynomial, from 1.

    Raises:
        ValueError: a degree below one, or (when applied) more than 20,000 points.

    Source: Golub and Welsch, Calculation of Gauss quadrature rules (1969).
    """

    degree: int = eqx.field(static=True)

    def __init__(self, degree: int):
        self.degree = check_count("degree of the polynomial", degree)

    def apply(self, function: Function, mean: jax.Array, covariance: jax.Array) -> Transformed:
        """Compute the coefficients, or evaluate at the quadrature points and sum with their weights."""
        if self.degree == 2:
            factor = cholesky(covariance)
            return _quadratic_moments(
                factor, jax.vmap(function, in_axes=1, out_axes=1)(_quadratic_points(mean, factor))
            )
        points, weights = map(jnp.asarray, _hermite_grid(mean.shape[0], self.degree + 1))
        deviations = points @ cholesky(covariance).T
        values = jax.vmap(function)(mean + deviations)
        center = weights @ values
        spread = values - center
        weighted = weights[:, None] * spread
        return Transformed(center, spread.T @ weighted, deviations.T @ weighted)


@runs_last
def _quadratic_points(mean: jax.Array, factor: jax.Array) -> jax.Array:
    """m, m + L_i, m - L_i and m + L_i + L_j for i < j, as columns."""
    n, center = mean.shape[0], mean[:, None]
    rows, columns = np.triu_indices(n, 1)
    both = factor[:, rows] + factor[:, columns]
    return jnp.concatenate([center, center + factor, center - factor, center + both], axis=1)


@runs_last
def _quadratic_moments(factor: jax.Array, values: jax.Array) -> Transformed:
    """f(m + L xi) = c + sum a_i xi_i + sum b_i xi_i^2 + sum_i<j b_ij xi_i xi_j, xi standard normal.

    Mean c + sum b_i, covariance sum a_i a_i' + 2 sum b_i b_i' + sum b_ij b_ij', cross covariance L a'.
    """
    n = factor.shape[0]
    rows, columns = np.triu_indices(n, 1)
    start, ahead, behind, both = jnp.split(values, [1, n + 1, 2 * n + 1], axis=1)
    slopes, squares = (ahead - behind) / 2, (ahead + behind) / 2 - start
    mixed = both - ahead[:, rows] - ahead[:, columns] + start
    terms = jnp.concatenate([slopes, 2**0.5 * squares, mixed], axis=1)
    covariance = add([terms[:, None, i] * terms[None, :, i] for i in range(terms.shape[1])])
    center = add([start[:, 0], *(squares[:, i] for i in range(n))])
    return Transformed(center, covariance, times(factor, transpose(slopes)))


def _hermite_grid(dimension: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (count^dimension, dimension) and weights of the tensor rule for a standard normal vector."""
    if count**dimension > POINT_LIMIT:
        raise fail("points of the exact-moment rule", f"at most {POINT_LIMIT:,}", f"{count}^{dimension}")
    nodes, weights = np.polynomial.hermite_e.hermegauss(count)
    grid = np.array(list(product(nodes, repeat=dimension)))
    return grid, np.array([np.prod(w) for w in product(weights / weights.sum(), repeat=dimension)])
