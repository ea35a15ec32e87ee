"""Gaussians of states that are attitudes: a mean on the group, and a covariance of changes from it.

Moments are computed of changes from a center, added to it: x = center + d stands for center plus d. What comes out has
its mean beside the center; here it becomes a mean on the group, and its covariance one of changes from that mean.
"""

import jax
import jax.numpy as jnp

from heliograph.factors.covariance_factors import WeightedColumns
from heliograph.factors.factored_gaussian import Gaussian, from_columns
from heliograph.numerics.angles.manifold import Manifold


def settle(manifold: Manifold, center: jax.Array, x: Gaussian) -> Gaussian:
    """Return the law of (center plus d) from the law of the plain sum x = center + d.

    `plus` turns an attitude by d. Where no state is an attitude, both sums are equal and x is returned. Else the mean
    becomes m' = center plus E d. To first order its error is J (d - E d), with J the derivative by d, at E d, of the
    change that leads from m' to center plus d. So J (`reset`) turns errors to the axes of m'.

    Source: Sola, Quaternion kinematics for the error-state Kalman filter (2017), section 6.3 (the reset).
    """
    reset = manifold.reset_jacobian(x.mean - center) if manifold.rotations else None
    if reset is None:
        return x
    mean = manifold.settle(center, x.mean)
    return from_columns(mean, WeightedColumns(reset @ x.root, x.variances))


def unsettle(manifold: Manifold, center: jax.Array, x: Gaussian) -> Gaussian:
    """Return the law of the plain sum center + d from the law of x = (center plus d), as the inverse of `settle`.

    `plus` turns an attitude by d, and + adds d to a plain vector, as filters need it. Where no state is an attitude,
    both sums are equal and x is returned. Else errors are multiplied by J^-1, J the matrix of `settle`.
    """
    if not manifold.rotations:
        return x
    mean = manifold.unsettle(center, x.mean)
    reset = manifold.reset_jacobian(mean - center)
    assert reset is not None
    return from_columns(mean, WeightedColumns(jnp.linalg.inv(reset) @ x.root, x.variances))
