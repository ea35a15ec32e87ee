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

START = 0.1  # scalars from which the search begins
SWEEPS = 200  # most steps towards the scalars; about 5 are needed
LONGEST = 5.0  # Newton step in the logarithm of a scalar: a longer one is not trusted
CONVERGED = 1e-5  # change of a logarithm after which one more Newton step leaves 1e-10 squared
LOOP = 1000  # units of rounding below which an iteration makes no progress
SMALLEST_SCALAR = 1e-12  # keeps 1/beta finite where nothing is gained by a larger one

Parts = tuple[jax.Array, ...]
Slopes = list[list[jax.Array]]  # slopes[i][j] = d log f_i / d log beta_j
Sweep = Callable[..., tuple[jax.Array, Slopes]]  # (log beta, *parts) -> log f(beta), slopes


def find_trace_minimising_scalars(sweep: Sweep, given: Array, parts: Parts) -> jax.Array:
    """Return the scalars beta of Young's inequality that minimise tr P, or those that are given.

    At the minimum beta = f(beta). Iterating f (a sweep) converges slowly, so this is Newton's method for t = log beta,
    after one sweep from START. Where a Newton step is too long the sweep itself is taken. The last step is taken
    outside the loop: its derivative is that of the root, by the implicit function theorem, in reverse mode too.

    Args:
        sweep: returns log f(beta) and its derivatives by log beta, from log beta and `parts`.
        given: the scalars (1,) or (2,) where they are fixed, which are then the result; NaN where they are to be found.
        parts: matrices of the bound, the other arguments of `sweep`.
    """
    # No derivatives inside the loop.
    fixed = jax.lax.stop_gradient(parts)
    free = jnp.isnan(given)

    def move(t: jax.Array, refined: jax.Array, slopes: Slopes) -> jax.Array:
        """Return t after a Newton step for f(t) = t, with f(t) `refined` and its derivatives `slopes`.

        A scalar that is given does not move: for it both are set so that f(t) = t.
        """
        rows = zip(free, slopes, strict=True)
        zero_if_given = [[jnp.where(is_free, slope, 0.0) for slope in row] for is_free, row in rows]
        return newton_step(t, jnp.where(free, refined, t), zero_if_given)

    def goes_on(carry: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        """Return whether a free scalar still moves, and sweeps are left.

        `carry` holds the scalars' logarithms t, the t before, and the number of sweeps done, which is at most SWEEPS.
        `free` is True for the scalars that are searched. A change up to CONVERGED, or up to the rounding of t in a
        loop, counts as none.
        """
        t, previous, sweeps = carry
        smallest_move = rounding(CONVERGED, t, LOOP)
        return (sweeps < SWEEPS) & jnp.any(free & (jnp.abs(t - previous) > smallest_move))

    def iterate(carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the next logarithms t of the scalars, the present t, and the number of sweeps done.

        `sweep` returns f(t) and its slopes. The first sweep takes f(t) itself, and the later ones Newton's step.
        """
        t, _, sweeps = carry
        refined, slopes = sweep(t, *fixed)
        return jnp.where(free & (sweeps == 0), refined, move(t, refined, slopes)), t, sweeps + 1

    # Newton's method on the logarithms, until they stay; where scalars are given it does not begin (|t - t| = 0).
    first = jnp.log(jnp.where(free, START, given))
    t, _, _ = jax.lax.while_loop(goes_on, iterate, (first, jnp.where(free, -jnp.inf, first), jnp.asarray(0)))
    # One Newton step with derivatives, dt = (I - J)^-1 df; given scalars are returned whatever it says.
    refined, slopes = sweep(t, *parts)
    return jnp.where(free, jnp.exp(move(t, refined, jax.lax.stop_gradient(slopes))), given)


def newton_step(t: jax.Array, f_of_t: jax.Array, slopes: Slopes) -> jax.Array:
    """Return t + (I - J)^-1 (f(t) - t), Newton's step for f(t) = t in one or two components.

    `slopes` are J, the derivatives of f. If the step is longer than LONGEST, 5, in a component, f(t) is returned.
    """
    residual = f_of_t - t
    if len(residual) == 1:
        step = residual / (1 - slopes[0][0])
    else:  # I - J = [a b; c d], inverted by its adjugate [d -b; -c a]
        a, b = 1 - slopes[0][0], -slopes[0][1]
        c, d = -slopes[1][0], 1 - slopes[1][1]
        step = jnp.stack([d * residual[0] - b * residual[1], a * residual[1] - c * residual[0]]) / (a * d - b * c)
    is_safe = jnp.all(jnp.abs(step) < LONGEST)
    return t + jnp.where(is_safe, step, residual)


def young_omega(beta: jax.Array, base: jax.Array, shift: jax.Array, mean_part: jax.Array) -> jax.Array:
    """Return Omega = base + (1/beta_1 + 1/beta_2) shift + (1 + beta_2) mean_part (m, m), for beta (2,).

    It bounds the covariance of what is received from a channel of uncertain law, for any positive beta_1 and beta_2.
    """
    return base + (1 / beta[0] + 1 / beta[1]) * shift + (1 + beta[1]) * mean_part


def young_fixed_point_map(
    t: jax.Array, base: jax.Array, shift: jax.Array, mean_part: jax.Array, cross_square: jax.Array, trace: jax.Array
) -> tuple[jax.Array, Slopes]:
    """Return the next log beta, and its derivatives, in the search of the beta that minimises the bound's trace.

    A channel of uncertain law makes the covariance of an update uncertain too. Young's inequality bounds it for any two
    scalars beta > 0, with Omega = base + (1 / beta_1 + 1 / beta_2) S + (1 + beta_2) M, a bound on the covariance of
    what is received. The trace is least where beta_1 = sqrt(tr(W S) / tr P) and beta_2 = sqrt(tr(W S) / tr(W M)) with
    W = Omega^-1 C' C Omega^-1, so the search repeats these with W of the last beta. By d tr(W X) =
    -2 tr(Omega^-1 dOmega W X): for d log beta_1, dOmega = -S / beta_1; for d log beta_2, dOmega = -S / beta_2 +
    beta_2 M.

    Args:
        t: log beta (2,).
        base: part of Omega that does not depend on beta, less M (m, m).
        shift: S, bound of what an unknown shift of the mean gain adds (m, m).
        mean_part: M (m, m), the part of Omega that grows with beta_2.
        cross_square: C' C of the cross-covariance C of state and measurement (m, m).
        trace: tr P of the prior.
    """
    # W; s = Omega^-1 S, m = Omega^-1 M.
    beta = jnp.exp(t)
    weight, (s, m) = _trace_weight(young_omega(beta, base, shift, mean_part), cross_square, (shift, mean_part))
    ws, wm = weight @ shift, weight @ mean_part
    shift_trace, mean_trace = jnp.trace(ws), jnp.trace(wm)
    by_first = [2 / beta[0] * jnp.vdot(s.T, x) for x in (ws, wm)]  # d tr W X / d log beta_1
    by_second = [2 / beta[1] * jnp.vdot(s.T, x) - 2 * beta[1] * jnp.vdot(m.T, x) for x in (ws, wm)]
    # The next log beta_1 = log(tr(W S) / tr P) / 2, and the next log beta_2, with their derivatives.
    first, first_slopes = _half_log_ratio(shift_trace, [by_first[0], by_second[0]], trace, [None, None])
    second, second_slopes = _half_log_ratio(
        shift_trace, [by_first[0], by_second[0]], mean_trace, [by_first[1], by_second[1]]
    )
    return jnp.stack([first, second]), [first_slopes, second_slopes]


def zero_mean_fixed_point_map(
    t: jax.Array, base: jax.Array, shift: jax.Array, cross_square: jax.Array, trace_explained: jax.Array
) -> tuple[jax.Array, Slopes]:
    """Return the next t = log beta, and its slope, in the search of the beta that minimises the bound's trace.

    beta > 0 is the free scalar of Young's inequality a b' + b a' <= beta a a' + b b' / beta, by which the filter bounds
    the covariance P after an update if correlations are unknown. The bound's trace is
    tr P - tr(Omega^-1 C' C) + beta e, with Omega = base + S / beta. It is stationary where beta^2 e = tr(W S) with W =
    Omega^-1 C' C Omega^-1. So the next beta is sqrt(tr(W S) / e), and a fixed point of this map is the minimum.

    Args:
        t: log beta (1,).
        base: the part of Omega that does not depend on beta (m, m).
        shift: S (m, m).
        cross_square: C' C of the cross-covariance C of state and measurement (m, m).
        trace_explained: e, the trace of the state's covariance that the received components explain.

    Returns:
        The next log beta, and its derivatives by t.
    """
    beta = jnp.exp(t[0])
    # W, and Omega^-1 S.
    weight, (inverse_times_shift,) = _trace_weight(base + shift / beta, cross_square, (shift,))
    # d Omega / dt = -S / beta, so that d tr(W S) / dt = (2 / beta) tr(Omega^-1 S W S).
    weighted_shift = weight @ shift
    trace, trace_slope = jnp.trace(weighted_shift), 2 / beta * jnp.vdot(inverse_times_shift.T, weighted_shift)
    # log sqrt(tr(W S) / e) = (log tr(W S) - log e) / 2; e does not depend on t.
    next_t, slopes = _half_log_ratio(trace, [trace_slope], trace_explained, [None])
    return next_t[None], [slopes]


def _trace_weight(
    omega: jax.Array, cross_square: jax.Array, matrices: Sequence[jax.Array]
) -> tuple[jax.Array, list[jax.Array]]:
    """Return W = Omega^-1 C' C Omega^-1 with C' C = cross_square, and Omega^-1 X for each X of `matrices`.

    Omega is a covariance of what is received. All matrices are (m, m), and are solved in one call.
    """
    solve = solver(omega)
    solved = solve(jnp.concatenate([cross_square, *matrices], axis=1))
    inverse_times_square, *inverse_times_others = jnp.split(solved, 1 + len(matrices), axis=1)
    return solve(inverse_times_square.T), inverse_times_others


def _half_log_ratio(
    top: jax.Array, by_top: list[jax.Array], bottom: jax.Array, by_bottom: Sequence[jax.Array | None]
) -> tuple[jax.Array, list[jax.Array]]:
    """Return v = max(log(top / bottom) / 2, log SMALLEST_SCALAR), and its derivative by each variable.

    The derivative is (top' / top - bottom' / bottom) / 2, with top' from `by_top` and bottom' from `by_bottom`. None in
    `by_bottom` means that bottom does not depend on the variable. If top or bottom is zero, v is log SMALLEST_SCALAR
    (1e-12), and wherever v is that limit the derivatives are 0. Zeros are replaced by 1 before the quotients, so that
    second derivatives exist.
    """
    is_positive = (top > 0) & (bottom > 0)
    top, bottom = jnp.where(is_positive, top, 1.0), jnp.where(is_positive, bottom, 1.0)
    value = jnp.log(top / bottom) / 2
    is_above_limit = is_positive & (value > np.log(SMALLEST_SCALAR))
    slopes = []
    for d_top, d_bottom in zip(by_top, by_bottom, strict=True):
        slope = d_top / top if d_bottom is None else d_top / top - d_bottom / bottom
        slopes.append(jnp.where(is_above_limit, slope / 2, 0.0))
    return jnp.where(is_above_limit, value, np.log(SMALLEST_SCALAR)), slopes
