"""The arithmetic of an update behind an uncertain channel: gain, bound, and the scalars that make the bound smallest.

Notation as in `update`: e prior error with covariance P, y = yhat + e_y the sensor's signal, z = G y + n what arrives.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import array, fail
from heliograph.numerics.small_matrix import (
    congruence,
    diagonal,
    inner,
    rounding,
    runs_last,
    solve,
    symmetric,
    times,
    trace,
    transpose,
    with_rounding,
)
from heliograph.random_affine.second_moments import SecondOrder

SWEEPS = 200  # most steps towards the scalars; about 5 are needed
LONGEST = 5.0  # Newton step in the logarithm of a scalar: a longer one is not trusted
SETTLED = 1e-8  # relative change of the scalars; the trace is flat there, so its error is of second order
LOOP = 1000  # units of rounding below which an iteration makes no progress
SMALLEST_SCALAR = 1e-12  # keeps 1/beta finite where nothing is gained by a larger one


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


@runs_last
def young_correction(
    prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array, scalars: Scalars | None
) -> tuple[jax.Array, jax.Array]:
    """The update of `Polytope` for any description of the channel."""
    w = homogeneous(signal.second, signal.mean, 1.0)
    both = present[:, None] & present[None, :]
    mean_part = jnp.where(both, congruence(channel.mean_gain, signal.covariance), 0.0)
    cross = jnp.where(present[:, None], times(channel.mean_gain, transpose(signal.cross)), 0.0)
    if not channel.uncertain:
        return gain_and_bound(prior, cross, channel.spread.middle(w, present) + absent(present) + mean_part)
    base = channel.spread(w, present) + absent(present)
    shift, power = channel.shift(w, present), times(cross, transpose(cross))

    def omega(beta: jax.Array) -> jax.Array:
        return base + (1 / beta[0] + 1 / beta[1]) * shift + (1 + beta[1]) * mean_part

    def refine(beta: jax.Array) -> jax.Array:
        weight = gain_weight(omega(beta), power)
        moved = inner(weight, shift)
        return jnp.stack([root_ratio(moved, trace(prior)), root_ratio(moved, inner(weight, mean_part))])

    beta = settle(refine, [0.1, 0.1], trace(power)) if scalars is None else jnp.asarray(scalars.values)
    gain, bound = gain_and_bound(prior, cross, omega(beta))
    return gain, bound + beta[0] * prior


@runs_last
def zero_mean_correction(
    prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array, scalar: jax.Array | np.ndarray | None
) -> tuple[jax.Array, jax.Array]:
    """The update of `ZeroMean`."""
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

    def omega(beta: jax.Array) -> jax.Array:
        return base + shift / beta

    def refine(beta: jax.Array) -> jax.Array:
        moved = inner(gain_weight(omega(beta[0]), power), shift)
        return root_ratio(moved, trace(explained))[None]

    beta = settle(refine, [0.1], trace(power))[0] if scalar is None else jnp.asarray(scalar)
    gain, bound = gain_and_bound(prior, cross, omega(beta))
    return gain, bound + beta * explained


def heard(channel: SecondOrder, present: jax.Array) -> jax.Array:
    """Which components of the signal have a part in what arrived: the others say nothing, as if never measured."""
    m, p = channel.mean_gain.shape[:2]
    reached = (channel.power.center != 0) | (channel.power.radius != 0)
    parts = [[reached[i, i, a, a] & present[i] for i in range(m)] for a in range(p)]
    return jnp.stack([jnp.any(jnp.stack(rows), axis=0) for rows in parts])


def gain_weight(omega: jax.Array, power: jax.Array) -> jax.Array:
    """K' K = Omega^-1 C C' Omega^-1 of K = C' Omega^-1: tr(K S K') = tr(K' K S), in matrices of the data's size."""
    return solve(omega, transpose(solve(omega, power)))


def root_ratio(part: jax.Array, whole: jax.Array) -> jax.Array:
    """sqrt(part / whole), at least SMALLEST_SCALAR, which it is where nothing arrives and both are zero.

    No quotient or root of zero is taken, so that there are derivatives.
    """
    some = (part > 0) & (whole > 0)
    ratio = jnp.where(some, part, 0.0) / jnp.where(some, whole, 1.0)
    return jnp.sqrt(jnp.maximum(ratio, SMALLEST_SCALAR**2))


def settle(refine: Callable[[jax.Array], jax.Array], start: list[float], like: jax.Array) -> jax.Array:
    """Scalars (count, runs) that `refine` leaves as they are, each run's own.

    Alternating minimisation creeps, so this is Newton's method on t = log refine(exp t), from one sweep after `start`.
    Where a step leads astray the sweep itself is taken; a run that has settled is left as it is. The derivative is that
    of the root, by the implicit function theorem, so that the loop has one in reverse too.
    """

    def moving(t: jax.Array, previous: jax.Array) -> jax.Array:
        return jnp.any(jnp.abs(t - previous) > rounding(SETTLED, t, LOOP), axis=0)

    def sweep(carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        t, previous, sweeps = carry
        return jnp.where(moving(t, previous), _newton(log_refine, t), t), t, sweeps + 1

    def log_refine(t: jax.Array) -> jax.Array:
        return jnp.log(refine(jnp.exp(t)))

    def search(_: object, t: jax.Array) -> jax.Array:
        carry = log_refine(t), t, jnp.asarray(1)
        return jax.lax.while_loop(lambda c: (c[2] < SWEEPS) & jnp.any(moving(c[0], c[1])), sweep, carry)[0]

    first = jnp.stack([jnp.full_like(like, np.log(value)) for value in start])
    root: jax.Array = jax.lax.custom_root(lambda t: log_refine(t) - t, first, search, _solved_by_slopes)
    return jnp.exp(root)


def _newton(function: Callable[[jax.Array], jax.Array], t: jax.Array) -> jax.Array:
    """t + (I - J)^-1 (f(t) - t) for one or two components."""
    rest = function(t) - t
    step = _solved_by_slopes(lambda v: v - jax.jvp(function, (t,), (v,))[1], rest)
    safe = jnp.all(jnp.abs(step) < LONGEST, axis=0)
    return t + jnp.where(safe, step, rest)


def _solved_by_slopes(linear: Callable[[jax.Array], jax.Array], right: jax.Array) -> jax.Array:
    """x with linear(x) = right for one or two components, each run's own; `linear` is read off at unit vectors."""
    columns = [linear(jnp.zeros_like(right).at[i].set(1.0)) for i in range(len(right))]
    if len(right) == 1:
        return jnp.asarray(right / columns[0])
    (a, c), (b, d) = columns
    return jnp.asarray(jnp.stack([d * right[0] - b * right[1], a * right[1] - c * right[0]]) / (a * d - b * c))


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
