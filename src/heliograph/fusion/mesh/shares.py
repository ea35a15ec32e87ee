"""Shares of covariance intersection between neighbours: from what arrived and its covariances alone."""

import jax
import jax.numpy as jnp

from heliograph.fusion.intersection import inverse
from heliograph.fusion.mesh.gains import Believed, Weights
from heliograph.numerics.types import Float

Shared = tuple[Float[jax.Array, " degree"], Float[jax.Array, "n n"]]  # shares pi, and (sum_j pi_j P_j^-1)^-1


def equal_shares(believed: Believed) -> Shared:
    """Return one share for each estimate that arrived."""
    present = believed.present.astype(believed.traces.dtype)
    return intersected(believed, present / present.sum())


def trace_shares(believed: Believed, power: float, improvements: int) -> Shared:
    """Return shares proportional to (tr P_j)^-power, or equal where these give the smaller trace; then improved.

    The first alone ignore a neighbour of large variance who alone knows a mode. An improvement multiplies each share by
    the root of tr(P J_j P) / tr P, P = (sum pi J)^-1, which is 1 at the minimum where the share is positive.

    Source: Silvey, Titterington and Torsney, An algorithm for optimal designs on a finite design space (1978).
    """
    # Relative to the smallest trace that arrived, so that no power overflows.
    least = jnp.min(jnp.where(believed.present, believed.traces, jnp.inf))
    powers = jnp.where(believed.present, (least / believed.traces) ** power, 0.0)
    equal = equal_shares(believed)
    best = _better(intersected(believed, powers / powers.sum()), equal)
    # A share of zero stays zero, so start inside.
    shares = (best[0] + equal[0]) / 2
    for _ in range(improvements):
        covariance = intersected(believed, shares)[1]
        push = jnp.einsum("ab,jbc,ca->j", covariance, believed.information, covariance) / jnp.trace(covariance)
        shares = shares * jnp.sqrt(jnp.maximum(push, 0.0))
        shares = shares / shares.sum()
        best = _better(best, intersected(believed, shares))
    return best


def intersected(believed: Believed, shares: Float[jax.Array, " degree"]) -> Shared:
    """Return the shares with the covariance (sum_j pi_j P_j^-1)^-1 of their intersection."""
    return shares, inverse(jnp.einsum("j,jab->ab", shares, believed.information))


def intersection_weights(believed: Believed, shared: Shared) -> Weights:
    """Weights C_j = Pc pi_j P_j^-1 and Pc."""
    shares, covariance = shared
    return Weights(covariance, shares[:, None, None] * believed.information, covariance)


def _better(a: Shared, b: Shared) -> Shared:
    """Return those shares whose intersection has the smaller trace."""
    smaller = jnp.trace(a[1]) <= jnp.trace(b[1])
    return jnp.where(smaller, a[0], b[0]), jnp.where(smaller, a[1], b[1])
