"""Gain and covariance bound of an update behind an uncertain channel.

Notation as in `update`: e the prior error with covariance P, y = yhat + e_y the sensor's signal, z = G y + n the
measurement.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.gaussian.precise import precise_update
from heliograph.filters.gaussian.scalars import smallest_scalars, young_omega, young_sweep, zero_mean_sweep
from heliograph.numerics.check import array, fail, instance
from heliograph.numerics.linalg import (
    PRECISE,
    congruence,
    diagonal,
    diagonal_of,
    pivots,
    root,
    rounding,
    solve,
    sum_of_squares,
    symmetric,
    times,
    times_vector,
    trace,
    transpose,
    with_rounding,
)
from heliograph.numerics.module import Module, readable
from heliograph.numerics.over_runs import Pick, runs_last, runs_last_of, where_any, where_each
from heliograph.numerics.types import Array, PyTree
from heliograph.random_affine.moments.second_moments import SecondOrder


class Signal(NamedTuple):
    """Prior moments of the sensor's signal y.

    Shapes: mean (m,), covariance (m, m) with sensor noise, cross = E[e e_y'] (n, m), second = E[y y'] (m, m). For a
    linear sensor y = C x + v also the matrix C (m, n) and Cov v (m, m), with which an update avoids cancellation, and
    the deviation (m,) that rounding alone gives to y: that of v (`noise_rounding`), to which `corrected` adds that of
    C x (`output_rounding`).
    """

    mean: jax.Array
    covariance: jax.Array
    cross: jax.Array
    second: jax.Array
    matrix: jax.Array | None = None
    noise: jax.Array | None = None
    rounding: jax.Array | None = None

    def about_mean(self) -> "Signal":
        """Return the moments of y - E y: all that the update behind a known gain depends on, whatever was estimated."""
        return self._replace(mean=jnp.zeros_like(self.mean), second=self.covariance)


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
        self.values = array("scalars of the bound", [first, second], (2,))
        if np.any(self.values <= 0):
            raise fail("scalars of the bound", "two positive numbers", (first, second))


def as_array(scalars: Scalars | None) -> np.ndarray:
    """Scalars as two numbers, NaN where the trace is to be minimised over them."""
    if scalars is None:
        return np.full(2, np.nan)
    return instance("scalars", scalars, Scalars, "Scalars").values


def as_scalars(values: np.ndarray) -> Scalars | None:
    """Scalars from two numbers, None for NaN: the inverse of `as_array`."""
    return None if np.isnan(values).any() else Scalars(*values)


def _shapes_of_update(prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array, *_: Array) -> PyTree:
    return (len(prior), len(present)), prior.shape


@runs_last_of(_shapes_of_update)
def young_correction(
    prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array, scalars: Array
) -> tuple[jax.Array, jax.Array]:
    """Gain and bound of `Polytope` for any description of the channel; scalars (2,), NaN to optimise them."""
    if not channel.uncertain:
        return _known_gain_correction(prior, signal, channel, present)
    # M Cov(y) M' of the components that arrived, and the cross covariance C = M E[e_y e'].
    w = homogeneous(signal.second, signal.mean, 1.0)
    both = present[:, None] & present[None, :]
    mean_part = jnp.where(both, congruence(channel.mean_gain, signal.covariance), 0.0)
    cross = _cross(signal, channel, present)
    # Omega = spread + (1/beta_1 + 1/beta_2) shift + (1 + beta_2) M Cov(y) M', at the scalars of least trace.
    base = channel.spread(w, present) + absent(present)
    shift, power = channel.shift(w, present), times(cross, transpose(cross))

    beta = smallest_scalars(young_sweep, scalars, (base, shift, mean_part, power, trace(prior)))
    gain, bound = gain_and_bound(prior, cross, young_omega(beta, base, shift, mean_part))
    return gain, bound + beta[0] * prior


def _known_gain_correction(
    prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The best linear update, and its covariance."""
    both = present[:, None] & present[None, :]
    mean_part = jnp.where(both, congruence(channel.mean_gain, signal.covariance), 0.0)
    spread = _of_known_gain(channel, homogeneous(signal.second, signal.mean, 1.0), present)
    cross = _cross(signal, channel, present)
    if signal.matrix is None or signal.noise is None:
        return gain_and_bound(prior, cross, spread + mean_part)
    received = jnp.where(present[:, None], times(channel.mean_gain, signal.matrix), 0.0)
    noise = spread + jnp.where(both, congruence(channel.mean_gain, signal.noise), 0.0)
    rounded = jnp.where(present, _rounding(signal, channel), 0.0)
    return gain_and_covariance(prior, cross, spread + mean_part, received, noise, rounded)


