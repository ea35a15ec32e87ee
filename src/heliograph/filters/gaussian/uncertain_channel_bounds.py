"""Bounds on the covariance behind a channel of uncertain law, as Kalman updates of an inflated prior and noise.

Notation: e is the prior error with covariance P, y = yhat + H e + v the sensor's signal with Cov v = R, z = G y + n the
measurement, M = E[G] and b = E[n] by the nominal law. The law of (G, n) is only known to lie in a set: D is the shift
of E[G] from M under a law of the set. For Y = E[(y, 1)(y, 1)'], three maps bound second moments over the set:
`channel.spread(Y)` that of (G - M) y + n - b, `channel.shift(Y)` that of its mean given y, D y, and `channel.power(Y)`
that of G y.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, decorrelate, join_columns
from heliograph.factors.factored_gaussian import Gaussian, condition_on_observation, from_columns
from heliograph.factors.pivots import reciprocal_or_zero
from heliograph.factors.repeated_measurements import triangularise_noise
from heliograph.filters.gaussian.signal_moments import (
    ArrivedInnovation,
    Signal,
    augmented_second_moment,
    factor_covariance,
)
from heliograph.filters.gaussian.young_scalars import (
    find_trace_minimising_scalars,
    young_fixed_point_map,
    zero_mean_fixed_point_map,
)
from heliograph.numerics.check import array, fail, instance
from heliograph.numerics.module import Module, readable
from heliograph.numerics.types import Array, PyTree
from heliograph.random_affine.moments.second_moments import SecondOrder

T = TypeVar("T", bound=PyTree)


@readable
class Scalars(Module):
    """Fixed positive scalars (beta_1, beta_2) of Young's inequality, as published bounds use them.

    Args:
        first: beta_1 > 0.
        second: beta_2 > 0.

    Raises:
        ValueError: a scalar that is not positive.
    """

    values: np.ndarray

    def __init__(self, first: float, second: float):
        """Keep beta_1 (`first`) and beta_2 (`second`) as an array (2,)."""
        self.values = array("scalars of the bound", [first, second], (2,))
        if np.any(self.values <= 0):
            raise fail("scalars of the bound", "two positive numbers", (first, second))


def scalars_as_array(scalars: Scalars | None) -> np.ndarray:
    """Return the two scalars of the bound; NaN for None, which means that the bound's trace is minimised over them."""
    if scalars is None:
        return np.full(2, np.nan)
    return instance("scalars", scalars, Scalars, "Scalars").values


def scalars_from_array(values: np.ndarray) -> Scalars | None:
    """Return the two scalars as `Scalars`; None for NaN, which stands for scalars to be found at each step.

    The inverse of `scalars_as_array`.
    """
    return None if np.isnan(values).any() else Scalars(*values)


def keep_where_unchanged(changes: jax.Array, after: T, before: T) -> T:
    """Return the tree of arrays `after` where the flag `changes` () holds, else `before`: two forms of one state.

    A measurement of which nothing arrived must leave a state as it is to the last digit.
    """
    chosen: T = jax.tree.map(lambda a, b: jnp.where(changes, a, b), after, before)
    return chosen


def condition_by_young_bound(signal: Signal, channel: SecondOrder, z: ArrivedInnovation, scalars: Array) -> Gaussian:
    """Return the state after z with an upper bound of its error covariance, by Young's inequality (`Polytope`).

    The sensor gives y = H x + v (v of covariance R), and the channel z = G y + n, where E[G] is uncertain: M + D, M
    nominal. The error after a gain K is e+ = e - K M (H e + v) - K D y - K u, where e is the error before, of
    covariance P, and u, the deviation of z from its mean given y, is uncorrelated with the rest. Young's inequality, a
    b' + b a' <= beta a a' + b b' / beta, bounds the products of D y with e (beta_1) and with M (H e + v) (beta_2):

        E[e+ e+'] <= (1 + beta_1) P - K C - C' K' + K Omega K',  C = M H P,
        Omega = base + (1 / beta_1 + 1 / beta_2) shift + (1 + beta_2) M (H P H' + R) M',

    with base = spread(Y) >= E u u' and shift = shift(Y) >= E D y y' D', Y the second moment of (y, 1). The gain
    K = C' Omega^-1 of least bound leaves (1 + beta_1) P - C' Omega^-1 C. A Kalman update gives the same, with
    a = 1 + beta_1 and b = 1 + beta_2: of the prior a P by the innovation times a, with the noise
    a^2 Omega - a M H P H' M' (a sum of positive terms below).

    `scalars` (2,) are beta_1 and beta_2, NaN to choose the values whose bound has the least trace.
    """
    prior, present = signal.prior, z.present
    # M H, M H P H' M' and M R M'.
    slopes, of_state, of_noise = _find_received_slopes_and_covariances(signal, channel, present)
    second = augmented_second_moment(signal.second, signal.mean, 1.0)  # Y
    base, shift = channel.spread(second, present), channel.shift(second, present)
    # beta: the scalars that minimise the trace of the bound.
    cross = (slopes * prior.variances) @ prior.root.T  # C
    trace = jnp.trace(prior.covariance)
    # Arguments of `young_fixed_point_map`: base, shift, mean_part, cross_square and trace.
    terms = base + unit_variance_where_absent(present), shift, of_state + of_noise, cross @ cross.T, trace
    beta = find_trace_minimising_scalars(young_fixed_point_map, scalars, terms)
    a, b = jnp.where(jnp.any(present), 1 + beta[0], 1.0), 1 + beta[1]
    # The Kalman update: a^2 Omega - a M H P H' M'.
    noise = a**2 * (base + (1 / beta[0] + 1 / beta[1]) * shift + b * of_noise) + a * (a * b - 1) * of_state
    inflated_prior = prior._replace(variances=a * prior.variances)
    return condition_on_observation(inflated_prior, slopes, a * z.innovation, factor_covariance(noise), present)[0]


