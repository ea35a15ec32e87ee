"""Updates by precise measurements that give posterior variances as many digits as the prior has.

One component after another on a root of the covariance: of two precise components together, the innovation covariance
H P H' + N resolves neither their difference nor N.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.linalg import (
    PIVOT_TOLERANCE,
    PRECISE,
    diagonal,
    diagonal_of,
    identity,
    root,
    rounding,
    sum_of_squares,
    summed,
    times,
    times_vector,
    transpose,
    uncorrelated,
)
from heliograph.numerics.over_runs import runs_last
from heliograph.numerics.types import Array, Float

LEFT = 100  # times its rounding: a variance below has lost its digits


class Component(NamedTuple):
    """One component of T z, whose rows make the noises of the components uncorrelated.

    Shapes: number e_j (m,), row T H of it and its rounding in eps, size (n,), the variance of noise and rounding () and
    that of noise alone (); or of all components, one axis more. Runs last.
    """

    number: jax.Array
    row: jax.Array
    size: jax.Array
    variance: jax.Array
    noise: jax.Array


def precise_update(
    prior: jax.Array, output: jax.Array, noise: jax.Array, rounded: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """K (n, m) and P+ of z = H x + v, by its components one after another; the axis of runs is last.

    Cov v is N and, of each component, the variance `rounded` (m,) that rounding gives it.

    f = R' h', s = f' f + d, k = R f / s, R+ = R (I - f f' / (s + root(s d))); with K of all
    P+ = (I - K H) P (I - K H)' + K N K', a sum of squares, which an error dK changes by dK S dK' alone. The mean itself
    is known to its rounding alone, (n + 2) eps of each deviation: a component of which nothing else is unknown still
    corrects that, or it would grow, step by step, where P says that the state is known. The prior itself is known to
    eps |P|, with which P+ is eps |I - K H| |P| |I - K H|' off: where less than a hundred times that is left of a
    variance, as where a wide prior or a singular noise ties states together to the last digit, it has no digits, and
    so much is added to it, which is no less than what this gain leaves. So too where nothing is left, as of tied states
    behind a noise-free output: whether they are tied or all but so, such a P does not say.

    Source: Potter, in Battin, Astronautical guidance (1964); Bucy and Joseph,
    Filtering for stochastic processes (1968).
    """
    n, m = len(prior), len(output)
    runs = jnp.broadcast_shapes(prior.shape[2:], output.shape[2:], noise.shape[2:])
    # Square root of P, and the components of z with uncorrelated noises.
    start = root(prior)
    turn, components = _components(output, noise, rounded)
    nothing = jnp.zeros((n, m, *runs), start.dtype)
    unit = (n + 2) * float(np.finfo(start.dtype).eps)
    mean = jnp.broadcast_to(diagonal(unit * jnp.sqrt(jnp.maximum(diagonal_of(prior), 0.0))), (n, n, *runs))
    whole = jnp.broadcast_to(start, (n, n, *runs))
    begin = _Taken(whole, jnp.abs(whole), mean, mean, nothing, nothing)
    taken = jax.lax.scan(_use_component, begin, components)[0]
    gain = times(taken.gain, turn)
    after = sum_of_squares(prior, start, gain, output, noise) + times(gain * rounded[None], transpose(gain))
    remaining = jnp.asarray(identity(n, gain)) - times(gain, output)
    return times(taken.whole, turn), after + diagonal(_lost(prior, remaining, after))


def _components(output: jax.Array, noise: jax.Array, rounded: jax.Array) -> tuple[jax.Array, Component]:
    """T (m, m) and the components of T z, with the rounding that the elimination leaves in each row.

    T H is off by eps |T| (|H| + W |T H|), W_ji = |L_ji| and what of it cancelled, at most root(N_jj N_ii) / D_i, for
    i < j: what an error of eps in N = L D L' changes in L_ji, and none where outputs have noises of their own. Noises
    that are tied leave small D_i, as does the power of a random gain and a mean far from zero; no D_i is below what
    rounding alone gives to the component.
    """
    m = len(output)
    ones = jnp.broadcast_to(identity(m, output), (m, m, *output.shape[2:]))
    whole = noise + diagonal(rounded)
    turned, pivot = uncorrelated(whole, jnp.concatenate([ones, output], axis=1))
    turn, rows = turned[:, :m], turned[:, m:]
    deviation, safe = jnp.sqrt(jnp.maximum(diagonal_of(whole), 0.0)), jnp.where(pivot > 0, pivot, jnp.inf)
    earlier = np.tri(m, k=-1).reshape(m, m, *[1] * (noise.ndim - 2))
    tied = jnp.minimum(deviation[:, None] * deviation[None], times(jnp.abs(whole), transpose(jnp.abs(turn))))
    size = times(jnp.abs(turn), jnp.abs(output) + times(earlier * (tied / safe[None]), jnp.abs(rows)))
    eps = float(np.finfo(output.dtype).eps)
    # Variance of each component: by its noise, where that is more than rounding of the noises of z, and by rounding.
    square, spread = turn * turn, times(turn, root(noise))
    fresh = summed(spread * spread, 1)
    fresh = jnp.where(fresh > (LEFT * eps) ** 2 * times_vector(square, diagonal_of(noise)), fresh, 0.0)
    variance = jnp.maximum(pivot, times_vector(square, rounded))
    return turn, Component(jnp.asarray(identity(m, output)), rows, size, variance, fresh)


def _lost(prior: jax.Array, remaining: jax.Array, after: jax.Array) -> jax.Array:
    """A hundred times eps |I - K H| |P| |I - K H|' where less is left of a variance."""
    eps, remaining = float(np.finfo(prior.dtype).eps), jnp.abs(remaining)
    lost = LEFT * eps * summed(times(remaining, jnp.abs(prior)) * remaining, 1)
    return jnp.where(lost <= diagonal_of(after), 0.0, lost)


