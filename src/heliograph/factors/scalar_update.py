"""One scalar measurement of a Gaussian in factors, by Bierman's update of the columns of L, and several one by one."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from heliograph.factors.pivots import is_positive, reciprocal_or_one, spoils_what_is_known
from heliograph.factors.repeated_measurements import noise_beside_rounding, rounding_of_products
from heliograph.numerics.linalg import WRITTEN
from heliograph.numerics.trace_settings import writes_short_programs


def update_by_scalar(
    root: jax.Array, d: jax.Array, f: jax.Array, noise: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Update the rows V of a root and its variances d by one scalar measurement f' xi + v; return V, d, gain K and s.

    x = m + V xi, with uncorrelated xi of variances d (n,).
    With Var v = r, s = f' diag(d) f + r is the variance of the innovation, and K = V diag(d) f / s.

    With s_j = r + sum_{k >= j} f_k^2 d_k, w_j = sum_{k >= j} d_k f_k V_k and the columns V_j of V,
    d_j+ = d_j s_{j+1} / s_j and V_j+ = V_j - (f_j / s_{j+1}) w_{j+1}. All s_j are sums of positive terms.

    Source: Bierman, Factorization methods for discrete sequential estimation (1977), Section V.3, its order reversed
    since L is lower.
    """
    product = d * f
    return update_by_scalar_given_products(root, d, f, (product, f * product), noise)


