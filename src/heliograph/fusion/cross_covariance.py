"""Cross-covariances of the errors of local linear filters, before any data: they share the plant, and perhaps more.

Filter i predicts m- = F m + f and corrects m = m- + K (z - C m- - c), whatever its model. The world moves
x- = A x + b + w, and the filter receives z = M x- + o + nu. With e = x - m, U = I - K C and L = K (M - C):

  e+ = U F e + [U (A - F) - L A] x + [U (b - f) - L b - K (o - c)] + (U - L) w - K nu.

Where the filter's model is the world, the second and third term vanish: e+ = (I - K H)(A e + w) - K nu.
So zeta = (x, e_1, ..., e_nodes), N = (1 + nodes) n numbers, follows one linear step, zeta+ = F zeta + f + B w - K nu.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.linear.precomputed_filter import LinearStep
from heliograph.linear.jump_system import propagate_by_mode
from heliograph.numerics.linalg import cholesky, rounding, symmetric, symmetrize
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Array, Float

SAME = 1e-13  # relative difference of two numbers that are the same but for the rounding of a few products


class Motion(NamedTuple):
    """Plant over one step, x- = A x + b + w with Q = Cov w: matrix A (n, n), shift b (n,), noise Q (n, n)."""

    matrix: Float[Array, "n n"]
    shift: Float[Array, " n"]
    noise: Float[Array, "n n"]


class JointObservation(NamedTuple):
    """Measurements of all nodes after a step, z_i = M_i x + o_i + nu_i; rows that a node lacks are zero.

    Shapes: gain M (node, m, n), offset o (node, m); noise E[nu_i nu_j'] (node, m, node, m), or (node, m, m) where nodes
    share nothing.
    """

    gain: Float[Array, "node m n"]
    offset: Float[Array, "node m"]
    noise: Array


class ErrorMap(NamedTuple):
    """Linear map of zeta = (x, e_1, ..., e_nodes): x+ = A x and e_i+ = G_i x + T_i e_i. `F @ columns` applies it.

    It costs nodes n^2 a column, where a matrix costs N^2. Shapes: plant A (n, n), of_state G and errors T (node, n, n).
    """

    plant: Float[Array, "n n"]
    of_state: Float[jax.Array, "node n n"]
    errors: Float[jax.Array, "node n n"]

    def __matmul__(self, columns: Float[Array, "N *columns"]) -> Float[jax.Array, "N *columns"]:
        """Return F zeta for each column zeta = (x, e_1, ..., e_nodes).

        The plant moves x. An error moves by itself, and under a wrong model also by x (`self.of_state`).
        """
        nodes, n, _ = self.errors.shape
        x, e = columns[:n].reshape(n, -1), columns[n:].reshape(nodes, n, -1)
        e_after = self.errors @ e + self.of_state @ x
        x_after = self.plant @ x
        return jnp.concatenate([x_after, e_after.reshape(nodes * n, -1)]).reshape(columns.shape)


class ErrorStep(NamedTuple):
    """One step of the plant and of the nodes' errors, zeta+ = F zeta + f + B w - K nu, w and nu uncorrelated.

    Shapes: transition F, shift f (N,), of_noise B (N, n), process Q = Cov w (n, n), gain K (node, n, m), received
    E[nu_i nu_j'] (node, m, node, m), or (node, m, m) where nodes share nothing.
    """

    transition: ErrorMap
    shift: Float[jax.Array, " N"]
    of_noise: Float[jax.Array, "N n"]
    process: Float[Array, "n n"]
    gain: Float[jax.Array, "node n m"]
    received: Array

    def noise(self) -> Float[jax.Array, "N N"]:
        """Return B Q B' + K E[nu nu'] K', the covariance of what the step adds to (x, e_1, ..., e_nodes).

        Q: process noise. nu: noise in what nodes receive. K: the nodes' gains. `self.received` is E[nu nu'], with a
        block for each node if they share nothing.
        """
        nodes, n, _ = self.gain.shape
        if self.received.ndim == 4:
            by_received = jnp.einsum("iam,imjl,jbl->iajb", self.gain, self.received, self.gain)
        else:
            numbers, blocks = jnp.arange(nodes), symmetrize(propagate_by_mode(self.gain, self.received, 0.0))
            by_received = jnp.zeros((nodes, n, nodes, n)).at[numbers, :, numbers, :].set(blocks)
        padded = jnp.pad(by_received.reshape(nodes * n, nodes * n), ((n, 0), (n, 0)))  # it does not reach x
        return jnp.asarray(propagate_by_mode(self.of_noise, self.process, padded))


class ErrorMoments(NamedTuple):
    """Moments of zeta = (x, e_1, ..., e_nodes), of the plant's state and the errors e_i = x - m_i, before any data.

    Shapes: mean (1 + node, n), covariance (N, N).
    """

    mean: Float[jax.Array, "nodes1 n"]
    covariance: Float[jax.Array, "N N"]

    @property
    def state_mean(self) -> Float[jax.Array, " n"]:
        """Mean E x of the plant's state."""
        return self.mean[0]

    @property
    def state_covariance(self) -> Float[jax.Array, "n n"]:
        """Covariance Cov x of the plant's state."""
        n = self.mean.shape[1]
        return self.covariance[:n, :n]

    @property
    def bias(self) -> Float[jax.Array, "node n"]:
        """Mean error E e_i of each node's estimate."""
        return self.mean[1:]

    @property
    def with_state(self) -> Float[jax.Array, "node n n"]:
        """Cross-covariance Cov(e_i, x) of each node's error with the state."""
        n = self.mean.shape[1]
        return self.covariance[n:, :n].reshape(-1, n, n)

    @property
    def joint(self) -> Float[jax.Array, "node n node n"]:
        """Covariance Cov(e_i, e_j) of all pairs of nodes' errors."""
        nodes, n = self.bias.shape
        return self.covariance[n:, n:].reshape(nodes, n, nodes, n)


