"""Best linear unbiased weights of the estimates that arrived, from the joint covariance of all neighbours' errors."""

import jax
import jax.numpy as jnp

from heliograph.fusion.intersection import inverse
from heliograph.numerics.lapack import regular_solve
from heliograph.numerics.linalg import add, diagonal_of, identity, psd_solve, solve, symmetric
from heliograph.numerics.over_runs import runs_last
from heliograph.numerics.types import Bool, Float

SHORT = 24  # unknowns of equations that are solved side by side
RIDGE = 1e-8  # of a variance: independent error that each estimate is taken to have on top of its own


def arrived_weights(
    joint: Float[jax.Array, "degree n degree n"], present: Bool[jax.Array, " degree"]
) -> Float[jax.Array, "n degree n"]:
    """Weights C (n, degree, n), sum_j C_j = I, of least C P C' for those that are `present`, zero for the others.

    C = (E' U^-1 E)^-1 E' U^-1, E = [I; ...; I], U = P + RIDGE D, D the mean of the variances: the best weights of
    estimates with a little independent error more. Without it weights of nearly equal estimates, such as those of the
    first steps, grow without bound, and rounding with them. C P C' is the covariance whatever C is.
    """
    degree, n = joint.shape[:2]
    there = present.astype(joint.dtype)
    # In units of the deviations, absent ones apart.
    variances = jnp.einsum("iaia,i->a", joint, there) / there.sum()
    unit = jnp.sqrt(jnp.where(variances > 0, variances, 1.0))
    both = there[:, None, None, None] * there[None, None, :, None]
    scaled = (both * joint / (unit[:, None, None] * unit)).reshape(degree * n, degree * n)
    total = scaled + jnp.diag(jnp.repeat(jnp.where(present, RIDGE, 1.0), n))
    ones = (there[:, None, None] * jnp.eye(n)).reshape(degree * n, n)
    # U^-1 E, and what makes the weights sum to I.
    solved = psd_solve(total, ones) if degree * n <= SHORT else regular_solve(total, ones)
    weights = (inverse(ones.T @ solved) @ solved.T).reshape(n, degree, n)
    return unit[:, None, None] * weights / unit


def arrived_weights_by_component(
    joint: Float[jax.Array, "degree n degree n"], present: Bool[jax.Array, " degree"]
) -> Float[jax.Array, "n degree n"]:
    """Diagonal weights of those that are present: the best for each component of the state by itself."""
    degree, n = joint.shape[:2]
    if degree <= SHORT:
        return jnp.einsum("ia,ab->aib", component_weights(joint, present), jnp.eye(n))
    component = jnp.stack([joint[:, a, :, a] for a in range(n)])

    def single(block: jax.Array) -> jax.Array:
        return arrived_weights(block.reshape(degree, 1, degree, 1), present)[0, :, 0]

    return jnp.einsum("ai,ab->aib", jax.vmap(single)(component), jnp.eye(n))


@runs_last
def component_weights(
    joint: Float[jax.Array, "degree n degree n *#runs"], present: Bool[jax.Array, "degree *#runs"]
) -> Float[jax.Array, "degree n *#runs"]:
    """Diagonals c_i of the weights of each component by itself.

    Of one component, c = U^-1 1 / 1' U^-1 1 over those that are present, by the factor of U, as `arrived_weights`.
    """
    degree, n = joint.shape[:2]
    there = present.astype(joint.dtype)[:, None]
    # U of all components side by side, with those that are absent apart.
    component = jnp.stack([joint[:, a, :, a] for a in range(n)], axis=2)
    # Library sums, which the compiler does not repeat in everything that uses them.
    mean = jnp.sum(there * diagonal_of(component) / jnp.sum(there, axis=0), axis=0)
    apart = jnp.where(there > 0, RIDGE * jnp.where(mean > 0, mean, 1.0), 1.0)
    total = there[:, None] * there * component + identity(degree, component) * apart[:, None]
    solved = solve(total, (there * jnp.ones_like(mean))[:, None])[:, 0]
    return solved / jnp.sum(solved, axis=0)


@runs_last
def weighted_by_component(
    weights: Float[jax.Array, "degree n *#runs"], joint: Float[jax.Array, "degree n degree n *#runs"]
) -> Float[jax.Array, "n n *#runs"]:
    """Covariance C P C' of diagonal weights, a sum over senders at a time."""
    sums = add([joint[:, :, j] * weights[j] for j in range(len(weights))])
    return symmetric(add([w[:, None] * s for w, s in zip(weights, sums, strict=True)]))


def arrived_scalar_weights(
    joint: Float[jax.Array, "degree n degree n"], present: Bool[jax.Array, " degree"]
) -> Float[jax.Array, "n degree n"]:
    """One number for each of those that are present, of least trace."""
    degree, n = joint.shape[:2]
    traces = jnp.einsum("iaja->ij", joint)
    single = arrived_weights(traces.reshape(degree, 1, degree, 1), present)[0, :, 0]
    return jnp.einsum("i,ab->aib", single, jnp.eye(n))
