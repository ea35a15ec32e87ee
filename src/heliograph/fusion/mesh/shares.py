"""Shares of covariance intersection between neighbours: from what arrived and its covariances alone."""

import jax
import jax.numpy as jnp

from heliograph.fusion.intersection import inverse
from heliograph.fusion.mesh.gains import Believed
from heliograph.numerics.types import Float


def equal_shares(believed: Believed) -> Float[jax.Array, " degree"]:
    """One share for each estimate that arrived."""
    present = believed.present.astype(believed.covariance.dtype)
    return present / present.sum()


def trace_shares(believed: Believed, power: float, improvements: int) -> Float[jax.Array, " degree"]:
    """Shares proportional to (tr P_j)^-power, or equal ones where these give the smaller trace; then improved.

    The first alone ignore a neighbour of large variance who alone knows a mode. An improvement multiplies each share by
    the root of tr(P J_j P) / tr P, P = (sum pi J)^-1, which is 1 at the minimum where the share is positive.

    Source: Silvey, Titterington and Torsney, An algorithm for optimal designs on a finite design space (1978).
    """
    traces = jnp.trace(believed.covariance, axis1=1, axis2=2)
    # Relative to the smallest trace that arrived, so that no power overflows.
    least = jnp.min(jnp.where(believed.present, traces, jnp.inf))
    ratio = jnp.where(believed.present, least / jnp.where(believed.present, traces, 1.0), 0.0)
    first = jnp.where(believed.present, ratio**power, 0.0)
    best = _better(believed, first / first.sum(), equal_shares(believed))
    # A share that has left the support stays out of it, so start inside.
    shares = (best + equal_shares(believed)) / 2 if improvements else best
    for _ in range(improvements):
        covariance = intersected(believed, shares)
        push = jnp.einsum("ab,jbc,ca->j", covariance, believed.information, covariance) / jnp.trace(covariance)
        shares = shares * jnp.sqrt(jnp.maximum(push, 0.0))
        shares = shares / shares.sum()
        best = _better(believed, best, shares)
    return best


def intersected(believed: Believed, shares: Float[jax.Array, " degree"]) -> Float[jax.Array, "n n"]:
    """(sum_j pi_j P_j^-1)^-1."""
    result: jax.Array = inverse(jnp.einsum("j,jab->ab", shares, believed.information))
    return result


def intersection_weights(
    believed: Believed, shares: Float[jax.Array, " degree"]
) -> tuple[Float[jax.Array, "degree n n"], Float[jax.Array, "n n"]]:
    """C_j = Pc pi_j P_j^-1 and Pc."""
    covariance = intersected(believed, shares)
    return covariance @ (shares[:, None, None] * believed.information), covariance


def _better(believed: Believed, a: jax.Array, b: jax.Array) -> jax.Array:
    """Return those shares whose fused covariance has the smaller trace."""
    smaller = jnp.trace(intersected(believed, a)) <= jnp.trace(intersected(believed, b))
    return jnp.where(smaller, a, b)
