"""Moments of f(x) by points, written so that they can be differentiated where the points nearly coincide.

At m +- s_j L_j, s_j = sqrt(c d_j), the even part of f has the derivative c f''[L_j, L_j] in a variance d_j, which is
there at d_j = 0 too; as a difference of values it is lost in their rounding as s_j goes to zero. So, where f is nearly
linear over a step, its parts are integrals of its derivatives, which subtract nothing:

    f(m + s L) + f(m - s L) - 2 f(m) = s^2 int (1 - |t|) f''(m + t s L)[L, L] dt,
    f(m + s L) - f(m - s L) = s int f'(m + t s L)[L] dt,  t from -1 to 1.

With the nodes 0 and +- 1 / sqrt 6 both are exact to the fourth power of s.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, eliminate
from heliograph.factors.factored_gaussian import Gaussian, Image
from heliograph.factors.pivots import square_root
from heliograph.numerics.types import Array

Function = Callable[[jax.Array], jax.Array]

NODE = 1 / np.sqrt(6)  # share of a step at which the derivatives are taken: the nodes of the integrals above
NEARLY_LINEAR = (
    1e-3  # over a step f'' adds at most this share of f', and f''' its square: what is neglected, its fourth
)


class Parts(NamedTuple):
    """A function f about m, along the columns L_j of x = m + L xi, with a step s_j in each.

    `here` is f(m) (p,), `slopes` (f(m + s_j L_j) - f(m - s_j L_j)) / (2 s_j) (p, n), `even` f(m + s_j L_j) +
    f(m - s_j L_j) - 2 f(m) (p, n), and `linear` (p, n) says whether f is nearly linear over the step.
    """

    here: jax.Array
    slopes: jax.Array
    even: jax.Array
    linear: jax.Array


def find_odd_and_even_parts(function: Function, x: Gaussian, scale: Array | float) -> Parts:
    """Return f at the mean m of x = m + L xi, and its odd and even parts over the steps s_j = sqrt(scale d_j).

    `slopes` are (f(m + s_j L_j) - f(m - s_j L_j)) / (2 s_j), `even` f(m + s_j L_j) + f(m - s_j L_j) - 2 f(m).
    """
    mean, variances = x.mean, x.variances
    steps, here = square_root(scale * variances), function(mean)

    def of_column(column: jax.Array, step: jax.Array, variance: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return slopes, even part and `linear` (p,) in one column L_j, by values at two points, or by derivatives.

        By derivatives where a component of f is nearly linear over the step s. With g(t) = f(m + t s L_j) both are
        integrals of g' and g'' over t, taken with the nodes 0 and +- 1 / sqrt 6.
        """
        _, slope_here = jax.jvp(function, (mean,), (column,))
        slope_ahead, bend_ahead = differentiate_twice(function, mean + NODE * step * column, column)
        slope_behind, bend_behind = differentiate_twice(function, mean + -NODE * step * column, column)
        # Nearly linear: s |f''| and s^2 |f'''| are small shares of |f'|.
        bend = jnp.maximum(jnp.abs(bend_ahead), jnp.abs(bend_behind))
        slope = jnp.maximum(jnp.abs(slope_here), jnp.maximum(jnp.abs(slope_ahead), jnp.abs(slope_behind)))
        twist = jnp.abs(bend_ahead - bend_behind) / (2 * NODE)  # s f'''
        linear = (step * bend <= NEARLY_LINEAR * slope) & (step * twist <= NEARLY_LINEAR**2 * slope)
        ahead, behind = function(mean + step * column), function(mean - step * column)
        safe_step = jnp.where(step > 0, step, 1.0)
        slopes = jnp.where(linear, slope_ahead + slope_behind - slope_here, (ahead - behind) / (2 * safe_step))
        even_by_values = (ahead - here) + (behind - here)
        even = jnp.where(linear, scale * variance / 2 * (bend_ahead + bend_behind), even_by_values)
        return slopes, even, linear

    return Parts(here, *jax.vmap(of_column, in_axes=(1, 0, 0), out_axes=1)(jnp.asarray(x.root), steps, variances))


