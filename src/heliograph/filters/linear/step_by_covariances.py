"""A step of a linear filter: values by the factors of its covariances, derivatives by the covariances themselves.

Derivatives are by free parameters of the model. That of the factors L diag(d) L' costs two passes of their orthogonal
rows, with every zero of the model filled; that of the matrix P is a linear recursion that keeps these zeros and
subtracts nothing large. So a step is written in covariances, and each of its numbers gets the value that the filter
computed by factors. With C = P- H', S = H C + R, K = C S^-1, w = S^-1 e, a dash for the transpose and d for the
derivative by one parameter,

    dm- = F dm + dF m + db,   dP- = F dP F' + dF P F' + F P dF' + dQ,
    de = dz - (H dm- + dH m- + dc),   dC = dP- H' + P- dH',   dS = H dC + dH C + dR,
    dm = dm- + K de + (dC - K dS) w,   dP = dP- - dC K' - K dC' + K dS K'.

The last is that of P = P- - C S^-1 C'. The log-density has the derivative -w' de - tr((S^-1 - w w') dS) / 2. The
derivatives of m, P and the log-density are written out below; JAX derives the others, and the adjoint of all. A row of
four states and two outputs behind a random gain takes 82 operations, where factors take 1,224.

A random gain G is one more noise, (G - M) y: R holds E[(G - M) E[y y'] (G - M)'], with the state's moments before any
data. Their derivatives follow a linear recursion too.

Source: Gupta and Mehra, Computational aspects of maximum likelihood estimation (1974); behind a random gain the
recursion of De Koning, Optimal estimation of linear discrete-time systems with stochastic parameters (1984).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.gaussian.signal_moments import augmented_second_moment
from heliograph.filters.linear.linear_filter_state import MomentsBeforeData
from heliograph.model.over_time import at
from heliograph.numerics.gaussian_density import log_density
from heliograph.numerics.linalg import contract, outer, psd_solve, symmetric
from heliograph.numerics.types import Array, PyTree


class ModelMatrices(NamedTuple):
    """A step x+ = F x + b + w, z = H x + c + v with Cov w = Q and Cov v = R, the channel's gain and noise within.

    H is by the mean gain; R holds the noise of the sensor, of the channel and of a random gain.
    """

    F: jax.Array
    b: jax.Array
    Q: jax.Array
    H: jax.Array
    c: jax.Array
    R: jax.Array


def find_model_matrices(
    filter: Any, moments: MomentsBeforeData | None, u: Array, k: Array
) -> tuple[ModelMatrices, MomentsBeforeData | None]:
    """Return the matrices of step k of a linear filter, and the state's moments before any data after the step.

    x+ = F x + b + w with Cov w = Q, and z = H x + c + v with Cov v = R, as received behind the channel. With the gain's
    mean M, H = M C for a sensor y = C x + v_y, and R has the noise of the channel, and what a random gain adds. Q and R
    are computed from covariance matrices, not from the factors that noises also store: factors have no derivative where
    a covariance is zero.

    Args:
        filter: a linear filter, with a plant, a sensor and a channel z = G y + n.
        moments: E x and Cov x before any data, before the step; None behind a known gain, where they are not needed.
        u: the input.
        k: the step's number.
    """
    plant, sensor, channel = at(filter.plant, k), at(filter.sensor, k), at(filter.channel, k)
    law, gain = sensor.noise, jnp.asarray(channel.mean_gain)  # law of the sensor's noise, and M = E[G]
    F, b, Q = plant.transition_matrix(u), plant.shift(u), plant.noise_covariance(u)
    # `nominal` has the covariances of the entries of (G, n), that of n_i and n_j at [i, j, -1, -1]. `gain_covariance`
    # has those of G alone, or of (G, n) if G and n are correlated; then n is counted below, with G.
    uncorrelated_noise = jnp.asarray(channel.nominal.center[..., -1, -1] - channel.gain_covariance[..., -1, -1])
    R = gain @ jnp.asarray(law.covariance) @ gain.T + uncorrelated_noise  # M Cov(v) M' + Cov n
    if moments is not None:
        moments = moments.predict(F, b, Q)
        # A random gain adds the noise (G - M) y: R_ij += sum_ab Cov(G_ia, G_jb) E[(y, 1)_a (y, 1)_b].
        y = moments.measure(sensor)
        R = R + contract(channel.gain_covariance, augmented_second_moment(y.second, y.mean, 1.0))
    H, c = gain @ jnp.asarray(sensor.matrix), gain @ jnp.asarray(law.mean) + jnp.asarray(channel.offset)
    return ModelMatrices(F=F, b=b, Q=Q, H=H, c=c, R=R), moments


class StateMoments(NamedTuple):
    """Mean (n,) and covariance (n, n) of the state given the data."""

    mean: jax.Array
    covariance: jax.Array


def find_moments_at_start(filter: Any) -> StateMoments:
    """Return mean (n,) and covariance (n, n) of the state before the first step of a linear filter.

    They are the filter's own, or the plant's; `filter.law_at_start` is whichever holds them.
    """
    start = filter.law_at_start
    return StateMoments(jnp.asarray(start.initial_mean), jnp.asarray(start.initial_covariance))


class FactoredStep(NamedTuple):
    """A step as the filter computes it in factors: the laws before and after the correction, e (m,) and S (m, m).

    The innovation e and its covariance S are NaN where nothing arrived.
    """

    prior: Gaussian
    after: Gaussian
    e: jax.Array
    S: jax.Array


class StepMoments(NamedTuple):
    """The state's moments after a step, and the innovation e (m,) and its covariance S (m, m), 0 where none arrived."""

    after: StateMoments
    e: jax.Array
    S: jax.Array