def update_by_scalar_given_products(
    root: jax.Array, d: jax.Array, f: jax.Array, products: tuple[jax.Array, jax.Array], noise: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Measure f' xi + v of x = V xi, given the `products` d_j f_j and f_j^2 d_j, which are 0 for mere rounding.

    Returns the rows V and variances d given the measurement, its gain K = V diag(d) f / s, and the variance s of its
    innovation. `noise` is Var v.
    """
    product, power = products
    # s_j = Var v + sum_{k >= j} f_k^2 d_k, down to the variance of the noise alone; s_0 is that of the innovation.
    from_last = lax.concatenate([lax.reshape(noise, (1,)), lax.rev(power, (0,))], dimension=0)
    s = lax.rev(lax.cumsum(from_last), (0,))
    root_after, variances_after, w = update_root_columns(root, d, product, f, s)
    return root_after, variances_after, w * reciprocal_or_one(s[0]), s[0]


def update_root_columns(
    root: jax.Array, d: jax.Array, product: jax.Array, f: jax.Array, s: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return V_j - (f_j / s_{j+1}) w_{j+1}, d_j s_{j+1} / s_j and w_0, with w_j = sum_{k >= j} product_k V_k."""
    n, lower = len(d), np.tril(np.ones(root.shape, bool))
    w = lax.cumsum(lax.select(lower, root * product, jnp.zeros_like(root)), axis=1, reverse=True)
    over = reciprocal_or_one(s)  # where s is 0, so is what it divides
    # s_j and s_{j+1}, and one over each.
    s_here, s_next = lax.slice_in_dim(s, 0, n), lax.slice_in_dim(s, 1, n + 1)
    over_here, over_next = lax.slice_in_dim(over, 0, n), lax.slice_in_dim(over, 1, n + 1)
    # w_{j+1} in the place of w_j, of the rows below: what is above the diagonal of L stays zero.
    later = lax.pad(lax.slice_in_dim(w, 1, n, axis=1), jnp.zeros((), w.dtype), [(0, 0, 0), (0, 1, 0)])
    strictly = np.concatenate([lower[:, 1:], np.zeros((len(root), 1), bool)], axis=1)
    after = root - lax.select(strictly, later * (f * over_next), jnp.zeros_like(root))
    kept = lax.select(is_positive(s_here), d * (s_next * over_here), d)
    return after, kept, lax.index_in_dim(w, 0, axis=1, keepdims=False)


def update_by_parts(
    measure_part: Callable[..., tuple[jax.Array, jax.Array, jax.Array]],
    root: jax.Array,
    d: jax.Array,
    least: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Measure n parts of a vector one after another; return the rows, the variances d and the gains after them.

    Up to WRITTEN parts are written out, more are measured in a loop, so that the program stays short.

    Args:
        measure_part: from the part's number, the rows, the variances and its entry of `least` to the rows and the
            variances given the part, and its gain (rows,).
        root: rows (rows, columns) of x, and below them those of the n parts.
        d: variances (columns,).
        least: variance (n,) up to which a part's slopes are rounding (`propagate_slope_rounding`).

    Returns:
        Rows, variances, and gains (rows, n), a column for each part.
    """
    n, gains = len(least), list[jax.Array]()
    first_part = len(root) - n  # number of the row of part 0
    if n > WRITTEN:

        def measure_next(i: jax.Array, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
            """Measure part i of a vector of n, and put its gain into column i of the gains.

            `least` (n,) are the variances up to which a part's slopes are rounding. Row `first_part` is that of part 0.
            """
            root, d, least, gains = carry
            root, d, gain = measure_part(i, root, d, least[i])
            gains = jnp.where(np.arange(n) == i, gain[:, None], gains)
            return root, d, propagate_slope_rounding(least, gain[first_part:], least[i]), gains

        no_gains = jnp.zeros((len(root), n), root.dtype)
        root, d, _, all_gains = lax.fori_loop(0, n, measure_next, (root, d, least, no_gains))
        return root, d, all_gains
    for i in range(n):
        root, d, gain = measure_part(i, root, d, least[i])
        least = propagate_slope_rounding(least, gain[first_part:], least[i])
        gains.append(lax.expand_dims(gain, (1,)))
    return root, d, lax.concatenate(gains, 1)


def propagate_slope_rounding(least: jax.Array, gain: jax.Array, measured: jax.Array) -> jax.Array:
    """Return the rounding (m,) of the slopes of parts from which a measured one is taken, times its gain (m,).

    Slopes become f_j - gain_j f_i: what rounding left of f_i, of a variance `measured`, is in those of all others.
    """
    return least + gain**2 * measured


def update_by_row(
    root: jax.Array, d: jax.Array, f: jax.Array, noise: jax.Array, least: jax.Array | None
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Measure f' xi + v of x = V xi, Cov xi = diag(d); return V, d, the gain and the variance of the innovation.

    `noise` is Var v. Slopes f with a variance f' diag(d) f of at most `least` are rounding, and must not change x: then
    the noise is made so large that the measurement changes no digit. If `least` is None, the slopes are not judged.
    """
    product = d * f
    power = f * product
    if least is None:
        return update_by_scalar_given_products(root, d, f, (product, power), noise)
    is_rounding = spoils_what_is_known(jnp.sum(power), least, noise)
    noise_or_large = jnp.where(is_rounding, noise + noise_beside_rounding(len(d), least), noise)
    root, d, gain, variance = update_by_scalar_given_products(root, d, f, (product, power), noise_or_large)
    return root, d, gain, jnp.where(is_rounding, noise, variance)


Carried = tuple[jax.Array, jax.Array, jax.Array, jax.Array]
Measured = tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]


def update_by_rows(root: jax.Array, d: jax.Array, news: jax.Array, variance: jax.Array, least: jax.Array) -> Measured:
    """Measure the m rows of `root` below the n rows of the state, one after another.

    Returns the rows (n + m, n) and variances (n,) given all measurements, `news` after them, the m innovations, each
    given those before it, and the variances of the innovations.

    Args:
        root: rows (n + m, n) of L, and of the m components' slopes below.
        d: variances (n,) of the columns.
        news: the mean (n,) and below it the innovations times -1 (m,), since a gain adds the same to both.
        variance: of the components' noises (m,).
        least: variance (m,) up to which slopes are rounding.
    """
    measure = _update_by_rows_in_loop if writes_short_programs() and len(variance) > 1 else _update_by_rows_one_by_one
    return measure(root, d, news, variance, least)


def _update_by_rows_one_by_one(
    root: jax.Array, d: jax.Array, news: jax.Array, variance: jax.Array, least: jax.Array
) -> Measured:
    """Write `update_by_rows` out, row after row: the m rows of `root` below the n of the state are measured.

    `news` is the mean and, below it, the innovations times -1. `least` is the variance up to which a row's slopes count
    as rounding. The first row is not judged, since nothing was subtracted from its slopes.
    """
    n, innovations, variances = len(d), list[jax.Array](), list[jax.Array]()
    for i in range(len(variance)):
        root, d, gain, total = update_by_row(root, d, root[n + i], variance[i], least[i] if i else None)
        innovations.append(-news[n + i])
        variances.append(total)
        news = news + gain * innovations[i]
        least = propagate_slope_rounding(least, gain[n:], least[i] if i else rounding_of_products(n, total))
    return root, d, news, stack_numbers(innovations), stack_numbers(variances)


def _update_by_rows_in_loop(
    root: jax.Array, d: jax.Array, news: jax.Array, variance: jax.Array, least: jax.Array
) -> Measured:
    """Compute `update_by_rows` in a loop, which is a shorter program than `_update_by_rows_one_by_one`.

    Each turn measures the row behind the n ones of the state and then moves it behind all others, so that the next row
    to measure has the same place in every turn, and after the last one all are in their order again.
    """
    n = len(d)

    def measure_next(carry: Carried, noise: jax.Array) -> tuple[Carried, tuple[jax.Array, jax.Array]]:
        """Measure row n of the root, behind the state's n rows; return what is next, and (innovation, its variance).

        Then row n is moved behind all others, so that the next row to measure takes its place. `news` holds the mean
        and the innovations times -1. `least` holds the variances up to which slopes are rounding, -1 for the first row.
        """
        root, d, news, least = carry
        rows, d, gain, variance_of_row = update_by_row(root, d, root[n], noise, least[0])
        innovation = -news[n]
        # The first row has no rounding from rows before it, only that of its own products.
        rounding = jnp.where(least[0] < 0, rounding_of_products(n, variance_of_row), least[0])
        least = propagate_slope_rounding(least, gain[n:], rounding)
        news = news + gain * innovation
        carry = _move_row_to_end(rows, n), d, _move_row_to_end(news, n), _move_row_to_end(least, i=0)
        return carry, (innovation, variance_of_row)

    # -1 is below every variance: before the first row nothing was rounded.
    start = root, d, news, jnp.concatenate([jnp.full_like(least[:1], -1.0), least[1:]])
    (root, d, news, _), (values, totals) = lax.scan(measure_next, start, variance)
    return root, d, news, values, totals


def _move_row_to_end(rows: jax.Array, i: int) -> jax.Array:
    """Return rows with row i behind all others."""
    return jnp.concatenate([rows[:i], rows[i + 1 :], rows[i : i + 1]])


def stack_numbers(entries: list[jax.Array]) -> jax.Array:
    """Return numbers as a vector, of none an empty one."""
    return jnp.stack(entries) if entries else jnp.zeros(0)
