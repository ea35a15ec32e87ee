"""Bounds on the covariance behind a channel of uncertain law, as Kalman updates of an inflated prior and noise.

Notation as in `update`: e the prior error with covariance P, y = yhat + e_y the sensor's signal, z = G y + n the
measurement, M = E[G], H the slopes of y in the state and R the covariance of the rest of y.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, decorrelate, join_columns
from heliograph.factors.factored_gaussian import Gaussian, condition_on_observation, from_columns
from heliograph.factors.pivots import reciprocal_or_zero
from heliograph.factors.repeated_measurements import triangularise_noise
from heliograph.filters.gaussian.signal_moments import ArrivedInnovation, Signal, augmented_second_moment, factor_spread
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
        """Keep the two positive scalars of the covariance bound."""
        self.values = array("scalars of the bound", [first, second], (2,))
        if np.any(self.values <= 0):
            raise fail("scalars of the bound", "two positive numbers", (first, second))


def scalars_as_array(scalars: Scalars | None) -> np.ndarray:
    """Return the two scalars of the bound; NaN for None, which means that the bound's trace is minimised over them."""
    if scalars is None:
        return np.full(2, np.nan)
    return instance("scalars", scalars, Scalars, "Scalars").values


def scalars_from_array(values: np.ndarray) -> Scalars | None:
    """Return the scalars from two numbers, None for NaN: the inverse of `scalars_as_array`."""
    return None if np.isnan(values).any() else Scalars(*values)


def keep_where_unchanged(changes: jax.Array, after: T, before: T) -> T:
    """Return `after` where something changes, else `before`."""
    chosen: T = jax.tree.map(lambda a, b: jnp.where(changes, a, b), after, before)
    return chosen


def condition_by_young_bound(signal: Signal, channel: SecondOrder, z: ArrivedInnovation, scalars: Array) -> Gaussian:
    """Return the state after z by `Polytope`'s bound; scalars b1, b2 (2,), NaN to minimise the trace over them.

    (1 + b1) P - C' Omega^-1 C with Omega = base + (1/b1 + 1/b2) shift + (1 + b2) M (H P H' + R) M' is what a Kalman
    update makes of the prior (1 + b1) P and, of z, of the noise (1 + b1)^2 [base + (1/b1 + 1/b2) shift +
    (1 + b2) M R M'] + (1 + b1) ((1 + b1)(1 + b2) - 1) M H P H' M', positive terms; its gain is K / (1 + b1).
    """
    prior, present = signal.prior, z.present
    slopes, of_state, of_noise = _find_received_slopes_and_covariances(signal, channel, present)
    w = augmented_second_moment(signal.second, signal.mean, 1.0)
    base, shift = channel.spread(w, present), channel.shift(w, present)
    # The scalars of least trace; C = Cov(x, z).
    cross = (slopes * prior.variances) @ prior.root.T
    trace = jnp.trace(prior.covariance)
    parts = base + unit_variance_where_absent(present), shift, of_state + of_noise, cross @ cross.T, trace
    beta = find_trace_minimising_scalars(young_fixed_point_map, scalars, parts)
    a, b = jnp.where(jnp.any(present), 1 + beta[0], 1.0), 1 + beta[1]
    # The same bound as a Kalman update.
    noise = a**2 * (base + (1 / beta[0] + 1 / beta[1]) * shift + b * of_noise) + a * (a * b - 1) * of_state
    wide = prior._replace(variances=a * prior.variances)
    return condition_on_observation(wide, slopes, a * z.innovation, factor_spread(noise), present)[0]


def condition_by_zero_mean_bound(signal: Signal, channel: SecondOrder, z: ArrivedInnovation, scalar: Array) -> Gaussian:
    """Return the state after z by `ZeroMean`: the prior error has mean zero, its correlation with the gain is unknown.

    z = G y + n; y has mean yhat, covariance Pyy and slopes H in the state, whose covariance is P; M = E G. For each
    beta > 0 the bound is P, updated by a measurement with the noise Omega - M H P H' M', plus beta C Pyy^+ C', with
    C = Cov(x, y): what the received components explain of the state. Omega = power(Pyy) + spread(yhat yhat') +
    shift(Pyy) / beta, the maps of second moments of (y, 1) that `channel` has.

    Args:
        signal: moments of the state and of y, jointly.
        channel: what is received of y.
        z: innovation, and which components arrived.
        scalar: log beta (1,), NaN for the one of least trace.
    """
    prior, present = signal.prior, z.present
    slopes, of_state, _ = _find_received_slopes_and_covariances(signal, channel, present)
    # E[y y'] = yhat yhat' + Cov y: the gain's correlation is unknown with the error alone.
    # Each part as a second moment of (y, 1).
    mean_part = augmented_second_moment(signal.second - signal.covariance, signal.mean, 1.0)
    covariance_part = augmented_second_moment(signal.covariance, jnp.zeros_like(signal.mean), 0.0)
    base = channel.power(covariance_part, present) + channel.spread(mean_part, present)
    shift = channel.shift(covariance_part, present)
    # Power of the prior error that the received components explain: columns Cov(x, y) N^-T of Cov y = N diag(s) N'.
    used = mask_received(channel, present)[:, None]
    signals = join_columns(WeightedColumns(signal.slopes, prior.variances), signal.noise)
    factors = triangularise_noise(signals._replace(matrix=jnp.where(used, signals.matrix, 0.0)))
    explained = decorrelate(factors.matrix, jnp.where(used, signal.cross.T, 0.0)).T
    share = reciprocal_or_zero(factors.weights)
    # The best beta, then the update with what is left of Omega as noise.
    cross = (slopes * prior.variances) @ prior.root.T  # C', of what is received and the state
    parts = base + unit_variance_where_absent(present), shift, cross @ cross.T, jnp.sum(explained**2 @ share)
    beta = find_trace_minimising_scalars(zero_mean_fixed_point_map, scalar, parts)[0]
    noise = factor_spread(base + shift / beta - of_state)
    after, _ = condition_on_observation(prior, slopes, z.innovation, noise, present)
    wider = from_columns(after.mean, join_columns(after.columns, WeightedColumns(explained, beta * share)))
    return keep_where_unchanged(jnp.any(present), wider, after)


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
    """Return a diagonal (m, m): 1 for components that did not arrive, so that the system keeps its full size."""
    return jnp.diag(jnp.where(present, 0.0, 1.0))


def mask_received(channel: SecondOrder, present: jax.Array) -> jax.Array:
    """Return the mask (p,) of the signal's components that act on what arrived.

    The other components count as not measured. `channel.power` maps E[y y'] to the received power, with a center and a
    radius (m, m, p+1, p+1). y_a acts on z_i if its entry [i, i, a, a] is not 0.
    """
    m, p = channel.mean_gain.shape[:2]
    contributes = (channel.power.center != 0) | (channel.power.radius != 0)
    arrived_contributions = [[contributes[i, i, a, a] & present[i] for i in range(m)] for a in range(p)]
    return jnp.stack([jnp.any(jnp.stack(of_component), axis=0) for of_component in arrived_contributions])
