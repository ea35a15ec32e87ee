"""No variance is below the rounding of the mean that it belongs to, however often data without noise say the same."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.over_runs import runs_last
from heliograph.numerics.small_matrix import PRECISE, diagonal, diagonal_of, rounding
from heliograph.numerics.types import Array, Float


def initial_size(mean: Array, covariance: Array) -> Float[jax.Array, " n"]:
    """E[x_i^2] before the first step, (n,)."""
    mean = jnp.asarray(mean)
    seconds: jax.Array = mean * mean + jnp.diagonal(jnp.asarray(covariance))
    return seconds


def output_rounding(matrix: Array, size: Array) -> Float[jax.Array, " m"]:
    """Deviation of H x by rounding alone, (n + 2) eps |H| root E[x x'] of the state at the start: (m,).

    What a combination of outputs without noise says of a state that is known better is no measurement: by it the
    rounding of z would be divided by a deviation below it.
    """
    reach: jax.Array = jnp.abs(jnp.asarray(matrix)) @ jnp.sqrt(size)
    return (len(size) + 2) * float(np.finfo(reach.dtype).eps) * reach


@runs_last
def above_rounding(after: jax.Array, prior: jax.Array, size: jax.Array) -> jax.Array:
    """P and, of each variance of which a precise measurement left next to nothing, what the mean cannot say.

    That is ((n + 2) eps)^2 E[x_i^2] of the state at the start, and no more than there was. Noise-free data would else
    shrink P by eps^2 a step, to where a smoother divides the rounding of an innovation by it. A moment from before all
    data at a later step will not do in place of that at the start: of an unstable plant that its inputs hold it grows
    without end; nor will the mean, on which no covariance of a linear filter depends.

    Shapes: after and prior (n, n), size (n,).
    """
    unit = (len(after) + 2) * float(np.finfo(after.dtype).eps)
    left, whole = diagonal_of(after), diagonal_of(prior)
    precise = left < rounding(PRECISE, after, 1000) * whole
    return after + diagonal(jnp.where(precise, jnp.minimum(unit**2 * size, whole), 0.0))
