"""Rounding of a mean, where a smoother needs it beside the process noise."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.types import Array, Float


def state_rounding(size: Array) -> Float[jax.Array, "n *runs"]:
    """Variance of each component of a mean by rounding alone, ((n + 2) eps)^2 E[x_i^2] of the state at the start."""
    unit = (len(size) + 2) * float(np.finfo(size.dtype).eps)
    return unit**2 * jnp.asarray(size)
