"""Mean and covariance of f(x) from those of x: by cubature points or by the Jacobian."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.linalg import cholesky, symmetrize

Function = Callable[[jax.Array], jax.Array]


class Transformed(NamedTuple):
    """Moments of f(x): mean (m,), covariance (m, m) and cross covariance Cov(x, f(x)) of shape (n, m)."""

    mean: jax.Array
    covariance: jax.Array
    cross: jax.Array


class AbstractTransform(eqx.Module):
    """A rule that carries a mean and a covariance through a function; every rule is exact for affine functions."""

    def apply(self, function: Function, mean: jax.Array, covariance: jax.Array) -> Transformed:
        """Moments of function(x) for x with the given mean (n,) and covariance (n, n)."""
        raise NotImplementedError


class Cubature(AbstractTransform):
    """Third-degree spherical-radial cubature: 2 n points mean +- sqrt(n) L e_j with equal weights.

    The mean is exact for polynomials of degree 3 of a Gaussian x, the covariance for degree 1.
    Source: Arasaratnam and Haykin, Cubature Kalman filters (2009), equations (30) to (36).
    """

    def apply(self, function: Function, mean: jax.Array, covariance: jax.Array) -> Transformed:
        """Propagate the points and take their sample moments."""
        n = mean.shape[0]
        offsets = jnp.sqrt(float(n)) * cholesky(covariance).T  # row j: sqrt(n) L e_j
        deviations = jnp.concatenate([offsets, -offsets])
        values = jax.vmap(function)(mean + deviations)
        center = values.mean(axis=0)
        spread = values - center
        return Transformed(center, spread.T @ spread / (2 * n), deviations.T @ spread / (2 * n))


class Linearization(AbstractTransform):
    """First-order expansion at the mean: f(m), J P J', P J' with the Jacobian by automatic differentiation."""

    def apply(self, function: Function, mean: jax.Array, covariance: jax.Array) -> Transformed:
        """Evaluate f and its Jacobian at the mean."""
        jacobian = jax.jacfwd(function)(mean)
        cross = covariance @ jacobian.T
        return Transformed(function(mean), symmetrize(jacobian @ cross), cross)
