"""A step of a linear filter, of the values of its factors and the derivatives of its covariances.

Of the factors L diag(d) L' a derivative costs two passes of their orthogonal rows, with every zero of the model filled;
of the matrix P itself it is a linear recursion that keeps these zeros and subtracts nothing large. So a step is written
by covariances, and each of its numbers gets the value that the filter has by factors. With C = P- H', S = H C + R,
K = C S^-1, w = S^-1 e and a dash for the derivative in one number,

    m-' = F m' + F' m + b',   P-' = F P' F' + (F' P F' and its transpose) + Q',
    e'  = z' - (H m-' + H' m- + c'),   C' = P-' H' + P- (H')',   S' = H C' + H' C + R',
    m'  = m-' + K e' + (C' - K S') w,   P' = P-' - C' K' - K C'' + K S' K'.

The last is that of P = P- - C S^-1 C'. The log-density has the derivative -w' e' - tr((S^-1 - w w') S') / 2. JAX writes
all but the last three, and the adjoint of all: 82 of its operations for a row of four states and two outputs behind a
random gain, where that of the factors has 1,224.

A random gain G is one more noise, (G - M) y: R holds E[(G - M) E[y y'] (G - M)'], by the state's moments before data,
whose derivatives are carried beside, a linear recursion as well.

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
    """Return F, b, Q, H, c and R of step k of a linear filter, under the input u, and the moments before data after it.

    They are x+ = F x + b + w of covariance Q, and z = H x + c + v of covariance R, as received behind the channel. Q
    and R are by the noises' covariances, and not by the factors that a noise holds beside: these have no derivative
    where a covariance is zero.

    Args:
        filter: the filter.
        moments: those before data of the state before the step; None behind a known gain, where none are returned.
        u: the input.
        k: the step's number.
    """
    plant, sensor, channel = at(filter.plant, k), at(filter.sensor, k), at(filter.channel, k)
    law, gain = sensor.noise, jnp.asarray(channel.mean_gain)
    F, b, Q = plant.transition_matrix(u), plant.shift(u), plant.noise_covariance(u)
    # Of the channel's noise that is what its spread holds beside the gain's.
    of_channel = jnp.asarray(channel.nominal.center[..., -1, -1] - channel.gain_spread[..., -1, -1])
    R = gain @ jnp.asarray(law.covariance) @ gain.T + of_channel
    if moments is not None:
        moments = moments.predict(F, b, Q)
        # A random gain adds its spread times E[(y, 1)(y, 1)'] to the noise.
        y = moments.measure(sensor)
        R = R + contract(channel.gain_spread, augmented_second_moment(y.second, y.mean, 1.0))
    H, c = gain @ jnp.asarray(sensor.matrix), gain @ jnp.asarray(law.mean) + jnp.asarray(channel.offset)
    return ModelMatrices(F=F, b=b, Q=Q, H=H, c=c, R=R), moments


class StateMoments(NamedTuple):
    """Mean (n,) and covariance (n, n) of the state given the data."""

    mean: jax.Array
    covariance: jax.Array


def find_moments_at_start(filter: Any) -> StateMoments:
    """Return the mean and covariance of the state before the first step of a linear filter."""
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
    """Return what a step makes of the state's moments: the values of `factored`, and derivatives by covariances.

    Args:
        matrices: of the step.
        before: the state's moments before it.
        z: measurement (m,), NaN for what did not arrive.
        factored: the same step, whose numbers are taken as known: nothing is differentiated by them.
    """
    F, b, Q, H, c, R = matrices
    # Prediction.
    mean = take_derivatives_of(F @ before.mean + b, factored.prior.mean)
    P = take_derivatives_of(symmetric(F @ before.covariance @ F.T + Q), factored.prior.covariance)
    # Innovation, and its covariance with the state; zero of what did not arrive.
    present = ~jnp.isnan(z)
    e = jnp.where(present, take_derivatives_of(z - H @ mean - c, factored.e), 0.0)
    H = jnp.where(present[:, None], H, 0.0)
    C = P @ H.T
    S = take_derivatives_of(symmetric(H @ C + R), factored.S)
    S = jnp.where(present[:, None] & present, S, 0.0)
    # Correction.
    after = StateMoments(factored.after.mean, factored.after.covariance)
    return StepMoments(_take_derivatives_of_correction(StateMoments(mean, P), (C, e, S), after), e, S)


def _carry_derivatives(expression: PyTree, value: PyTree) -> PyTree:
    """Return `value` plus the expression less itself, held constant.

    Beside a rule of derivatives this is for what differentiates a loop that was differentiated backwards: JAX forgets
    the rules in it, and differentiates what stands beside them.
    """
    return jax.tree.map(lambda x, v: v + (x - jax.lax.stop_gradient(x)), expression, value)


@jax.custom_jvp
def take_derivatives_of(expression: jax.Array, value: jax.Array) -> Any:
    """Return `value` with the derivatives of an expression that is another way to compute it."""
    return _carry_derivatives(expression, value)


@take_derivatives_of.defjvp
def _differentiate_expression(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    """Return the value and the derivative of the expression."""
    return take_derivatives_of(*primals), tangents[0]


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
    (C, e, S), (prior, (dC, de, dS), _) = primals[1], tangents
    solved = psd_solve(S, jnp.concatenate([e[:, None], C.T], axis=1))
    w, K = solved[:, 0], solved[:, 1:].T
    # dC K' + K dC' - K dS K' is (dC - K dS / 2) K' plus its transpose.
    KS = K @ dS
    turned = (dC - KS / 2) @ K.T
    mean = prior.mean + K @ de + (dC - KS) @ w
    derivative = StateMoments(mean, symmetric(prior.covariance - (turned + turned.T)))
    return _take_derivatives_of_correction(*primals), derivative


@jax.custom_jvp
def take_derivatives_of_log_density(e: jax.Array, S: jax.Array, value: jax.Array) -> Any:
    """Return `value`, log N(e; 0, S), with the derivatives of this density of the components that are not determined.

    Of what did not arrive, e (m,) and S (m, m) are zero.
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
