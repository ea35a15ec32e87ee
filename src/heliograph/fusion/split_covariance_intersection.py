"""Split covariance intersection: errors with a part of known and a part of unknown correlation."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import rounding_of_variances
from heliograph.fusion.joint_covariance_weights import matrix_weights, weigh_covariance
from heliograph.fusion.rules import AbstractIntersection, Covariances, Fused, Means
from heliograph.numerics.check import DEFINITENESS_TOLERANCE, array, fail, rank
from heliograph.numerics.linalg import cholesky
from heliograph.numerics.types import Array, ArrayLike, Float

ROUNDS = 30  # of weights for the shares and shares for the weights, each of which lowers the trace
LEAST = 1e-12  # share that an estimate keeps that is hardly used


class SplitIntersection(AbstractIntersection):
    """Fuse errors e_i = a_i + b_i, a and b uncorrelated, the a_i jointly known, of the b_i nothing but each covariance.

    For every w on the simplex P(w) = P^a + blockdiag(P^b_i / w_i) bounds the joint covariance, whatever the correlation
    of the b_i: weights are the best for it, shares w_i those with the smallest trace. With nothing known it is
    covariance intersection, with everything known matrix weights. P^b_i is the excess of an estimate's covariance over
    P^a_ii; where that is not positive semidefinite the result is NaN.

    Args:
        known: P^a (node, n, node, n), or (node, n, n) for parts that are independent.

    Claim: at most "upper".

    Raises:
        ValueError: a known part that is no joint covariance, or not of as many estimates as are fused.

    Source: Julier and Uhlmann, General decentralized data fusion with covariance intersection (2001), split form.
    """

    known: Float[Array, "node n node n"]

    def __init__(self, known: Float[ArrayLike, "node n *joint"]):
        """Check and hold P^a, the joint covariance of the known parts of the errors, as (node, n, node, n).

        Parts that are independent between nodes may be given as one covariance for each, (node, n, n).
        """
        values = array("known part", known, (None,) * rank("known part", known))
        # Independent parts: the blocks of a block-diagonal P^a.
        if values.ndim == 3 and values.shape[1] == values.shape[2]:
            nodes, n, _ = values.shape
            items = np.arange(nodes)
            joint = np.zeros((nodes, n, nodes, n))
            joint[items, :, items, :] = values
            values = joint
        if values.ndim != 4 or values.shape[:2] != values.shape[2:]:
            raise fail("known part", "shape (nodes, n, nodes, n) or (nodes, n, n)", f"shape {values.shape}")
        # P^a is symmetric and positive semidefinite, to rounding.
        flat = values.reshape(values.shape[0] * values.shape[1], -1)
        tolerance = DEFINITENESS_TOLERANCE * np.abs(flat).max(initial=0.0)
        is_symmetric = np.allclose(flat, flat.T, rtol=0, atol=tolerance)
        if not is_symmetric or np.linalg.eigvalsh(flat)[0] < -tolerance:
            raise fail("known part", "a covariance of all parts together", "a matrix that is none")
        self.known = values

    def check(self, count: int) -> None:
        """Raise ValueError unless there are as many known parts as estimates."""
        if len(self.known) != count:
            raise fail("known part", f"that of {count} estimates", f"that of {len(self.known)}")

    def combine(self, means: Means, covariances: Covariances) -> Fused:
        """Return the fused mean and covariance of estimates whose errors are correlated in a known part only.

        The known parts of the errors have the joint covariance P^a (`known`). P^b_i, the covariance of estimate i less
        P^a_ii, belongs to a part of its error whose correlation with the others is unknown. P(w) = P^a +
        blockdiag(P^b_i / w_i) bounds the joint covariance for all shares w, sum w = 1. Weights W and shares are found
        in turn: W by least squares for P(w), then w_i in proportion to root(tr W_i P^b_i W_i'). The trace of W P(w) W'
        falls with each.

        Args:
            means: of the estimates, (estimate, n).
            covariances: of their errors, (estimate, n, n).
        """
        known = jnp.asarray(self.known)
        count = len(means)
        items = jnp.arange(count)
        unknown = _add_rounding(covariances - known[items, :, items, :], covariances)  # P^b_i

        def bound_joint(shares: jax.Array) -> jax.Array:
            """Return P(w), which bounds the joint covariance for all shares that sum to 1."""
            return known.at[items, :, items, :].add(unknown / shares[:, None, None])

        def improve_shares(_: int, shares: jax.Array) -> jax.Array:
            """Return the best shares for the weights that are best for the present ones, none below LEAST (1e-12).

            The bound of the joint covariance divides the `unknown` part of each estimate by its share.
            """
            weights = matrix_weights(bound_joint(shares))
            deviations = jnp.sqrt(jnp.maximum(jnp.einsum("aib,ibc,aic->i", weights, unknown, weights), 0.0))
            total = deviations.sum()  # 0 if nothing is unknown, when the shares do not matter
            new_shares = jnp.where(total > 0, deviations / jnp.where(total > 0, total, 1.0), shares)
            return jnp.maximum(new_shares, LEAST)

        # Alternating minimisation from equal shares.
        shares = jax.lax.fori_loop(0, ROUNDS, improve_shares, jnp.full(count, 1 / count))
        joint = bound_joint(shares / shares.sum())
        weights = matrix_weights(joint)
        # W x and W P(w) W'; NaN if some P^b_i is no covariance.
        are_covariances = jnp.all(jnp.isfinite(jax.vmap(cholesky)(unknown)))
        mean, covariance = jnp.einsum("aib,ib->a", weights, means), weigh_covariance(weights, joint)
        return mean, jnp.where(are_covariances, covariance, jnp.nan)


def _add_rounding(unknown: jax.Array, covariances: jax.Array) -> jax.Array:
    """Return the covariances P^b_i of unknown correlation with the rounding error of P_i on their diagonals.

    P^b_i = P_i - P^a_ii (`unknown`) is computed from the covariance P_i of estimate i, so that it is wrong by the
    rounding error of P_i. It is later divided by a share, which may be small; without this addition the result could
    then be too small. Where P^b_i is zero, all of P_i is known, and nothing is added.
    """
    n = unknown.shape[-1]
    rounding = rounding_of_variances(jnp.einsum("aii->ai", covariances), n)
    is_not_zero = jnp.any(unknown != 0, axis=(-1, -2), keepdims=True)
    return unknown + jnp.where(is_not_zero, rounding[..., None] * jnp.eye(n, dtype=unknown.dtype), 0.0)