def step_by_covariances(
    matrices: ModelMatrices, before: StateMoments, z: jax.Array, factored: FactoredStep
) -> StepMoments:
    """Return the state's moments after a step of the filter, with the values of `factored`.

    Factors of covariances (P = L D L') give the more exact values, but have no derivative where a covariance is zero.
    So each number is `take_derivatives_of(formula, value)`: the value is that by factors, and derivatives are those of
    the Kalman filter's formula in covariances.

    Args:
        matrices: matrices of the step: x+ = F x + b + w, Cov w = Q, and z = H x + c + v, Cov v = R.
        before: mean and covariance of the state before the step.
        z: measurement (m,), NaN for what did not arrive.
        factored: results of the same step by factors; they count as constants, without derivatives.
    """
    F, b, Q, H, c, R = matrices
    # Prediction: m- = F m + b, P- = F P F' + Q.
    mean = take_derivatives_of(F @ before.mean + b, factored.prior.mean)
    P = take_derivatives_of(symmetric(F @ before.covariance @ F.T + Q), factored.prior.covariance)
    # Innovation e = z - H m- - c, C = P- H' and S = H C + R; zero where nothing arrived.
    present = ~jnp.isnan(z)
    e = jnp.where(present, take_derivatives_of(z - H @ mean - c, factored.e), 0.0)
    H = jnp.where(present[:, None], H, 0.0)
    C = P @ H.T
    S = take_derivatives_of(symmetric(H @ C + R), factored.S)
    S = jnp.where(present[:, None] & present, S, 0.0)
    # Correction: m = m- + C S^-1 e, P = P- - C S^-1 C'.
    after = StateMoments(factored.after.mean, factored.after.covariance)
    return StepMoments(_take_derivatives_of_correction(StateMoments(mean, P), (C, e, S), after), e, S)


