"""Mean and covariance of f(x) from those of x: by cubature points or by the Jacobian."""

from collections.abc import Callable
from itertools import product
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, decorrelate, eliminate
from heliograph.factors.factored_gaussian import Gaussian, Image, from_covariance, image_by_slopes
from heliograph.factors.pivots import reciprocal_or_zero, spoil_derivatives, square_root, unit_of
from heliograph.filters.gaussian.moments_for_derivatives import (
    find_grid_image,
    find_odd_and_even_parts,
    find_quadratic_image,
)
from heliograph.numerics.check import check_count, fail
from heliograph.numerics.linalg import diagonal
from heliograph.numerics.module import Module, readable, unwritten
from heliograph.numerics.trace_settings import evaluate_at_points, writes_for_derivatives
from heliograph.numerics.types import Array

POINT_LIMIT = 20_000  # points of a tensor rule: more is refused with the number
KNOWN = 1e4  # roundings of a state: a part of less says nothing of the derivative of what was computed with it
SMALLEST = 1e-60  # variance: of less nothing is known

Function = Callable[[jax.Array], jax.Array]


@readable
class Transformed(NamedTuple):
    """Moments of f(x): mean (m,), covariance (m, m) and cross covariance Cov(x, f(x)) of shape (n, m)."""

    mean: jax.Array
    covariance: jax.Array
    cross: jax.Array


@readable
class AbstractTransform(Module):
    """Rule that propagates a mean and a covariance through a function; every rule is exact for affine functions.

    A rule of your own gives `apply`; those of the library give `image`, from which `apply` follows. `keeps_center`: of
    its class, whether the mean of f(x) is f(mean) always.
    """

    keeps_center: ClassVar[bool] = False

    def apply(self, function: Function, mean: jax.Array, covariance: jax.Array) -> Transformed:
        """Return the moments of function(x) for x with mean (n,) and covariance (n, n)."""
        # A transform defines `apply` or `image`. This default computes `apply` from `image`, if that is defined.
        if type(self).image is AbstractTransform.image:
            raise unwritten(self, "apply")
        x = from_covariance(mean, covariance)
        image = self.image(function, x)
        cross_covariance = (x.root * x.variances) @ image.slopes.T
        return Transformed(image.mean, image.columns.covariance, cross_covariance)

    def image(self, function: Function, x: Gaussian) -> Image:
        """Return the moments of f(x) = E f + S xi + rest for x = m + L xi: E f, the slopes S, and columns of Cov(rest).

        The rest is uncorrelated with xi. By default they follow from E f, Cov f and Cov(x, f), which `apply` returns.
        """
        return image_of_moments(self.apply(function, x.mean, jnp.asarray(x.covariance)), x)


def image_of_moments(moments: Transformed, x: Gaussian) -> Image:
    """Return the image of x = m + L xi by f: its mean, its slopes in xi, and the covariance that is left.

    With Cov xi = D, the slopes are (D^-1 L^-1 Cov(x, f))', and Cov f - slopes D slopes' is left.
    """
    slopes = decorrelate(x.root, moments.cross).T * reciprocal_or_zero(x.variances)
    if writes_for_derivatives():  # a quotient of numbers of which only rounding is left has no digits of its derivative
        is_rounding = x.variances <= (KNOWN * unit_of(slopes)) ** 2 * (x.mean**2 + diagonal(x.covariance))
        slopes = spoil_derivatives(slopes, is_rounding | (x.variances < SMALLEST))  # derivatives NaN there
    unexplained = moments.covariance - (slopes * x.variances) @ slopes.T
    return image_by_slopes(moments.mean, slopes, x, eliminate(unexplained))


class Cubature(AbstractTransform):
    """Third-degree spherical-radial cubature: 2 n points mean +- sqrt(n) L e_j with equal weights.

    The unscented transform with kappa = 0. The mean is exact for polynomials of degree 3 of a Gaussian x, the
    covariance for degree 1. What is odd in xi at the points +- sqrt(n d_j) e_j is a slope, what is even is curvature:
    one more noise.

    Source: Arasaratnam and Haykin, Cubature Kalman filters (2009), equations (30) to (36).
    """

    def image(self, function: Function, x: Gaussian) -> Image:
        """Return the moments of f(x) from its values at the 2 n points.

        x has n components, mean m and covariance L diag(d) L', with the columns L_j of L, and s_j = sqrt(n d_j) L_j.
        The differences f(m + s_j) - f(m - s_j) are the slopes. The sums f(m + s_j) + f(m - s_j), less their mean, are
        the curvature. Both have the weights 1 / (4 n).
        """
        n = len(x.mean)
        # Where the program is differentiated: the same parts, in a form that has derivatives where a d_j is 0.
        if writes_for_derivatives():
            parts = find_odd_and_even_parts(function, x, n)
            middle = jnp.sum(parts.even, axis=1) / n
            curvature = WeightedColumns(parts.even - middle[:, None], np.full(n, 1 / (4 * n)))
            return image_by_slopes(parts.here + middle / 2, parts.slopes, x, curvature)
        steps = square_root(n * x.variances)
        ahead, behind = evaluate_beside_mean(function, x, steps)
        # The factor 1 / 2 of the mean of two values is left out here, and taken into the weights and the mean below.
        even = ahead + behind
        middle = jnp.sum(even, axis=1) * (1 / n)
        weights = np.full(n, 1 / (4 * n))
        curvature = WeightedColumns(even - middle[:, None], weights)
        return Image(middle / 2, WeightedColumns(ahead - behind, weights), 2 * steps, curvature)


