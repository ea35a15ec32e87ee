"""Updates by precise measurements that give posterior variances as many digits as the prior has.

One component after another on a root of the covariance: of two precise components together, the innovation covariance
H P H' + N resolves neither their difference nor N.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.small_matrix import (
    diagonal_of,
    identity,
    root,
    sum_of_squares,
    summed,
    times,
    times_vector,
    transpose,
    uncorrelated,
)

LEFT = 100  # times its rounding: a variance below has lost its digits


class Component(NamedTuple):
    """One component of T z, whose rows make the noises of the components uncorrelated.

    Shapes: number e_j (m,) and row T H of it (n,), the noise's variance (), least variance that is not rounding (); for
    all components, one more axis first. The axis of runs is last.
    """

    number: jax.Array
    row: jax.Array
    variance: jax.Array
    least: jax.Array


def precise_update(prior: jax.Array, output: jax.Array, noise: jax.Array) -> tuple[jax.Array, jax.Array]:
    """K (n, m) and P+ of z = H x + v, Cov v = N, by its components one after another; the axis of runs is last.

    f = R' h', s = f' f + d, k = R f / s, R+ = R (I - f f' / (s + root(s d))); with K of all components
    P+ = (I - K H) P (I - K H)' + K N K', a sum of squares, which an error dK changes by dK S dK' alone. A component
    whose innovation variance is rounding is left out. The prior is accurate to eps |P|, which makes P+ uncertain by
    eps |I - K H| |P| |I - K H|': where less than a hundred times that is left of a variance, as where a wide prior or a
    singular noise ties states together to the last digit, it has no digits, and P+ is NaN. Where no more is left than
    the square of the mean's rounding, as of tied states behind a noise-free output, the state is known.

    Source: Potter, in Battin, Astronautical guidance (1964); Bucy and Joseph,
    Filtering for stochastic processes (1968).
    """
    n, m = len(prior), len(output)
    runs = jnp.broadcast_shapes(prior.shape[2:], output.shape[2:], noise.shape[2:])
    # Square root of P, and the components of z with uncorrelated noises.
    start = root(prior)
    turn, components = _components(start, output, noise)
    begin = jnp.broadcast_to(start, (n, n, *runs)), jnp.zeros((n, m, *runs), start.dtype)
    # One component after another; the gain of T z, then that of z.
    gain = times(jax.lax.scan(_use_component, begin, components)[0][1], turn)
    # Joseph form with the gain of all components.
    after = sum_of_squares(prior, start, gain, output, noise)
    remaining = jnp.asarray(identity(n, gain)) - times(gain, output)
    return gain, jnp.where(_has_digits(prior, start, remaining, after), after, jnp.nan)


def _components(start: jax.Array, output: jax.Array, noise: jax.Array) -> tuple[jax.Array, Component]:
    """T (m, m) and the components of T z, with the rounding that the elimination leaves in each row."""
    m, n = output.shape[:2]
    ones = jnp.broadcast_to(identity(m, output), (m, m, *output.shape[2:]))
    turned, variance = uncorrelated(noise, jnp.concatenate([ones, output], axis=1))
    turn, rows = turned[:, :m], turned[:, m:]
    reach = times(jnp.abs(turn), times(jnp.abs(output), jnp.abs(start)))
    least = ((n + 2) * float(np.finfo(start.dtype).eps)) ** 2 * summed(reach * reach, 1)
    return turn, Component(jnp.asarray(identity(m, output)), rows, variance, least)


def _has_digits(prior: jax.Array, start: jax.Array, remaining: jax.Array, after: jax.Array) -> jax.Array:
    """Test whether each variance of P+ is well above eps |I - K H| |P| |I - K H|', or the mean's rounding squared."""
    n, eps = len(prior), float(np.finfo(prior.dtype).eps)
    remaining, left = jnp.abs(remaining), diagonal_of(after)
    lost, reach = summed(times(remaining, jnp.abs(prior)) * remaining, 1), times(remaining, jnp.abs(start))
    of_mean = summed(reach * reach, 1) + diagonal_of(prior)
    return jnp.all((LEFT * eps * lost <= left) | (left <= (4 * (n + 2) * eps) ** 2 * of_mean), axis=0)


def _use_component(state: tuple[jax.Array, jax.Array], item: Component) -> tuple[tuple[jax.Array, jax.Array], None]:
    """Root R (n, n) and gain G (n, m), m + G (T z - T H m), with one more component."""
    before, gain = state
    f = times_vector(transpose(before), item.row)
    total = summed(f * f, 0) + item.variance
    used = total > item.least
    safe = jnp.where(used, total, 1.0)
    shared = times_vector(before, f)
    column = jnp.where(used, shared / safe, 0.0)
    noisy = item.variance > 0
    both = jnp.where(noisy, jnp.sqrt(jnp.where(noisy, safe * item.variance, 1.0)), 0.0)
    turned = f * jnp.where(used, 1 / (safe + both), 0.0)
    news = item.number - times_vector(transpose(gain), item.row)
    return (before - shared[:, None] * turned[None], gain + column[:, None] * news[None]), None