def _carry_derivatives(expression: PyTree, value: PyTree) -> PyTree:
    """Return v + (x - constant x) for each expression x and value v: the value v, with the derivative of x.

    The functions below also have derivative rules of their own (`custom_jvp`). JAX forgets these where it
    differentiates a loop that was already differentiated backwards (for second derivatives), and differentiates the
    function's body instead: with this body the derivative is right there too.
    """
    return jax.tree.map(lambda x, v: v + (x - jax.lax.stop_gradient(x)), expression, value)


@jax.custom_jvp
def take_derivatives_of(expression: jax.Array, value: jax.Array) -> Any:
    """Return `value`, with the derivatives of `expression`, a formula of the same number that has faster ones."""
    return _carry_derivatives(expression, value)


@take_derivatives_of.defjvp
def _differentiate_expression(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    """Rule of derivatives of `take_derivatives_of(expression, value)`: the value, and the tangent of the expression.

    `tangents` are those of (expression, value); that of the value is not used.
    """
    expression_tangent, _ = tangents
    return take_derivatives_of(*primals), expression_tangent


@jax.custom_jvp
def _take_derivatives_of_correction(
    prior: StateMoments, innovation: tuple[jax.Array, jax.Array, jax.Array], after: StateMoments
) -> StateMoments:
    """Return `after`, with the derivatives of m- + C S^-1 e and P- - C S^-1 C'.

    Args:
        prior: m- and P-.
        innovation: C (n, m), e (m,) and S (m, m), zero of what did not arrive.
        after: the corrected moments.
    """
    C, e, S = innovation
    gained = C @ psd_solve(S, jnp.concatenate([e[:, None], C.T], axis=1))
    corrected = StateMoments(prior.mean + gained[:, 0], symmetric(prior.covariance - gained[:, 1:]))
    return StateMoments(*_carry_derivatives(corrected, after))


@_take_derivatives_of_correction.defjvp
def _differentiate_correction(primals: Any, tangents: Any) -> tuple[StateMoments, StateMoments]:
    """Return the corrected moments, and their derivatives along the tangents dC, de, dS and those of the prior.

    With w = S^-1 e and the gain K = C S^-1 they are dm = dm- + K de + (dC - K dS) w for the mean, and
    dP = dP- - dC K' - K dC' + K dS K' for the covariance.
    """
    _, (C, e, S), _ = primals  # (m-, P-), (C, e, S) and the corrected moments
    d_prior, (dC, de, dS), _ = tangents
    solved = psd_solve(S, jnp.concatenate([e[:, None], C.T], axis=1))
    w, K = solved[:, 0], solved[:, 1:].T
    K_dS = K @ dS
    mean = d_prior.mean + K @ de + (dC - K_dS) @ w
    # dC K' + K dC' - K dS K' is (dC - K dS / 2) K' plus its transpose.
    half = (dC - K_dS / 2) @ K.T
    derivative = StateMoments(mean, symmetric(d_prior.covariance - (half + half.T)))
    return _take_derivatives_of_correction(*primals), derivative


@jax.custom_jvp
def take_derivatives_of_log_density(e: jax.Array, S: jax.Array, value: jax.Array) -> Any:
    """Return `value`, a log-density log N(e; 0, S) computed by factors, with the derivatives by e (m,) and S (m, m).

    Components that did not arrive have zeros in e and S. These, and components that those before them determine, do not
    count in the derivatives.
    """
    return _carry_derivatives(log_density(e, S, jnp.zeros_like(e)), value)


@take_derivatives_of_log_density.defjvp
def _differentiate_log_density(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    """Return the log-density of e under N(0, S), and its derivative -w' de - tr((S^-1 - w w') dS) / 2, w = S^-1 e."""
    (e, S, _), (de, dS, _) = primals, tangents
    solved = psd_solve(S, jnp.concatenate([e[:, None], jnp.eye(len(e), dtype=S.dtype)], axis=1))
    w, inverse = solved[:, 0], solved[:, 1:]
    derivative = -(w @ de) - jnp.sum((inverse - outer(w, w)) * dS) / 2
    return take_derivatives_of_log_density(*primals), derivative
