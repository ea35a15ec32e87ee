"""Gaussians of states that are attitudes: a mean on the group, and a covariance of changes from it.

Moments are computed of changes from a center, added to it: x = center + d stands for center plus d. What comes out has
its mean beside the center; here it becomes a mean on the group, and its covariance one of changes from that mean.
"""

import jax
import jax.numpy as jnp

from heliograph.factors.covariance_factors import WeightedColumns
from heliograph.factors.factored_gaussian import Gaussian, from_columns
from heliograph.numerics.manifold import Manifold


def settle(manifold: Manifold, center: jax.Array, x: Gaussian) -> Gaussian:
    """Return x as it is where no state is an attitude; else the law of center plus d, from that of center + d.

    d is the change from `center`, to which a filter adds as to a plain vector; `plus` turns an attitude by d. So the
    mean becomes m' = center plus E d, and an error about it is J (d - E d) to first order, J the derivative of the
    change from m' at E d: errors are turned to the axes of m'.

    Source: Sola, Quaternion kinematics for the error-state Kalman filter (2017), section 6.3 (the reset).
    """
    reset = manifold.reset_jacobian(x.mean - center) if manifold.rotations else None
    if reset is None:
        return x
    mean = manifold.settle(center, x.mean)
    return from_columns(mean, WeightedColumns(reset @ x.root, x.variances))


def unsettle(manifold: Manifold, center: jax.Array, x: Gaussian) -> Gaussian:
    """Return x as it is where no state is an attitude; else the law of center + d, from that of x = center plus d.

    d is the change from `center`: `plus` turns an attitude by it, + adds it as to a plain vector, as filters need it.
    The inverse of `settle`: its matrix J of errors is inverted.
    """
    if not manifold.rotations:
        return x
    mean = manifold.unsettle(center, x.mean)
    reset = manifold.reset_jacobian(mean - center)
    assert reset is not None
    return from_columns(mean, WeightedColumns(jnp.linalg.inv(reset) @ x.root, x.variances))