def make_initial_errors(
    mean: Float[Array, " n"], covariance: Float[Array, "n n"], starts: Float[Array, "node n"]
) -> ErrorMoments:
    """Return the moments before the first step, when filters start at known means (`starts`).

    The state x and all errors x - start then have the covariance of x_0, and are fully correlated.
    """
    mean, starts = jnp.asarray(mean), jnp.asarray(starts)
    count = 1 + len(starts)  # the state itself, and the error of each node
    means = jnp.concatenate([mean[None], mean - starts])
    return ErrorMoments(means, jnp.tile(covariance, (count, count)))


def make_error_step(filters: LinearStep, motion: Motion, observation: JointObservation) -> ErrorStep:
    """Return the step of the errors of linear filters; `filters` has a leading axis of nodes."""
    # K, U = I - K C and L = K (M - C) of each node, with the letters of the first lines of this file.
    gain, keep, n = jnp.asarray(filters.gain), filters.error_transition(), len(motion.shift)
    wrong_gain = gain @ _subtract_without_rounding(observation.gain, filters.output)
    # A - F, and U (b - f) - L b - K (o - c).
    matrices = _subtract_without_rounding(jnp.broadcast_to(motion.matrix, filters.transition.shape), filters.transition)
    drifts = _subtract_without_rounding(jnp.broadcast_to(motion.shift, filters.drift.shape), filters.drift)
    shift = _multiply_by_node(keep, drifts) - wrong_gain @ jnp.asarray(motion.shift)
    shift = shift - _multiply_by_node(gain, _subtract_without_rounding(observation.offset, filters.offset))
    of_state = keep @ matrices - wrong_gain @ motion.matrix
    return ErrorStep(
        transition=ErrorMap(motion.matrix, of_state, keep @ filters.transition),
        shift=jnp.concatenate([jnp.asarray(motion.shift), shift.reshape(-1)]),
        of_noise=jnp.concatenate([jnp.eye(n), (keep - wrong_gain).reshape(-1, n)]),
        process=motion.noise,
        gain=gain,
        received=observation.noise,
    )


def propagate_state(
    mean: Float[jax.Array, " n"], covariance: Float[jax.Array, "n n"], motion: Motion
) -> tuple[Float[jax.Array, " n"], Float[jax.Array, "n n"]]:
    """Return E x and Cov x after a step x+ = A x + shift + w, with A = `motion.matrix` and Cov w = `motion.noise`."""
    matrix = jnp.asarray(motion.matrix)
    mean_after = matrix @ mean + motion.shift
    covariance_after = symmetric(propagate_by_mode(matrix, covariance, motion.noise))
    return mean_after, covariance_after


def propagate_errors_jointly(errors: ErrorMoments, step: ErrorStep) -> ErrorMoments:
    """Return moments after a step, P_ij+ = T_i P_ij T_j' + B_i Q B_j' + K_i S_ij K_j' and effects of a wrong model.

    `errors` has the mean and covariance of zeta = (x, e_1, ..., e_nodes). Q: process noise. S_ij: noise that nodes
    share. K_i: gain of node i.
    """
    mean = step.transition @ errors.mean.reshape(-1) + step.shift
    covariance = symmetric(propagate_by_mode(step.transition, errors.covariance, step.noise()))
    return ErrorMoments(mean.reshape(errors.mean.shape), covariance)