def _rounding(signal: Signal, channel: SecondOrder) -> jax.Array:
    """Variance (m,) that rounding gives to z by what y is off and, by a hundred eps, to its random gain's noise.

    Of outputs behind one gain some combination has next to none of that noise, and which it is, rounding decides.
    """
    through = jnp.abs(channel.mean_gain)
    of_mean = jnp.zeros_like(signal.mean) if signal.rounding is None else signal.rounding
    count = signal.second.shape[0]
    center = jnp.asarray(channel.spread.center)
    variances = transpose(diagonal_of(jnp.moveaxis(diagonal_of(center), 0, 2)))
    unit = 100 * count * float(np.finfo(of_mean.dtype).eps)
    return times_vector(through, of_mean) ** 2 + unit * times_vector(variances[:, :count], diagonal_of(signal.second))


def _cross(signal: Signal, channel: SecondOrder, present: jax.Array) -> jax.Array:
    return jnp.where(present[:, None], times(channel.mean_gain, transpose(signal.cross)), 0.0)


@runs_last
def known_gain_covariance(signal: Signal, channel: SecondOrder, present: jax.Array) -> jax.Array:
    """Omega of a channel whose mean gain is known: the covariance of z, or a bound on it, that gives the gain."""
    both = present[:, None] & present[None, :]
    mean_part = jnp.where(both, congruence(channel.mean_gain, signal.covariance), 0.0)
    return _of_known_gain(channel, homogeneous(signal.second, signal.mean, 1.0), present) + mean_part


def _of_known_gain(channel: SecondOrder, w: jax.Array, present: jax.Array) -> jax.Array:
    spread = channel.spread(w, present) if channel.uncertain else channel.spread.middle(w, present)
    return spread + absent(present)


@runs_last_of(_shapes_of_update)
def zero_mean_correction(
    prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array, scalar: Array
) -> tuple[jax.Array, jax.Array]:
    """Gain and bound of `ZeroMean`; scalar (1,), NaN to optimise it."""
    if not channel.uncertain:  # power(Pyy) = M Pyy M' + spread(Pyy): no other than Young's
        return _known_gain_correction(prior, signal, channel, present)
    # E[y y'] divided: yhat yhat' is known, Cov y is not.
    known_part = homogeneous(signal.second - signal.covariance, signal.mean, 1.0)
    unknown_part = homogeneous(signal.covariance, jnp.zeros_like(signal.mean), 0.0)
    cross = _cross(signal, channel, present)
    base = channel.power(unknown_part, present) + channel.spread(known_part, present) + absent(present)
    shift, power = channel.shift(unknown_part, present), times(cross, transpose(cross))
    # Power of the prior error that the received components explain, C Pyy^+ C'.
    used = received(channel, present)
    among = jnp.where(used[:, None] & used[None], signal.covariance, 0.0)
    of_used = jnp.where(used, signal.cross, 0.0)
    explained = symmetric(times(of_used, solve(among, transpose(of_used))))

    # Omega = base + shift / beta and bound + beta times what is explained, at the best beta.
    beta = smallest_scalars(zero_mean_sweep, scalar, (base, shift, power, trace(explained)))[0]
    gain, bound = gain_and_bound(prior, cross, base + shift / beta)
    return gain, bound + beta * explained


def received(channel: SecondOrder, present: jax.Array) -> jax.Array:
    """Mask (p,) of the components of the signal that act on what arrived; the others count as never measured."""
    m, p = channel.mean_gain.shape[:2]
    reached = (channel.power.center != 0) | (channel.power.radius != 0)
    parts = [[reached[i, i, a, a] & present[i] for i in range(m)] for a in range(p)]
    return jnp.stack([jnp.any(jnp.stack(rows), axis=0) for rows in parts])