class _Taken(NamedTuple):
    """State after some components: roots of P and of the mean's rounding, R (n, n), and two gains of T z (n, m).

    doubt and blur: rounding of the two roots, in eps (n, n); gain: of components of which more than rounding was
    unknown, which P+ is made of; whole: of all.
    """

    root: jax.Array
    doubt: jax.Array
    rounded: jax.Array
    blur: jax.Array
    gain: jax.Array
    whole: jax.Array


def _use_component(state: _Taken, component: Component) -> tuple[_Taken, None]:
    """Roots and gains with one component more."""
    before, doubt, rounded, blur, gain, whole = state
    f = times_vector(transpose(before), component.row)
    total = summed(f * f, 0) + component.variance
    # f is off by its reach, in eps; a component of which no more is left than that says nothing.
    reach, eps = times_vector(transpose(doubt), component.size), float(np.finfo(f.dtype).eps)
    off = summed(reach * reach, 0)
    used = total > ((len(before) + 2) * eps * LEFT) ** 2 * off
    safe = jnp.where(used, total, 1.0)
    shared = times_vector(before, f)
    column = jnp.where(used, shared / safe, 0.0)
    noisy = component.variance > 0
    both = jnp.where(noisy, jnp.sqrt(jnp.where(noisy, safe * component.variance, 1.0)), 0.0)
    turned = f * jnp.where(used, 1 / (safe + both), 0.0)
    news = component.number - times_vector(transpose(gain), component.row)
    # A component of which P leaves nothing unknown corrects the mean's rounding, by the root of that alone.
    g = times_vector(transpose(rounded), component.row)
    reach, blurred = (times_vector(transpose(a), component.size) for a in (jnp.abs(rounded), eps * LEFT * blur))
    size, least = summed(g * g, 0), rounding(PIVOT_TOLERANCE, g) * summed(reach * reach, 0)
    # Two outputs that say the same leave the root's rounding alone.
    least = jnp.maximum(least, summed(blurred * blurred, 0))
    corrects = ~used & (size > least)
    step = jnp.where(corrects, times_vector(rounded, g) / jnp.where(corrects, size + component.noise, 1.0), column)
    moved = step[:, None] * g[None]
    rounded, blur = rounded - moved, blur + jnp.abs(moved)
    whole = whole + step[:, None] * (component.number - times_vector(transpose(whole), component.row))[None]
    # The root is off by the part of f that is: more than before where the components before left little of this one.
    less = shared[:, None] * turned[None]
    doubt = doubt + jnp.sqrt(off / safe) * jnp.abs(less)
    return _Taken(before - less, doubt, rounded, blur, gain + column[:, None] * news[None], whole), None


def state_rounding(size: Array) -> Float[jax.Array, "n *runs"]:
    """Variance of each component of a mean by rounding alone, ((n + 2) eps)^2 E[x_i^2] of the state at the start."""
    unit = (len(size) + 2) * float(np.finfo(size.dtype).eps)
    return unit**2 * jnp.asarray(size)


def output_rounding(matrix: Array, size: Array) -> Float[jax.Array, " m"]:
    """Deviation of H x by rounding alone, (n + 2) eps |H| root E[x x'] of the state at the start: (m,).

    What a combination of outputs without noise says of a state that is known better is no measurement: by it the
    rounding of z would be divided by a deviation below it.
    """
    reach: jax.Array = jnp.abs(jnp.asarray(matrix)) @ jnp.sqrt(size)
    return (len(size) + 2) * float(np.finfo(reach.dtype).eps) * reach


def noise_rounding(mean: Array, covariance: Array) -> Float[jax.Array, " m"]:
    """Deviation of z by the rounding of its noise, 3 eps root E[v_i^2]: also where outputs share it and it cancels."""
    second = diagonal_of(jnp.asarray(covariance)) + jnp.asarray(mean) ** 2
    return 3 * float(np.finfo(second.dtype).eps) * jnp.sqrt(second)


@runs_last
def above_rounding(after: jax.Array, prior: jax.Array, size: jax.Array, precise: Array | bool = False) -> jax.Array:
    """P and, of each variance of which a precise measurement left next to nothing, what the mean cannot say.

    That is ((n + 2) eps)^2 E[x_i^2] of the state at the start, and no more than there was. Noise-free data would else
    shrink P by eps^2 a step, to where a smoother divides the rounding of an innovation by it. A moment from before all
    data at a later step will not do in place of that at the start: of an unstable plant that its inputs hold it grows
    without end; nor will the mean, on which no covariance of a linear filter depends. `precise` is true of a
    measurement that is so by its noise, where P itself, which holds rounding, shrinks by less than one.

    Shapes: after and prior (n, n), size (n,), precise ().
    """
    left, whole = diagonal_of(after), diagonal_of(prior)
    precise = precise | (left < rounding(PRECISE, after, 1000) * whole)
    least = jnp.minimum(state_rounding(size), whole)
    return after + diagonal(jnp.where(precise, jnp.maximum(least - left, 0.0), 0.0))