class ErrorSources(NamedTuple):
    """Errors by their sources, e_i = shared_i s + a_i: s is common to all, Cov s = I, and each a_i independent.

    Shapes: shared (node, n, sources), independent Cov a_i (node, n, n).
    """

    shared: Float[Array, "node n sources"]
    independent: Float[Array, "node n n"]

    def covariances(self) -> Float[Array, "node n n"]:
        """Return Cov e_i of each node, by its sources and its own part."""
        return self.shared @ self.shared.swapaxes(-1, -2) + self.independent

    def joint(self) -> Float[Array, "node n node n"]:
        """Return Cov(e_i, e_j) of all pairs of errors.

        e_i is `self.shared`_i times common sources of variance 1, plus an own part of covariance `self.independent`_i.
        """
        count, n, _ = self.shared.shape
        roots = self.shared.reshape(count * n, -1)
        of_independent = np.eye(count)[:, None, :, None] * self.independent[:, :, None]
        of_shared = (roots @ roots.T).reshape(count, n, count, n)
        return of_shared + of_independent

    def weigh(self, weights: Float[Array, "n node n"]) -> tuple[Float[Array, "n sources"], Float[Array, "n n"]]:
        """Return the weighted error W e, as its factor of common sources and the covariance of its independent part.

        e_i is `self.shared`_i times common sources of variance 1, plus an own part of covariance `self.independent`_i.
        """
        xp = library(weights, *self)
        independent = xp.einsum("aib,ibc,dic->ad", weights, self.independent, weights)
        return xp.tensordot(weights, self.shared, axes=2), independent


class SourceFactors(NamedTuple):
    """Moments of zeta by their sources: zeta = E zeta + roots s + (0, a_1, ..., a_nodes), Cov s = I.

    s are x_0 and the process noise of each step, and the channels' noise where nodes share it; a_i is independent, of
    covariance independent_i. A step costs in proportion to the nodes, not to pairs of them.

    Shapes: mean (1 + node, n), roots (N, sources), independent (node, n, n).
    """

    mean: Float[jax.Array, "nodes1 n"]
    roots: Float[jax.Array, "N sources"]
    independent: Float[jax.Array, "node n n"]

    @property
    def state(self) -> Float[Array, "n sources"]:
        """Deviation of x from its mean, by the sources that cause it."""
        return self.roots[: self.mean.shape[1]]

    @property
    def errors(self) -> ErrorSources:
        """Errors by their sources, without their means."""
        n = self.mean.shape[1]
        return ErrorSources(self.roots[n:].reshape(-1, n, self.roots.shape[1]), self.independent)


def make_initial_factors(errors: ErrorMoments, sources: int) -> SourceFactors:
    """Return the factors before the first step, with room for `sources` more; the only sources are those of x_0.

    zeta = (x, errors of nodes) is its mean plus roots times the sources, which are independent numbers of variance 1.
    """
    nodes, n = errors.bias.shape
    state = jnp.zeros((n, n + sources)).at[:, :n].set(cholesky(errors.state_covariance))
    return SourceFactors(errors.mean, jnp.tile(state, (1 + nodes, 1)), jnp.zeros((nodes, n, n)))


def propagate_factors(factors: SourceFactors, step: ErrorStep, k: jax.Array) -> SourceFactors:
    """Propagate factors over step k: s gets the process noise, and the measurement noise where nodes share it."""
    nodes, n, m = step.gain.shape
    new_roots, added = step.of_noise @ cholesky(jnp.asarray(step.process)), jnp.zeros(())
    # Shared measurement noise is a source, independent noise stays the node's.
    if step.received.ndim == 4:
        root = cholesky(jnp.asarray(step.received).reshape(nodes * m, nodes * m)).reshape(nodes, m, nodes * m)
        measured = (-step.gain @ root).reshape(nodes * n, -1)
        new_roots = jnp.concatenate([new_roots, jnp.pad(measured, ((n, 0), (0, 0)))], axis=1)
    else:
        added = propagate_by_mode(step.gain, step.received, 0.0)
    # The new sources of step k go to columns of their own, behind those of x_0 and of the steps before.
    mean = step.transition @ factors.mean.reshape(-1) + step.shift
    roots = jax.lax.dynamic_update_slice(step.transition @ factors.roots, new_roots, (0, n + new_roots.shape[1] * k))
    independent = symmetrize(propagate_by_mode(step.transition.errors, factors.independent, added))
    return SourceFactors(mean.reshape(factors.mean.shape), roots, independent)


def _subtract_without_rounding(a: Array, b: Array) -> jax.Array:
    """Return a - b, zero where it is rounding, so that a filter with the right model has no error that depends on x."""
    a, b = jnp.asarray(a), jnp.asarray(b)
    return jnp.where(jnp.abs(a - b) <= rounding(SAME, a) * (jnp.abs(a) + jnp.abs(b)), 0.0, a - b)


def _multiply_by_node(matrix: Array, vector: Array) -> jax.Array:
    """Return the product of matrix and vector for each node."""
    return jnp.einsum("iab,ib->ia", matrix, vector)
