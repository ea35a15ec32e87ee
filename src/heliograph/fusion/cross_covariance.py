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
    """Plant over one step, x- = A x + b + w with Q = Cov w: matrix A (n, n), offset b (n,), noise Q (n, n)."""

    matrix: Float[Array, "n n"]
    offset: Float[Array, " n"]
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
        x = columns[:n].reshape(n, -1)
        e = columns[n:].reshape(nodes, n, -1)
        e_after = self.errors @ e + self.of_state @ x
        x_after = self.plant @ x
        return jnp.concatenate([x_after, e_after.reshape(nodes * n, -1)]).reshape(columns.shape)


class ErrorStep(NamedTuple):
    """One step of the plant and of the nodes' errors, zeta+ = F zeta + f + B w - K nu, w and nu uncorrelated.

    Shapes: transition F, offset f (N,), noise_input B (N, n), process Q = Cov w (n, n), gain K (node, n, m), received
    E[nu_i nu_j'] (node, m, node, m), or (node, m, m) where nodes share nothing.
    """

    transition: ErrorMap
    offset: Float[jax.Array, " N"]
    noise_input: Float[jax.Array, "N n"]
    process: Float[Array, "n n"]
    gain: Float[jax.Array, "node n m"]
    received: Array

    def noise(self) -> Float[jax.Array, "N N"]:
        """Return B Q B' + K E[nu nu'] K', the covariance of what the step adds to (x, e_1, ..., e_nodes).

        Q: process noise, which enters by B = `self.noise_input`. nu: noise in what nodes receive. K: the nodes' gains.
        `self.received` is E[nu nu'], with a block for each node if they share nothing.
        """
        nodes, n, _ = self.gain.shape
        if self.received.ndim == 4:
            by_received = jnp.einsum("iam,imjl,jbl->iajb", self.gain, self.received, self.gain)
        else:
            numbers = jnp.arange(nodes)
            blocks = symmetrize(propagate_by_mode(self.gain, self.received, 0.0))
            by_received = jnp.zeros((nodes, n, nodes, n)).at[numbers, :, numbers, :].set(blocks)
        padded = jnp.pad(by_received.reshape(nodes * n, nodes * n), ((n, 0), (n, 0)))  # it does not reach x
        return jnp.asarray(propagate_by_mode(self.noise_input, self.process, padded))


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
    """Return the step of the errors e = x - m of linear filters, whose models may be wrong.

    A fusion that weighs several nodes' estimates needs the covariances between their errors. x+ = A x + b + w is the
    true `motion`, and z = M x+ + o + nu the number that a node receives (`observation`). Its filter predicts by F m + f
    and corrects by K (z - C m - c), m the prediction; `filters` has a leading axis of nodes. With U = I - K C and
    L = K (M - C):

      e+ = U F e + [U (A - F) - L A] x + [U (b - f) - L b - K (o - c)] + (U - L) w - K nu.

    A difference of two nearly equal matrices, such as A - F, is taken for 0 if it is rounding.
    """
    # K, U and L, where M - C is the error of the filter's model of the measurement.
    gain = jnp.asarray(filters.gain)
    u = filters.error_transition()
    n = len(motion.offset)
    wrong_gain = gain @ _subtract_without_rounding(observation.gain, filters.output)
    # A - F and b - f, then U (b - f) - L b - K (o - c).
    matrices = _subtract_without_rounding(jnp.broadcast_to(motion.matrix, filters.transition.shape), filters.transition)
    drifts = _subtract_without_rounding(jnp.broadcast_to(motion.offset, filters.drift.shape), filters.drift)
    offset = _multiply_by_node(u, drifts) - wrong_gain @ jnp.asarray(motion.offset)
    offset = offset - _multiply_by_node(gain, _subtract_without_rounding(observation.offset, filters.offset))
    of_state = u @ matrices - wrong_gain @ motion.matrix  # U (A - F) - L A
    return ErrorStep(
        transition=ErrorMap(plant=motion.matrix, of_state=of_state, errors=u @ filters.transition),
        offset=jnp.concatenate([jnp.asarray(motion.offset), offset.reshape(-1)]),
        noise_input=jnp.concatenate([jnp.eye(n), (u - wrong_gain).reshape(-1, n)]),
        process=motion.noise,
        gain=gain,
        received=observation.noise,
    )


def propagate_state(
    mean: Float[jax.Array, " n"], covariance: Float[jax.Array, "n n"], motion: Motion
) -> tuple[Float[jax.Array, " n"], Float[jax.Array, "n n"]]:
    """Return E x and Cov x after a step x+ = A x + offset + w, with A = `motion.matrix` and Cov w = `motion.noise`."""
    matrix = jnp.asarray(motion.matrix)
    mean_after = matrix @ mean + motion.offset
    covariance_after = symmetric(propagate_by_mode(matrix, covariance, motion.noise))
    return mean_after, covariance_after


