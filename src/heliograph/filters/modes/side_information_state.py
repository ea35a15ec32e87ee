"""State of a filter with side information on the modes: an estimate, and moments of its error and of x in each mode."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, below_diagonal, side_by_side, unit_lower
from heliograph.numerics.types import Bool, Float


class SideInformationBelief(NamedTuple):
    """s, the estimate of zeta, and factors of E[q q' 1{mode} | side information] of q = (e, x~), of each mode.

    x~ = (x - c, 1) with c = E[x] before any data, zeta holds x~ 1{mode}, mode after mode, and e = zeta - s is the
    error: in a mode, s follows from e and x~.

    Shapes: with N = M (n + 1) and q = N + n + 1: mean (N,), lower (M, q (q - 1) / 2), variances (M, q), centre c (n,).
    """

    mean: Float[jax.Array, " N"]
    lower: Float[jax.Array, "M entries"]
    variances: Float[jax.Array, "M q"]
    centre: Float[jax.Array, " n"]
    moved: Bool[jax.Array, ""]

    @property
    def moments(self) -> WeightedColumns:
        """E[q q' 1{mode}] of each mode, for q = (e, x~), as columns (M, q, q) with their weights."""
        return WeightedColumns(unit_lower(self.lower), self.variances)

    @property
    def errors(self) -> WeightedColumns:
        """E[e e' | side information] = sum_j E[e e' 1{mode = j} | ...] of the estimate's error e, as columns (N, M q).

        Each of the M modes has q columns.
        """
        # The rows of e are the first N of (e, x~); the sum over modes has the weight 1 for each.
        modes, errors_by_mode = len(self.lower), self.moments.matrix[:, : len(self.mean)]
        return side_by_side(WeightedColumns(errors_by_mode, self.moments.weights), np.ones(modes))

    @property
    def covariance(self) -> Float[jax.Array, "N N"]:
        """E[e e' | side information] (N, N): the covariance of the error e of the estimate, whose mean is 0."""
        return self.errors.covariance


def split_columns(state: SideInformationBelief) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Split the columns of the stacked vector (e, x~) in those of e and those of x~, mode by mode.

    x~ = (x - c, 1) is the plant's state about c = E[x], with a 1, and e (N,) the error of the filter's estimate. In
    each of M modes second moments are weighted sums over q columns: E[e x~' 1{mode = j}] = sum_q w_jq e_jq x~_jq'.

    Returns:
        Columns of e (M, N, q) and of x~ (M, n + 1, q), and their weights w (M, q).
    """
    columns, length_of_e = jnp.asarray(state.moments.matrix), len(state.mean)
    return columns[:, :length_of_e], columns[:, length_of_e:], jnp.asarray(state.variances)


def make_belief(
    mean: jax.Array, moments: WeightedColumns, centre: jax.Array, moved: jax.Array
) -> SideInformationBelief:
    """Return the filter's state, of which factors are stored as their entries below the diagonal.

    Args:
        mean: estimate of the products of (x - c, 1) and the modes' indicators.
        moments: lower triangular factors of E[q q' 1{mode}] (M, q, q), q the estimate's error and (x - c, 1).
        centre: c = E[x] before any data.
        moved: True once a step was predicted.
    """
    lower = jax.vmap(below_diagonal)(jnp.asarray(moments.matrix))  # what is below the unit diagonal
    return SideInformationBelief(
        mean=mean, lower=lower, variances=jnp.asarray(moments.weights), centre=centre, moved=moved
    )


def mode_probabilities(x: jax.Array, weights: jax.Array) -> jax.Array:
    """Return the probabilities of the modes (M,): E[1^2 1{mode}], since the last entry of x~, `x`, is 1."""
    return jnp.einsum("jq,jq->j", x[:, -1] ** 2, weights)