def evaluate_beside_mean(function: Function, x: Gaussian, steps: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return f at m + step_j L_j and at m - step_j L_j, as columns (p, n) each.

    x has the mean m (n,) and a root with the columns L_j. f has length p.
    """
    offsets = x.root @ jnp.diag(steps)  # a matrix product: the zeros of L stay zeros
    points = jnp.concatenate([x.mean[:, None] + offsets, x.mean[:, None] - offsets], axis=1)
    values = evaluate_at_points(function, points.T).T
    ahead, behind = jnp.split(values, 2, axis=1)  # at m + step_j L_j, at m - step_j L_j
    return ahead, behind


class Linearization(AbstractTransform):
    """First-order expansion at the mean: f(m), J P J', P J' with the Jacobian by automatic differentiation.

    It `keeps_center`: the mean is f(m).
    """

    keeps_center: ClassVar[bool] = True

    def image(self, function: Function, x: Gaussian) -> Image:
        """Return f(m) and the slopes J L, J the Jacobian of f at the mean m."""
        mean = function(x.mean)
        return image_by_slopes(mean, jax.jacfwd(function)(x.mean) @ x.root, x)


def linear_image(matrix: Array, mean: jax.Array, x: Gaussian) -> Image:
    """Return the moments of an affine function f(x) = F x + b, exact under every transform.

    With x = m + L xi, f has the mean F m + b and the slopes F L in xi, and no curvature. F is `matrix` (p, n), and
    `mean` the value F m + b (p,).
    """
    return image_by_slopes(mean, jnp.asarray(matrix @ x.root), x)


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
        """Hold the degree of the polynomials whose moments are taken exactly."""
        self.degree = check_count("degree of the polynomial", degree)

    def image(self, function: Function, x: Gaussian) -> Image:
        """Return the moments of f(x), exact for polynomials up to `degree`.

        For degree 2 they come from the polynomial's coefficients, else from Gauss-Hermite quadrature.
        """
        deviations = square_root(x.variances)
        factor = x.root @ jnp.diag(deviations)  # x = m + factor zeta, zeta standard normal
        if self.degree == 2 and writes_for_derivatives():
            return find_quadratic_image(function, x)
        if self.degree == 2:
            return _quadratic_image(function, x.mean, factor, deviations)
        points, weights = map(jnp.asarray, _hermite_grid(x.mean.shape[0], self.degree + 1))
        if writes_for_derivatives():
            return find_grid_image(function, x, points, weights)
        values = evaluate_at_points(function, x.mean + points @ factor.T).T  # (p, points)
        center = values @ weights  # E f
        slopes = (values * weights) @ points  # E[f zeta']: the slopes for a change of one deviation
        # The differences between f and its best linear fit, at each point.
        residuals = values - center[:, None] - slopes @ points.T
        explained = WeightedColumns(slopes, np.ones(len(deviations)))
        return Image(center, explained, deviations, eliminate(WeightedColumns(residuals, weights).covariance))


def _quadratic_image(function: Function, mean: jax.Array, factor: jax.Array, deviations: jax.Array) -> Image:
    """Return the image of x = mean + factor xi, xi standard normal, by a function f of degree 2.

    f(m + L xi) = c + sum a_i xi_i + sum b_i xi_i^2 + sum_{i<j} b_ij xi_i xi_j, with L = factor. Its coefficients follow
    from the values at m, m + L_i, m - L_i and m + L_i + L_j for i < j. The mean is c + sum b_i, and the slopes are a_i.
    The part that is uncorrelated with xi has the covariance 2 sum b_i b_i' + sum b_ij b_ij'. `deviations` (n,) are only
    passed on to the Image: its slopes are in these units.
    """
    n, center = mean.shape[0], mean[:, None]
    rows, columns = np.triu_indices(n, 1)
    points = [center, center + factor, center - factor, center + factor[:, rows] + factor[:, columns]]
    values = evaluate_at_points(function, jnp.concatenate(points, axis=1).T).T
    # f at m (p, 1), at m + L_i (p, n), at m - L_i (p, n), and at m + L_i + L_j (p, pairs).
    start, ahead, behind, cross = jnp.split(values, [1, n + 1, 2 * n + 1], axis=1)
    slopes = (ahead - behind) / 2  # a_i
    squares = (ahead + behind) / 2 - start  # b_i
    mixed = cross - ahead[:, rows] - ahead[:, columns] + start  # b_ij
    weights = np.concatenate([np.full(n, 2.0), np.ones(len(rows))])
    curvature = WeightedColumns(jnp.concatenate([squares, mixed], axis=1), weights)
    f_mean = start[:, 0] + jnp.sum(squares, axis=1)
    return Image(f_mean, WeightedColumns(slopes, np.ones(n)), deviations, curvature)


def _hermite_grid(dimension: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (count^dimension, dimension) and weights of Gauss-Hermite's rule for a standard normal vector.

    `count` points in each direction: all combinations of them, with the products of their probabilities as weights.
    More than POINT_LIMIT points, 20,000, are refused.
    """
    if count**dimension > POINT_LIMIT:
        raise fail("points of the exact-moment rule", f"at most {POINT_LIMIT:,}", f"{count}^{dimension}")
    nodes, weights = np.polynomial.hermite_e.hermegauss(count)
    grid = np.array(list(product(nodes, repeat=dimension)))
    probabilities = weights / weights.sum()
    return grid, np.array([np.prod(w) for w in product(probabilities, repeat=dimension)])
