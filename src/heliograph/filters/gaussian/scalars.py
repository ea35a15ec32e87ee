"""Scalars of Young's inequality that minimise a bound, by Newton's method on their logarithms.

At the least trace each scalar is a ratio of traces that the gain decides, beta = f(beta): with W = K' K of the gain
for beta, tr(K S K') = tr(W S). A sweep gives log f and its slopes; both follow from W and Omega^-1 S, since for dOmega
tr(dW X) = -2 tr(Omega^-1 dOmega W X).
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.linalg import rounding, solver
from heliograph.numerics.types import Array

START = 0.1
SWEEPS = 200  # most steps towards the scalars; about 5 are needed
LONGEST = 5.0  # Newton step in the logarithm of a scalar: a longer one is not trusted
CONVERGED = 1e-5  # change of a logarithm after which one more Newton step leaves 1e-10 squared
LOOP = 1000  # units of rounding below which an iteration makes no progress
SMALLEST_SCALAR = 1e-12  # keeps 1/beta finite where nothing is gained by a larger one

Parts = tuple[jax.Array, ...]
Slopes = list[list[jax.Array]]  # slopes[i][j] = d log f_i / d log beta_j
Sweep = Callable[..., tuple[jax.Array, Slopes]]  # (log beta, *parts) -> log f(beta), slopes


def trace_minimising_scalars(sweep: Sweep, given: Array, parts: Parts) -> jax.Array:
    """Return the scalars of Young's inequality of least tr P: Newton's method on log beta; those that are given stay.

    Alternating minimisation converges slowly, so this is Newton's method, after one sweep from START. Where a Newton
    step is too long the sweep itself is taken. The last step is taken outside the loop: its derivative is that of the
    root, by the implicit function theorem, in reverse mode too.
    """
    # No derivatives inside the loop.
    fixed = jax.lax.stop_gradient(parts)
    free = jnp.isnan(given)

    def has_moved(t: jax.Array, previous: jax.Array) -> jax.Array:
        return jnp.any(free & (jnp.abs(t - previous) > rounding(CONVERGED, t, LOOP)))

    def iterate(carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        t, _, sweeps = carry
        refined, slopes = sweep(t, *fixed)
        return jnp.where(sweeps == 0, refined, newton_step(t, refined, slopes)), t, sweeps + 1

    # Newton's method on the logarithms, until they stay.
    first = jnp.log(jnp.where(free, START, given))
    carry = first, jnp.where(free, -jnp.inf, first), jnp.asarray(0)
    t = jax.lax.while_loop(lambda c: (c[2] < SWEEPS) & has_moved(c[0], c[1]), iterate, carry)[0]
    # One Newton step with derivatives: dt = (I - J)^-1 df.
    refined, slopes = sweep(t, *parts)
    return jnp.where(free, jnp.exp(newton_step(t, refined, jax.lax.stop_gradient(slopes))), given)


def newton_step(t: jax.Array, refined: jax.Array, slopes: Slopes) -> jax.Array:
    """Return t + (I - J)^-1 (f(t) - t) for one or two components."""
    rest = refined - t
    if len(rest) == 1:
        step = rest / (1 - slopes[0][0])
    else:
        (a, b), (c, d) = (1 - slopes[0][0], -slopes[0][1]), (-slopes[1][0], 1 - slopes[1][1])
        step = jnp.stack([d * rest[0] - b * rest[1], a * rest[1] - c * rest[0]]) / (a * d - b * c)
    safe = jnp.all(jnp.abs(step) < LONGEST)
    return t + jnp.where(safe, step, rest)


def young_omega(beta: jax.Array, base: jax.Array, shift: jax.Array, mean_part: jax.Array) -> jax.Array:
    """Return Omega = base + (1/beta_1 + 1/beta_2) shift + (1 + beta_2) mean_part."""
    return base + (1 / beta[0] + 1 / beta[1]) * shift + (1 + beta[1]) * mean_part


def young_fixed_point_map(
    t: jax.Array, base: jax.Array, shift: jax.Array, mean_part: jax.Array, power: jax.Array, whole: jax.Array
) -> tuple[jax.Array, Slopes]:
    """Map log beta to its next value: beta_1 = sqrt(tr W S / tr P), beta_2 = sqrt(tr W S / tr W M); with slopes."""
    beta = jnp.exp(t)
    weight, (s, m) = _trace_weight(young_omega(beta, base, shift, mean_part), power, (shift, mean_part))
    ws, wm = weight @ shift, weight @ mean_part
    shift_trace, mean_trace = jnp.trace(ws), jnp.trace(wm)
    by_first = [2 / beta[0] * jnp.vdot(s.T, x) for x in (ws, wm)]  # d tr W X / d log beta_1
    by_second = [2 / beta[1] * jnp.vdot(s.T, x) - 2 * beta[1] * jnp.vdot(m.T, x) for x in (ws, wm)]
    first, first_slopes = _root_ratio(shift_trace, [by_first[0], by_second[0]], whole, [None, None])
    second, second_slopes = _root_ratio(
        shift_trace, [by_first[0], by_second[0]], mean_trace, [by_first[1], by_second[1]]
    )
    return jnp.stack([first, second]), [first_slopes, second_slopes]


def zero_mean_fixed_point_map(
    t: jax.Array, base: jax.Array, shift: jax.Array, power: jax.Array, whole: jax.Array
) -> tuple[jax.Array, Slopes]:
    """Map t = log beta to its next value, in the search of the beta that minimises the bound's trace.

    The trace is tr P - tr(Omega^-1 power) + beta whole, Omega = base + S / beta, S = shift. It is stationary where
    beta^2 whole = tr(W S), W = Omega^-1 power Omega^-1: the next beta is sqrt(tr(W S) / whole).

    Args:
        t: log beta (1,).
        base: what Omega has beside S / beta (m, m).
        shift: S (m, m).
        power: C' C of the cross-covariance C of state and measurement (m, m).
        whole: trace of what the received components explain of the state.

    Returns:
        The next log beta, and its derivatives by t.
    """
    beta = jnp.exp(t[0])
    weight, (s,) = _trace_weight(base + shift / beta, power, (shift,))
    ws = weight @ shift
    refined, slopes = _root_ratio(jnp.trace(ws), [2 / beta * jnp.vdot(s.T, ws)], whole, [None])
    return refined[None], [slopes]


def _trace_weight(omega: jax.Array, power: jax.Array, others: Sequence[jax.Array]) -> tuple[jax.Array, list[jax.Array]]:
    """W = Omega^-1 C C' Omega^-1 of K = C' Omega^-1, and Omega^-1 X of others: in matrices of the data's size."""
    solve = solver(omega)
    first, *rest = jnp.split(solve(jnp.concatenate([power, *others], axis=1)), 1 + len(others), axis=1)
    return solve(first.T), rest


def _root_ratio(
    top: jax.Array, by_top: list[jax.Array], bottom: jax.Array, by_bottom: Sequence[jax.Array | None]
) -> tuple[jax.Array, list[jax.Array]]:
    """Return log root(top / bottom), at least log SMALLEST_SCALAR, also where both are zero; and its slopes.

    The slopes are (top' / top - bottom' / bottom) / 2 by each variable, `by_bottom` None where bottom does not depend
    on it, and 0 at the limit. No quotient or root of zero is taken, so that derivatives exist.
    """
    some = (top > 0) & (bottom > 0)
    top, bottom = jnp.where(some, top, 1.0), jnp.where(some, bottom, 1.0)
    value = jnp.log(top / bottom) / 2
    free = some & (value > np.log(SMALLEST_SCALAR))
    slopes = [p / top if w is None else p / top - w / bottom for p, w in zip(by_top, by_bottom, strict=True)]
    return jnp.where(free, value, np.log(SMALLEST_SCALAR)), [jnp.where(free, slope / 2, 0.0) for slope in slopes]
