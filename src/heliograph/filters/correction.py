"""The arithmetic of an update behind an uncertain channel: gain and bound.

Notation as in `update`: e prior error with covariance P, y = yhat + e_y the sensor's signal, z = G y + n what arrives.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.scalars import smallest_scalars, young_omega, young_sweep, zero_mean_sweep
from heliograph.numerics.check import array, fail
from heliograph.numerics.small_matrix import (
    congruence,
    diagonal,
    runs_last,
    solve,
    symmetric,
    times,
    trace,
    transpose,
    with_rounding,
)
from heliograph.numerics.types import Array
from heliograph.random_affine.second_moments import SecondOrder


class Signal(NamedTuple):
    """The sensor's signal as the filter sees it before the measurement.

    mean (m,), covariance (m, m) with sensor noise, cross = E[e e_y'] (n, m), second = E[y y'] (m, m).
    """

    mean: jax.Array
    covariance: jax.Array
    cross: jax.Array
    second: jax.Array


class Scalars(eqx.Module):
    """Fixed positive scalars (beta_1, beta_2) of Young's inequality, as published bounds use them.

    Raises:
        ValueError: a scalar that is not positive.
    """

    values: np.ndarray

    def __init__(self, first: float, second: float):
        self.values = array("scalars of the bound", [first, second], (2,))
        if np.any(self.values <= 0):
            raise fail("scalars of the bound", "two positive numbers", (first, second))


def as_array(scalars: Scalars | None) -> np.ndarray:
    """Two numbers, NaN where the trace is to be minimised over them."""
    return np.full(2, np.nan) if scalars is None else scalars.values


def as_scalars(values: np.ndarray) -> Scalars | None:
    """The way back."""
    return None if np.isnan(values).any() else Scalars(*values)


@runs_last
def young_correction(
    prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array, scalars: Array
) -> tuple[jax.Array, jax.Array]:
    """The update of `Polytope` for any description of the channel; scalars (2,), NaN where they are to be found."""
    w = homogeneous(signal.second, signal.mean, 1.0)
    both = present[:, None] & present[None, :]
    mean_part = jnp.where(both, congruence(channel.mean_gain, signal.covariance), 0.0)
    cross = jnp.where(present[:, None], times(channel.mean_gain, transpose(signal.cross)), 0.0)
    if not channel.uncertain:
        return gain_and_bound(prior, cross, _of_known_gain(channel, w, present) + mean_part)
    base = channel.spread(w, present) + absent(present)
    shift, power = channel.shift(w, present), times(cross, transpose(cross))

    beta = smallest_scalars(young_sweep, scalars, (base, shift, mean_part, power, trace(prior)))
    gain, bound = gain_and_bound(prior, cross, young_omega(beta, base, shift, mean_part))
    return gain, bound + beta[0] * prior


@runs_last
def known_gain_covariance(signal: Signal, channel: SecondOrder, present: jax.Array) -> jax.Array:
    """Omega of a channel whose mean gain is known: the covariance of z, or what dominates it, that gives the gain."""
    both = present[:, None] & present[None, :]
    mean_part = jnp.where(both, congruence(channel.mean_gain, signal.covariance), 0.0)
    return _of_known_gain(channel, homogeneous(signal.second, signal.mean, 1.0), present) + mean_part


def _of_known_gain(channel: SecondOrder, w: jax.Array, present: jax.Array) -> jax.Array:
    spread = channel.spread(w, present) if channel.uncertain else channel.spread.middle(w, present)
    return spread + absent(present)


@runs_last
def zero_mean_correction(
    prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array, scalar: Array
) -> tuple[jax.Array, jax.Array]:
    """The update of `ZeroMean`; scalar (1,), NaN where it is to be found."""
    known_part = homogeneous(signal.second - signal.covariance, signal.mean, 1.0)
    own = homogeneous(signal.covariance, jnp.zeros_like(signal.mean), 0.0)
    cross = jnp.where(present[:, None], times(channel.mean_gain, transpose(signal.cross)), 0.0)
    if not channel.uncertain:
        omega_known = channel.power.middle(own, present) + channel.spread.middle(known_part, present)
        return gain_and_bound(prior, cross, omega_known + absent(present))
    base = channel.power(own, present) + channel.spread(known_part, present) + absent(present)
    shift, power = channel.shift(own, present), times(cross, transpose(cross))
    used = heard(channel, present)
    among = jnp.where(used[:, None] & used[None], signal.covariance, 0.0)
    of_used = jnp.where(used, signal.cross, 0.0)
    explained = symmetric(times(of_used, solve(among, transpose(of_used))))

    beta = smallest_scalars(zero_mean_sweep, scalar, (base, shift, power, trace(explained)))[0]
    gain, bound = gain_and_bound(prior, cross, base + shift / beta)
    return gain, bound + beta * explained


def heard(channel: SecondOrder, present: jax.Array) -> jax.Array:
    """Which components of the signal have a part in what arrived: the others say nothing, as if never measured."""
    m, p = channel.mean_gain.shape[:2]
    reached = (channel.power.center != 0) | (channel.power.radius != 0)
    parts = [[reached[i, i, a, a] & present[i] for i in range(m)] for a in range(p)]
    return jnp.stack([jnp.any(jnp.stack(rows), axis=0) for rows in parts])


def homogeneous(second: jax.Array, mean: jax.Array, one: float) -> jax.Array:
    """E[(y, 1)(y, 1)'] from E[y y'] and E[y], with `one` in the last corner."""
    column = mean[:, None]
    second = jnp.broadcast_to(second, (*second.shape[:2], *jnp.broadcast_shapes(second.shape[2:], mean.shape[1:])))
    column = jnp.broadcast_to(column, (*column.shape[:2], *second.shape[2:]))
    corner = jnp.full_like(column[:1], one)
    top = jnp.concatenate([second, column], axis=1)
    return jnp.concatenate([top, jnp.concatenate([transpose(column), corner], axis=1)])


def absent(present: jax.Array) -> jax.Array:
    """Unit variance for components that did not arrive, so that the reduced system keeps its full size."""
    return diagonal(jnp.where(present, 0.0, 1.0))


def gain_and_bound(prior: jax.Array, cross: jax.Array, omega: jax.Array) -> tuple[jax.Array, jax.Array]:
    """K = C' Omega^-1 and P - C' Omega^-1 C, which minimise P - K C - C' K' + K Omega K'.

    The difference is known to rounding of P alone, which the bound carries.
    """
    solved = _solved(omega, cross)
    return transpose(solved), _bound(prior, cross, solved)


_solved = runs_last(solve)


@runs_last
def _bound(prior: jax.Array, cross: jax.Array, solved: jax.Array) -> jax.Array:
    return symmetric(with_rounding(prior, len(cross)) - times(transpose(cross), solved))