def propagate_errors_jointly(errors: ErrorMoments, step: ErrorStep) -> ErrorMoments:
    """Return moments after a step, P_ij+ = T_i P_ij T_j' + B_i Q B_j' + K_i S_ij K_j' and effects of a wrong model.

    `errors` has the mean and covariance of zeta = (x, e_1, ..., e_nodes). Q: process noise. S_ij: noise that nodes
    share. K_i: gain of node i.
    """
    mean = step.transition @ errors.mean.reshape(-1) + step.offset
    covariance = symmetric(propagate_by_mode(step.transition, errors.covariance, step.noise()))
    return ErrorMoments(mean.reshape(errors.mean.shape), covariance)


class ErrorSources(NamedTuple):
    """Errors by their sources, e_i = shared_i s + a_i: s is common to all, Cov s = I, and each a_i independent.

    Shapes: shared (node, n, sources), independent Cov a_i (node, n, n).
    """

    shared: Float[Array, "node n sources"]
    independent: Float[Array, "node n n"]

    def covariances(self) -> Float[Array, "node n n"]:
        """Return Cov e_i = R_i R_i' + Cov a_i of each node (node, n, n), with R_i = `shared`_i."""
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
        """Root R of the plant's state x = E x + R s (n, sources), so that Cov x = R R'.

        The sources s are independent numbers of variance 1: those of x_0 and of the noise of each step. R is the first
        n rows of `self.roots`.
        """
        return self.roots[: self.mean.shape[1]]

    @property
    def errors(self) -> ErrorSources:
        """The nodes' errors without their means: e_i = R_i s and an independent part, with R_i from `self.roots`.

        The sources s are independent numbers of variance 1. The first n rows of `self.roots` are those of the plant.
        """
        n = self.mean.shape[1]
        return ErrorSources(self.roots[n:].reshape(-1, n, self.roots.shape[1]), self.independent)


def make_initial_factors(errors: ErrorMoments, sources: int) -> SourceFactors:
    """Return zeta = (x, e_1, ..., e_nodes) before the first step as its mean plus roots times independent sources.

    Sources are independent numbers of variance 1. At the start they are the n of x_0, and each error deviates from its
    mean as x_0 does. The roots have `sources` further columns, zero until steps fill them with their noises.
    """
    nodes, n = errors.bias.shape
    state_root = jnp.zeros((n, n + sources)).at[:, :n].set(cholesky(errors.state_covariance))
    return SourceFactors(
        mean=errors.mean, roots=jnp.tile(state_root, (1 + nodes, 1)), independent=jnp.zeros((nodes, n, n))
    )


def propagate_factors(factors: SourceFactors, step: ErrorStep, k: jax.Array) -> SourceFactors:
    """Propagate zeta = (x, e_1, ..., e_nodes) over step k, zeta+ = F zeta + f + B w - K nu, as roots times sources.

    Sources are independent numbers of variance 1 that errors share. Step k adds those of the process noise w, and those
    of the measurement noise nu where nodes share it (`step.received` of 4 axes). Otherwise K_i nu_i adds to the
    independent part of node i's error.
    """
    nodes, n, m = step.gain.shape
    new_roots = step.noise_input @ cholesky(jnp.asarray(step.process))
    independent_noise = jnp.zeros(())
    if step.received.ndim == 4:
        # Factors of -K nu, whose rows stand below those of x.
        root = cholesky(jnp.asarray(step.received).reshape(nodes * m, nodes * m)).reshape(nodes, m, nodes * m)
        measurement_roots = (-step.gain @ root).reshape(nodes * n, -1)
        new_roots = jnp.concatenate([new_roots, jnp.pad(measurement_roots, ((n, 0), (0, 0)))], axis=1)
    else:
        independent_noise = propagate_by_mode(step.gain, step.received, 0.0)
    mean = step.transition @ factors.mean.reshape(-1) + step.offset
    # Columns of the roots: n for x_0, then those of step 0, of step 1, ...
    first_new_column = n + new_roots.shape[1] * k
    roots = jax.lax.dynamic_update_slice(step.transition @ factors.roots, new_roots, (0, first_new_column))
    independent = symmetrize(propagate_by_mode(step.transition.errors, factors.independent, independent_noise))
    return SourceFactors(mean.reshape(factors.mean.shape), roots, independent)


def _subtract_without_rounding(a: Array, b: Array) -> jax.Array:
    """Return a - b, zero where it is rounding, so that a filter with the right model has no error that depends on x."""
    a, b = jnp.asarray(a), jnp.asarray(b)
    return jnp.where(jnp.abs(a - b) <= rounding(SAME, a) * (jnp.abs(a) + jnp.abs(b)), 0.0, a - b)


def _multiply_by_node(matrix: Array, vector: Array) -> jax.Array:
    """Return matrix_i vector_i for each node i: (node, n, m) and (node, m) -> (node, n)."""
    return jnp.einsum("iab,ib->ia", matrix, vector)