def condition_by_zero_mean_bound(signal: Signal, channel: SecondOrder, z: ArrivedInnovation, scalar: Array) -> Gaussian:
    """Return the state after z by a bound for prior errors e with E[e yhat'] = 0 (`ZeroMean`).

    The measurement is z = G y + n, where the law of G is known only within a set. y = yhat + (y - yhat) has the
    predicted mean yhat and the covariance Pyy; only y - yhat is correlated with e, in an unknown way. For each beta > 0
    the bound is P, updated by a measurement with the noise Omega - M H P H' M' (M the mean gain, H the slopes of y by
    x), plus beta C Pyy^+ C' with C = Cov(x, y), the variance of the state that the received components explain. Omega =
    power(Pyy) + spread(yhat yhat') + shift(Pyy) / beta bounds the covariance of z. At a second moment W of y, power(W)
    bounds E[G W G'], spread(W) what random G and n add, and shift(W) what an unknown mean of G adds, over all laws.

    Args:
        signal: joint moments of the state x and of y.
        channel: bounds of the second moments of G and n.
        z: innovation, and which components arrived.
        scalar: beta (1,), or NaN for the beta that gives the bound of least trace.
    """
    prior, present = signal.prior, z.present
    slopes, of_state, _ = _find_received_slopes_and_covariances(signal, channel, present)
    # E[y y'] = yhat yhat' + Pyy; each term as a second moment of (y, 1), in which the constant 1 counts once.
    mean_part = augmented_second_moment(signal.second - signal.covariance, signal.mean, 1.0)
    covariance_part = augmented_second_moment(signal.covariance, jnp.zeros_like(signal.mean), 0.0)
    base = channel.power(covariance_part, present) + channel.spread(mean_part, present)
    shift = channel.shift(covariance_part, present)
    # C Pyy^+ C' by columns: with Pyy = N diag(s) N', it is (C N^-T) diag(1 / s) (C N^-T)'. Only components of y that
    # act on what arrived count.
    is_received = mask_received(channel, present)[:, None]
    signal_columns = join_columns(WeightedColumns(signal.slopes, prior.variances), signal.noise)
    factors = triangularise_noise(signal_columns._replace(matrix=jnp.where(is_received, signal_columns.matrix, 0.0)))
    explained = decorrelate(factors.matrix, jnp.where(is_received, signal.cross.T, 0.0)).T  # C N^-T
    explained_weights = reciprocal_or_zero(factors.weights)  # 1 / s
    # The beta of least trace, then the update with the noise Omega - M H P H' M'.
    cross = (slopes * prior.variances) @ prior.root.T  # Cov(z, x)
    trace_explained = jnp.sum(explained**2 @ explained_weights)  # tr(C Pyy^+ C')
    # Arguments of `zero_mean_fixed_point_map`: base, shift, cross_square and trace_explained.
    terms = base + unit_variance_where_absent(present), shift, cross @ cross.T, trace_explained
    beta = find_trace_minimising_scalars(zero_mean_fixed_point_map, scalar, terms)[0]
    noise = factor_covariance(base + shift / beta - of_state)
    after, _ = condition_on_observation(prior, slopes, z.innovation, noise, present)
    bounded = from_columns(
        after.mean, join_columns(after.columns, WeightedColumns(explained, beta * explained_weights))
    )
    return keep_where_unchanged(jnp.any(present), bounded, after)


def _find_received_slopes_and_covariances(
    signal: Signal, channel: SecondOrder, present: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the slopes M H (m, n) of M y, and the two parts M H D H' M' and M R M' (m, m) of its covariance.

    The signal is y = H xi + v, with uncorrelated xi of variances D (`prior.variances`) and Cov v = R. There are n
    states and m received numbers. M is the channel's mean gain, with rows of zeros for what did not arrive.
    """
    gain = jnp.where(present[:, None], jnp.asarray(channel.mean_gain), 0.0)
    slopes = gain @ signal.slopes
    of_state = WeightedColumns(slopes, signal.prior.variances).covariance
    of_noise = signal.noise.through(gain).covariance
    return slopes, of_state, of_noise


def unit_variance_where_absent(present: jax.Array) -> jax.Array:
    """Return a diagonal (m, m) with 1 for components that did not arrive, and 0 for all others.

    Added to a covariance whose rows of missing components are 0, it makes it invertible, without any effect on others.
    """
    return jnp.diag(jnp.where(present, 0.0, 1.0))


def mask_received(channel: SecondOrder, present: jax.Array) -> jax.Array:
    """Return the mask (p,) of the signal's components that act on what arrived.

    The other components count as not measured. `channel.power` maps E[y y'] to the received power, with a center and a
    radius (m, m, p+1, p+1). y_a acts on z_i if its entry [i, i, a, a] is not 0.
    """
    m, p = channel.mean_gain.shape[:2]
    contributes = (channel.power.center != 0) | (channel.power.radius != 0)  # [i, j, a, b]: of y_a y_b in E[z_i z_j]
    arrived_contributions = [[contributes[i, i, a, a] & present[i] for i in range(m)] for a in range(p)]
    return jnp.stack([jnp.any(jnp.stack(of_component), axis=0) for of_component in arrived_contributions])
