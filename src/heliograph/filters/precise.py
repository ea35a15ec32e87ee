"""Precise measurements: what little they leave of a variance, to as many digits as the prior has.

One component after another on a root of the covariance, since of two precise components together the innovation's
covariance H P H' + N keeps neither what tells them apart nor N.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.small_matrix import (
    UNROLL_LIMIT,
    identity,
    inner,
    own,
    pivot_scale,
    root,
    sum_of_squares,
    summed,
    times,
    transpose,
)

LEFT = 100  # times its rounding: a variance below has lost its digits


class Heard(NamedTuple):
    """After the first components of T z, whose rows make their noises uncorrelated: m + G (T z - T H m), P = R R'.

    Shapes: root R (n, n), gain G (n, m), turn T (m, m), output T H (m, n), noise T N T' (m, m); runs last.
    """

    root: jax.Array
    gain: jax.Array
    turn: jax.Array
    output: jax.Array
    noise: jax.Array


def precise_update(prior: jax.Array, output: jax.Array, noise: jax.Array) -> tuple[jax.Array, jax.Array]:
    """K (n, m) and P+ of z = H x + v, Cov v = N, by its components one after another; of runs that are last.

    f = R' h', s = f' f + d, k = R f / s, R+ = R (I - f f' / (s + root(s d))); with K of all
    P+ = (I - K H) P (I - K H)' + K N K', a sum of squares, which an error dK changes by dK S dK' alone. A component of
    which nothing but rounding is unknown is left out. The prior itself is known to eps |P|, with which P+ is
    eps |I - K H| |P| |I - K H|' off: where less than a hundred times that is left of a variance, as where a wide prior
    or a singular noise ties states together to the last digit, it has no digits, and P+ is NaN. Where no more is left
    than the square of the mean's own rounding, as of tied states behind a noise-free output, the state is known.

    Source: Potter, in Battin, Astronautical guidance (1964); Bucy and Joseph,
    Filtering for stochastic processes (1968).
    """
    n, m = len(prior), len(output)
    runs = jnp.broadcast_shapes(prior.shape[2:], output.shape[2:], noise.shape[2:])

    def over_runs(a: jax.Array) -> jax.Array:
        return jnp.broadcast_to(a.reshape(*a.shape, *[1] * (2 + len(runs) - a.ndim)), (*a.shape[:2], *runs))

    start = root(prior)
    parts = start, np.zeros((n, m)), np.eye(m), output, noise
    state = Heard(*(over_runs(jnp.asarray(a, prior.dtype)) for a in parts))
    whole = own(noise)
    sizes = times(jnp.abs(state.output), jnp.abs(state.root))
    if m > UNROLL_LIMIT:
        state = jax.lax.fori_loop(0, m, lambda j, state: _heard(state, whole, sizes, j), state)
    else:
        for j in range(m):
            state = _heard(state, whole, sizes, j)
    gain = times(state.gain, state.turn)
    after = sum_of_squares(prior, gain, output, noise)
    kept = jnp.asarray(identity(n, gain)) - times(gain, output)
    return gain, jnp.where(_has_digits(prior, start, kept, after), after, jnp.nan)


def _has_digits(prior: jax.Array, start: jax.Array, kept: jax.Array, after: jax.Array) -> jax.Array:
    """Whether each variance of P+ is well above eps |I - K H| |P| |I - K H|', or the square of the mean's rounding."""
    n, eps = len(prior), float(np.finfo(prior.dtype).eps)
    kept, left = jnp.abs(kept), own(after)
    lost, reach = summed(times(kept, jnp.abs(prior)) * kept, 1), times(kept, jnp.abs(start))
    of_mean = summed(reach * reach, 1) + own(prior)
    return jnp.all((LEFT * eps * lost <= left) | (left <= (4 * (n + 2) * eps) ** 2 * of_mean), axis=0)


def _heard(state: Heard, whole: jax.Array, sizes: jax.Array, j: int | jax.Array) -> Heard:
    """With component j too, whose noise is first taken off those after it; sizes |H| |R| (m, n) before all of them."""
    before, gain, turn, output, noise = state
    n, m, runs = len(before), len(output), [1] * (before.ndim - 2)
    scale = pivot_scale(noise[j, j], whole[j])
    variance = jnp.where(scale == 0, 0.0, noise[j, j])
    later, here = ((np.arange(m) > j).reshape(m, 1, *runs), (np.arange(m) == j).reshape(1, m, *runs))
    if m > 1:
        share = jnp.where(later, (noise[:, j] * scale**2)[:, None], 0.0)
        turn, output, noise = (part - share * part[j][None] for part in (turn, output, noise))

    row = output[j][None]
    f, reach = times(row, before), times(jnp.abs(turn[j])[None], sizes)  # what earlier ones took off left its rounding
    least = ((n + 2) * float(np.finfo(f.dtype).eps)) ** 2 * inner(reach, reach)
    total = inner(f, f) + variance
    used = total > least
    safe = jnp.where(used, total, 1.0)
    column = jnp.where(used, times(before, transpose(f)) / safe, 0.0)
    both = jnp.where(variance > 0, jnp.sqrt(jnp.where(variance > 0, safe * variance, 1.0)), 0.0)
    turned = f * jnp.where(used, 1 / (safe + both), 0.0)
    return Heard(
        before - times(times(before, transpose(f)), turned),
        gain - times(column, times(row, gain)) + column * here,
        turn,
        output,
        noise,
    )