def differentiate_twice(function: Function, at: jax.Array, direction: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return f'(x)[v] and f''(x)[v, v] at x = `at`, for the direction v: first and second directional derivative."""
    return jax.jvp(lambda y: jax.jvp(function, (y,), (direction,))[1], (at,), (direction,))


def find_quadratic_image(function: Function, x: Gaussian) -> Image:
    """Return the image f(x) of a Gaussian x by a function of degree 2, by formulas that have accurate derivatives.

    With x = m + L xi, Var xi_i = d_i, f(x) = f(m) + sum_i s_i xi_i + sum_i q_i xi_i^2 + sum_i<j c_ij xi_i xi_j. The
    image has the mean E f(x), the columns s_i with weights d_i, and the columns of the curvature: q_i d_i of the weight
    2, since Var xi_i^2 = 2 d_i^2, and c_ij of the weight d_i d_j. They add up to Cov f(x).
    """
    # s_i = parts.slopes, and parts.even = f(m + sqrt(d_i) L_i) + f(m - sqrt(d_i) L_i) - 2 f(m) = 2 q_i d_i.
    parts, d = find_odd_and_even_parts(function, x, 1.0), x.variances
    deviations, root = square_root(d), jnp.asarray(x.root)
    squares = parts.even / 2
    rows, columns = np.triu_indices(len(d), 1)

    def slopes_at(point: jax.Array) -> jax.Array:
        """Return f'(point)[L_j] of all columns L_j, as the columns of a matrix (p, n)."""
        differentiate: Any = jax.vmap(lambda column: jax.jvp(function, (point,), (column,))[1], in_axes=1, out_axes=1)
        return jnp.asarray(differentiate(root))

    def mixed(i: jax.Array, j: jax.Array) -> jax.Array:
        """Return the coefficient of xi_i xi_j, by values or by slopes in the column over which f is nearly linear."""
        # By values: the mixed difference over both steps. By slopes: how the slope in one column changes along the
        # other; it keeps its digits where the step changes f hardly more than a straight line.
        (at_i, at_j), middle = (mean + deviations[k] * root[:, k] for k in (i, j)), slopes_at(mean)
        mixed_difference = (
            function(at_i + deviations[j] * root[:, j]) - function(at_i) - function(at_j) + function(mean)
        )
        s_i, s_j = (jnp.where(deviations[k] > 0, deviations[k], 1.0) for k in (i, j))
        by_slope_in_i = (slopes_at(at_j) - middle)[:, i] / s_j
        by_slope_in_j = (slopes_at(at_i) - middle)[:, j] / s_i
        by_values = mixed_difference / (s_i * s_j)
        return jnp.where(parts.linear[:, j], by_slope_in_j, jnp.where(parts.linear[:, i], by_slope_in_i, by_values))

    mean = x.mean
    # c_ij of all pairs i < j, as columns; of a single state there is none.
    no_products = jnp.zeros((len(squares), 0))
    products = jax.vmap(mixed, out_axes=1)(jnp.asarray(rows), jnp.asarray(columns)) if len(rows) else no_products
    weights = jnp.concatenate([jnp.full(len(d), 2.0), d[rows] * d[columns]])
    curvature = WeightedColumns(jnp.concatenate([squares, products], axis=1), weights)
    return Image(parts.here + jnp.sum(squares, axis=1), WeightedColumns(parts.slopes, d), np.ones(len(d)), curvature)


def find_grid_image(function: Function, x: Gaussian, nodes: jax.Array, weights: jax.Array) -> Image:
    """Return the image of x by the product rule of these nodes (points, n) and weights (points,) of a normal vector.

    x = m + sum_j L_j xi_j with Var xi_j = d_j, L_j the columns of `x.root`. Points m + sum_j sqrt(d_j) L_j node_j would
    lose derivatives to rounding in the columns over which f is nearly linear (`near`). There f is expanded about the
    points of all other columns: f + 1/2 sum_j d_j f''[L_j, L_j], plus f'[L_j] xi_j. A column over which only some
    components of f are nearly linear is taken by values.
    """
    parts = find_odd_and_even_parts(function, x, jnp.max(nodes) ** 2)
    d, root, near = x.variances, jnp.asarray(x.root), jnp.all(parts.linear, axis=0)
    deviations = jnp.where(near, 0.0, square_root(d))

    def at_point(node: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return f + 1/2 sum_j d_j f''[L_j, L_j] over the near columns j, (p,), and f'[L_j] of all columns, (p, n).

        `node` (n,) is a point of the rule; near columns stay at their mean.
        """
        point = x.mean + root @ (deviations * node)
        slopes, bends = jax.vmap(lambda column: differentiate_twice(function, point, column), in_axes=1)(root)
        return function(point) + jnp.where(near, d / 2, 0.0) @ bends, slopes.T

    values, slopes_at_points = jax.vmap(at_point)(nodes)  # (points, p), (points, p, n)
    # E f(x); the slopes that fit f best, E[f xi_j] / d_j by values; and the covariance of what the slopes leave: of f
    # at the points, and in near columns of slopes that differ from point to point.
    center = weights @ values
    by_values = (values.T * weights) @ nodes / jnp.where(near, 1.0, jnp.where(deviations > 0, deviations, 1.0))
    slopes = jnp.where(near, jnp.einsum("k,kpj->pj", weights, slopes_at_points), by_values)
    residuals = values - center - (nodes * deviations) @ slopes.T
    bent = jnp.moveaxis(slopes_at_points - slopes, 1, 0).reshape(len(center), -1)
    weights_of_bent = (weights[:, None] * jnp.where(near, d, 0.0)).reshape(-1)
    covariance = WeightedColumns(residuals.T, weights).covariance + WeightedColumns(bent, weights_of_bent).covariance
    return Image(center, WeightedColumns(slopes, d), np.ones(len(d)), eliminate(covariance))
