"""Cross-covariances of the errors of local linear filters, before any data: they share the plant, and perhaps more.

Filter i predicts m- = F m + f and corrects m = m- + K (z - C m- - c), whatever its model. The world moves
x- = A x + b + w, and the filter receives z = M x- + o + nu. With e = x - m, U = I - K C and L = K (M - C):

  e+ = U F e + [U (A - F) - L A] x + [U (b - f) - L b - K (o - c)] + (U - L) w - K nu.

Where the filter's model is the world, the second and third term vanish: e+ = (I - K H)(A e + w) - K nu.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.linear.plan import LinearStep
from heliograph.numerics.linalg import cholesky, rounding, symmetric, symmetrize
from heliograph.numerics.traced import library
from heliograph.numerics.types import Array, Float

SAME = 1e-13  # relative: two matrices that say the same after a few products


class Motion(NamedTuple):
    """Plant over one step, x- = A x + b + w with Q = Cov w: matrix A (n, n), shift b (n,), noise Q (n, n)."""

    matrix: Float[Array, "n n"]
    shift: Float[Array, " n"]
    noise: Float[Array, "n n"]


class Observation(NamedTuple):
    """Measurements of all nodes after a step, z_i = M_i x + o_i + nu_i; rows that a node lacks are zero.

    Shapes: gain M (node, m, n), offset o (node, m); noise E[nu_i nu_j'] (node, m, node, m), or (node, m, m) where nodes
    share nothing.
    """

    gain: Float[Array, "node m n"]
    offset: Float[Array, "node m"]
    noise: Array


class Errors(NamedTuple):
    """Moments of the plant's state x and of the errors e_i = x - m_i, before any data.

    mean E x and covariance Cov x; bias E e_i; with_state Cov(e_i, x); joint Cov(e_i, e_j).
    """

    mean: Float[jax.Array, " n"]
    covariance: Float[jax.Array, "n n"]
    bias: Float[jax.Array, "node n"]
    with_state: Float[jax.Array, "node n n"]
    joint: Float[jax.Array, "node n node n"]


class ErrorStep(NamedTuple):
    """Recursion of the errors, e+ = transition e + of_state x + drift + of_noise w - gain nu, for each node."""

    transition: Float[jax.Array, "node n n"]
    of_state: Float[jax.Array, "node n n"]
    drift: Float[jax.Array, "node n"]
    of_noise: Float[jax.Array, "node n n"]
    gain: Float[jax.Array, "node n m"]


def initial_errors(mean: Float[Array, " n"], covariance: Float[Array, "n n"], starts: Float[Array, "node n"]) -> Errors:
    """Moments before the first step: every filter starts at a known mean, so all errors are x_0 up to a constant."""
    mean, covariance, starts = jnp.asarray(mean), jnp.asarray(covariance), jnp.asarray(starts)
    nodes, n = starts.shape
    values = jnp.broadcast_to(covariance, (nodes, n, n))
    joint = jnp.broadcast_to(covariance[None, :, None, :], (nodes, n, nodes, n))
    return Errors(mean, covariance, mean - starts, values, joint)


def error_step(filters: LinearStep, motion: Motion, observation: Observation) -> ErrorStep:
    """Recursion of the errors of linear filters; `filters` has a leading axis of nodes."""
    gain, keep = jnp.asarray(filters.gain), filters.keep()
    astray = gain @ _difference(observation.gain, filters.output)
    moves = _difference(jnp.broadcast_to(motion.matrix, filters.transition.shape), filters.transition)
    shifts = _difference(jnp.broadcast_to(motion.shift, filters.drift.shape), filters.drift)
    drift = _times(keep, shifts) - astray @ jnp.asarray(motion.shift)
    return ErrorStep(
        transition=keep @ filters.transition,
        of_state=keep @ moves - astray @ motion.matrix,
        drift=drift - _times(gain, _difference(observation.offset, filters.offset)),
        of_noise=keep - astray,
        gain=gain,
    )


def propagate_state(
    mean: Float[jax.Array, " n"], covariance: Float[jax.Array, "n n"], motion: Motion
) -> tuple[Float[jax.Array, " n"], Float[jax.Array, "n n"]]:
    """E x and Cov x after the step."""
    matrix = jnp.asarray(motion.matrix)
    return matrix @ mean + motion.shift, symmetric(matrix @ covariance @ matrix.T + motion.noise)


def advance(errors: Errors, step: ErrorStep, motion: Motion, noise: Array) -> Errors:
    """Propagate all pairs: P_ij+ = T_i P_ij T_j' + B_i Q B_j' + K_i S_ij K_j', plus the terms of a wrong model."""
    nodes, n = errors.bias.shape
    mean, covariance = propagate_state(errors.mean, errors.covariance, motion)
    bias = _times(step.transition, errors.bias) + step.of_state @ errors.mean + step.drift
    # Cov(e+, x+): the errors depend on x where a filter's model is wrong.
    carried = step.transition @ errors.with_state  # Cov(T e, x)
    of_state = step.of_state @ errors.covariance
    of_noise = step.of_noise @ motion.noise
    moved = (carried + of_state) @ jnp.asarray(motion.matrix).T + of_noise
    # Terms of x and w in Cov(e_i+, e_j+), as one product of all nodes.
    left = jnp.concatenate([carried + of_state, step.of_state, of_noise], axis=-1).reshape(nodes * n, -1)
    right = jnp.concatenate([step.of_state, carried, step.of_noise], axis=-1).reshape(nodes * n, -1)
    # T_i P_ij T_j'.
    once = jnp.einsum("iab,ibc->iac", step.transition, errors.joint.reshape(nodes, n, -1)).reshape(nodes * n, -1)
    both = jnp.einsum("iab,ibc->iac", step.transition, once.T.reshape(nodes, n, -1)).reshape(nodes * n, -1)
    measured = observation_noise(step.gain, noise).reshape(nodes * n, -1)
    joint = symmetric(both + left @ right.T + measured).reshape(nodes, n, nodes, n)
    return Errors(mean, covariance, bias, moved, joint)


class Factors(NamedTuple):
    """Moments of the errors by their sources: x = E x + state s, e_i = E e_i + shared_i s + a_i, Cov s = I.

    s are x_0 and the process noise of each step, and the channels' noise where nodes share it; a_i is independent, of
    covariance independent_i. So Cov(e_i, e_j) = shared_i shared_j' + (independent_i if i is j): a step costs in
    proportion to the nodes, not to pairs of them.
    """

    mean: Float[jax.Array, " n"]
    state: Float[jax.Array, "n sources"]
    bias: Float[jax.Array, "node n"]
    shared: Float[jax.Array, "node n sources"]
    independent: Float[jax.Array, "node n n"]


def initial_factors(errors: Errors, sources: int) -> Factors:
    """Factors before the first step, with room for `sources` more: all is the deviation of x_0."""
    nodes, n = errors.bias.shape
    state = jnp.zeros((n, n + sources)).at[:, :n].set(cholesky(errors.covariance))
    shared = jnp.broadcast_to(state, (nodes, *state.shape))
    return Factors(errors.mean, state, errors.bias, shared, jnp.zeros((nodes, n, n)))


def advance_factors(factors: Factors, step: ErrorStep, motion: Motion, noise: Array, k: jax.Array) -> Factors:
    """Propagate over step k: s gets the process noise, and the measurement noise where nodes share it."""
    nodes, n = factors.bias.shape
    # x+ and e+ in terms of the sources so far.
    root = cholesky(jnp.asarray(motion.noise))
    state = jnp.asarray(motion.matrix) @ factors.state
    shared = step.transition @ factors.shared + step.of_state @ factors.state
    bias = _times(step.transition, factors.bias) + step.of_state @ factors.mean + step.drift
    moved = step.transition @ factors.independent @ jnp.swapaxes(step.transition, 1, 2)
    new = step.of_noise @ root
    # Shared measurement noise is a source, independent noise stays the node's.
    if noise.ndim == 4:
        m = noise.shape[1]
        received = cholesky(jnp.asarray(noise).reshape(nodes * m, nodes * m)).reshape(nodes, m, nodes * m)
        new = jnp.concatenate([new, -step.gain @ received], axis=-1)
        root = jnp.pad(root, ((0, 0), (0, nodes * m)))
    else:
        moved = symmetrize(moved + step.gain @ noise @ jnp.swapaxes(step.gain, 1, 2))
    # The new sources of step k go to columns of their own.
    column = n + new.shape[-1] * k
    return Factors(
        jnp.asarray(motion.matrix) @ factors.mean + motion.shift,
        jax.lax.dynamic_update_slice(state, root, (0, column)),
        bias,
        jax.lax.dynamic_update_slice(shared, new, (0, 0, column)),
        moved,
    )


def joint_of(shared: Array, independent: Array) -> Float[Array, "node n node n"]:
    """Cov(e_i, e_j) of all pairs, of errors e_i = shared_i s + a_i."""
    count, n, _ = shared.shape
    flat = shared.reshape(count * n, -1)
    apart = np.eye(count)[:, None, :, None] * independent[:, :, None]
    return (flat @ flat.T).reshape(count, n, count, n) + apart


def weigh_sources(weights: Array, shared: Array, independent: Array) -> tuple[Array, Array]:
    """Sources (n, sources) of a weighted sum of the errors, and the covariance (n, n) of its independent part."""
    jnp = library(weights, shared, independent)
    return jnp.tensordot(weights, shared, axes=2), jnp.einsum("aib,ibc,dic->ad", weights, independent, weights)


def observation_noise(gain: Float[jax.Array, "node n m"], noise: Array) -> Float[jax.Array, "node n node n"]:
    """K_i S_ij K_j', zero between nodes that share nothing."""
    if noise.ndim == 4:
        return jnp.einsum("iam,imjl,jbl->iajb", gain, noise, gain)
    nodes, n, _ = gain.shape
    items = jnp.arange(nodes)
    blocks = symmetrize(gain @ noise @ jnp.swapaxes(gain, 1, 2))
    return jnp.zeros((nodes, n, nodes, n)).at[items, :, items, :].set(blocks)


def _difference(a: Array, b: Array) -> jax.Array:
    """a - b, zero where it is rounding, so that a filter with the right model has no error that depends on x."""
    a, b = jnp.asarray(a), jnp.asarray(b)
    return jnp.where(jnp.abs(a - b) <= rounding(SAME, a) * (jnp.abs(a) + jnp.abs(b)), 0.0, a - b)


def _times(matrix: Array, vector: Array) -> jax.Array:
    """Product of matrix and vector for each node."""
    return jnp.einsum("iab,ib->ia", matrix, vector)