def homogeneous(second: jax.Array, mean: jax.Array, last: float) -> jax.Array:
    """E[(y, 1)(y, 1)'] from E[y y'] and E[y], with `last` in the last corner."""
    column = mean[:, None]
    second = jnp.broadcast_to(second, (*second.shape[:2], *jnp.broadcast_shapes(second.shape[2:], mean.shape[1:])))
    column = jnp.broadcast_to(column, (*column.shape[:2], *second.shape[2:]))
    corner = jnp.full_like(column[:1], last)
    top = jnp.concatenate([second, column], axis=1)
    return jnp.concatenate([top, jnp.concatenate([transpose(column), corner], axis=1)])


def absent(present: jax.Array) -> jax.Array:
    """Unit variance for components that did not arrive, so that the reduced system keeps its full size."""
    return diagonal(jnp.where(present, 0.0, 1.0))


def gain_and_bound(prior: jax.Array, cross: jax.Array, omega: jax.Array) -> tuple[jax.Array, jax.Array]:
    """K = C' Omega^-1 and P - C' Omega^-1 C, which minimise P - K C - C' K' + K Omega K'.

    The difference is accurate to rounding of P alone, which the bound includes.
    """
    solved = _solved(omega, cross)
    return transpose(solved), _bound(prior, cross, solved)


def gain_and_covariance(
    prior: jax.Array,
    cross: jax.Array,
    omega: jax.Array,
    output: jax.Array,
    noise: jax.Array,
    rounded: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Gain and covariance for z = H x + noise, with H (m, n) and noise covariance N (m, m), Omega = H P H' + N.

    Where a measurement is precise, N far below Omega, the difference cancels: (1 + (m + 2) eps) P - K C is
    eps Omega / N too large. There `precise_update` uses one component after another, each with the variance `rounded`
    (m,) besides its noise. It takes several times the products, so it is computed for all runs where any needs it,
    and not otherwise; each run's numbers decide which of the two applies.
    """
    return _gain_and_covariance(prior, cross, omega, _solved(omega, cross), output, noise, rounded)


_solved = runs_last(solve)


def _difference(prior: jax.Array, cross: jax.Array, solved: jax.Array) -> jax.Array:
    return symmetric(with_rounding(prior, len(cross)) - times(transpose(cross), solved))


_bound = runs_last(_difference)


def covariance_after(
    prior: jax.Array, cross: jax.Array, omega: jax.Array, solved: jax.Array, output: jax.Array, noise: jax.Array
) -> jax.Array:
    """P+ of the gain solved' = C' Omega^-1, in the form that avoids cancellation (`gain_and_covariance`).

    Joseph form: (I - K H) P (I - K H)' + K N K', a sum of squares, which an error dK of the gain changes by
    dK Omega dK' alone.

    Source: Bucy and Joseph, Filtering for stochastic processes (1968).
    """
    return _covariance_after(prior, cross, omega, solved, output, noise)


def _covariance(
    pick: Pick,
    prior: jax.Array,
    cross: jax.Array,
    omega: jax.Array,
    solved: jax.Array,
    output: jax.Array,
    noise: jax.Array,
) -> jax.Array:
    return pick(
        is_precise(omega, noise),
        lambda: sum_of_squares(prior, root(prior), transpose(solved), output, noise),
        lambda: _difference(prior, cross, solved),
    )


_covariance_after = runs_last(partial(_covariance, where_any), partial(_covariance, where_each))


def _by_precision(
    pick: Pick,
    prior: jax.Array,
    cross: jax.Array,
    omega: jax.Array,
    solved: jax.Array,
    output: jax.Array,
    noise: jax.Array,
    rounded: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    return pick(
        is_precise(omega, noise),
        lambda: precise_update(prior, output, noise, rounded),
        lambda: (transpose(solved), _difference(prior, cross, solved)),
    )


_gain_and_covariance = runs_last(partial(_by_precision, where_any), partial(_by_precision, where_each))


def is_precise(omega: jax.Array, noise: jax.Array) -> jax.Array:
    """Test whether some component's noise, given those before it, is far below its innovation variance.

    So a combination of components that is free of noise counts, though no single component is.
    """
    return jnp.any(pivots(noise) < rounding(PRECISE, omega, 1000) * diagonal_of(omega), axis=0)
