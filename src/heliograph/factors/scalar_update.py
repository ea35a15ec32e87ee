"""One scalar measurement of a Gaussian in factors, by Bierman's update of the columns of L, and several one by one."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from heliograph.factors.pivots import is_positive, reciprocal_or_one, share_of_sum, spoils_what_is_known
from heliograph.factors.repeated_measurements import noise_beside_rounding, rounding_of_products
from heliograph.numerics.linalg import WRITTEN, where
from heliograph.numerics.trace_settings import writes_for_derivatives, writes_short_programs

# From the part's number, the rows, the variances and its rounding variance, to rows, variances and gain given the part.
MeasurePart = Callable[[int | jax.Array, jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array, jax.Array]]


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
    """Update x = V xi, Cov xi = diag(d), by the scalar measurement z = f' xi + v, given products that may be set to 0.

    `root` is V (rows, n), `noise` is Var v, and `products` are (d_j f_j) and (f_j^2 d_j), each (n,). A caller who finds
    that the slopes f are only rounding passes zeros instead, and x does not change.

    Returns V and d given z, the gain K = V diag(d) f / s (rows,), and the innovation's variance s = f' diag(d) f + Var
    v.
    """
    product, power = products
    # s_j = Var v + sum_{k >= j} f_k^2 d_k, j = 0 ... n: s_n is the noise's variance alone, s_0 the innovation's.
    from_last = lax.concatenate([lax.reshape(noise, (1,)), lax.rev(power, (0,))], dimension=0)
    s = lax.rev(lax.cumsum(from_last), (0,))
    updated_root, updated_d, w = update_root_columns(root, d, product, f, s)
    return updated_root, updated_d, w * reciprocal_or_one(s[0]), s[0]


def update_root_columns(
    root: jax.Array, d: jax.Array, product: jax.Array, f: jax.Array, s: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the columns V_j+ and variances d_j+ of a Gaussian's factors V diag(d) V' after a rank-one change, and w_0.

    With w_j = sum_{k >= j} product_k V_k, Bierman's formulas are V_j+ = V_j - (f_j / s_{j+1}) w_{j+1} and
    d_j+ = d_j s_{j+1} / s_j. After a scalar measurement f' xi + v of x = V xi, product_k = d_k f_k and
    s_j = Var v + sum_{k >= j} f_k^2 d_k; w_0 / s_0 is then the gain.

    Args:
        root: V (rows, n), zero above its diagonal; V_j is its column j.
        d: variances d_k (n,) of the uncorrelated xi.
        product: d_k f_k (n,).
        f: slopes f_k (n,) of the measurement in xi.
        s: sums s_0 ... s_n (n + 1,), of which s_n = Var v and s_0 is the variance of the innovation.
    """
    n, is_lower = len(d), np.tril(np.ones(root.shape, bool))
    # Column j of w is w_j.
    w = lax.cumsum(lax.select(is_lower, root * product, jnp.zeros_like(root)), axis=1, reverse=True)
    reciprocal = reciprocal_or_one(s)  # where s is 0, so are the numerators over it
    s_j, s_next = lax.slice_in_dim(s, 0, n), lax.slice_in_dim(s, 1, n + 1)
    reciprocal_j, reciprocal_next = lax.slice_in_dim(reciprocal, 0, n), lax.slice_in_dim(reciprocal, 1, n + 1)
    # Column j of this is w_{j+1}; the last one is 0.
    w_next = lax.pad(lax.slice_in_dim(w, 1, n, axis=1), jnp.zeros((), w.dtype), [(0, 0, 0), (0, 1, 0)])
    # w_{j+1} is zero above row j + 1, so V stays lower triangular.
    is_strictly_lower = np.concatenate([is_lower[:, 1:], np.zeros((len(root), 1), bool)], axis=1)
    updated_root = root - lax.select(is_strictly_lower, w_next * (f * reciprocal_next), jnp.zeros_like(root))
    share = share_of_sum(s_next, f * product) if writes_for_derivatives() else s_next * reciprocal_j
    updated_d = lax.select(is_positive(s_j), d * share, d)
    return updated_root, updated_d, lax.index_in_dim(w, 0, axis=1, keepdims=False)


def update_by_parts(
    measure_part: MeasurePart,
    root: jax.Array,
    d: jax.Array,
    rounding_variance: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Measure n parts of a vector one after another; return the rows of the factor, the variances d and all gains.

    x = V xi with Cov xi = diag(d). Part i is the scalar f_i' xi, whose slopes f_i are a row below those of V, so that
    each measurement changes the slopes of the later parts like rows of V. Up to WRITTEN parts are unrolled in the
    traced program; more are measured in a loop, so that the program stays short.

    Args:
        measure_part: from the part's number, the rows, the variances and its entry of `rounding_variance` to the rows
            and the variances given the part, and its gain (rows,).
        root: rows (rows, columns) of x, and below them those of the n parts.
        d: variances (columns,).
        rounding_variance: variance f_i' diag(d) f_i (n,) up to which the slopes of part i are nothing but rounding. It
            grows with each measurement, which changes the slopes by slopes that are rounded too.

    Returns:
        Rows, variances, and gains (rows, n), a column for each part.
    """
    n, gains = len(rounding_variance), list[jax.Array]()
    first_part = len(root) - n  # number of the row of part 0
    # Many parts: a loop in the traced program.
    if n > WRITTEN:

        def measure_next(i: jax.Array, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
            """Measure part i, and put its gain into column i of the gains (rows, n)."""
            root, d, rounding_variance, gains = carry
            root, d, gain = measure_part(i, root, d, rounding_variance[i])
            gains = jnp.where(np.arange(n) == i, gain[:, None], gains)
            return root, d, propagate_slope_rounding(rounding_variance, gain[first_part:], rounding_variance[i]), gains

        no_gains = jnp.zeros((len(root), n), root.dtype)
        root, d, _, all_gains = lax.fori_loop(0, n, measure_next, (root, d, rounding_variance, no_gains))
        return root, d, all_gains
    # Few parts: the same, unrolled.
    for i in range(n):
        root, d, gain = measure_part(i, root, d, rounding_variance[i])
        rounding_variance = propagate_slope_rounding(rounding_variance, gain[first_part:], rounding_variance[i])
        gains.append(lax.expand_dims(gain, (1,)))
    return root, d, lax.concatenate(gains, 1)


def propagate_slope_rounding(rounding_variance: jax.Array, gain: jax.Array, measured: jax.Array) -> jax.Array:
    """Return the variance (m,) by rounding of the slopes of all components, after component i was measured.

    The measurement changes the slopes f_j of component j to f_j - gain_j f_i. The rounding of f_i, of variance
    `measured`, so adds gain_j^2 `measured` to that of f_j. Shapes: rounding_variance (m,) before it, gain (m,).
    """
    return rounding_variance + gain**2 * measured


def update_by_row(
    root: jax.Array, d: jax.Array, f: jax.Array, noise: jax.Array, rounding_variance: jax.Array | None
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Measure f' xi + v of x = V xi, Cov xi = diag(d); return V, d, the gain and the variance of the innovation.

    `noise` is Var v. Slopes f with a variance f' diag(d) f of at most `rounding_variance` are rounding, and must not
    change x: then the noise is made so large that the measurement changes no digit. If `rounding_variance` is None, the
    slopes are not judged.
    """
    product = d * f
    power = f * product
    if rounding_variance is None:
        return update_by_scalar_given_products(root, d, f, (product, power), noise)
    is_rounding = spoils_what_is_known(jnp.sum(power), rounding_variance, noise)
    noise_or_large = where(is_rounding, noise + noise_beside_rounding(len(d), rounding_variance), noise)
    root, d, gain, variance = update_by_scalar_given_products(root, d, f, (product, power), noise_or_large)
    return root, d, gain, where(is_rounding, noise, variance)


Carried = tuple[jax.Array, jax.Array, jax.Array, jax.Array]  # rows, variances d, means, rounding variances
Measured = tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]  # rows, d, means, innovations, their variances


def update_by_rows(
    root: jax.Array, d: jax.Array, means: jax.Array, variance: jax.Array, rounding_variance: jax.Array
) -> Measured:
    """Condition a state on m scalar measurements with uncorrelated noises, one after another.

    The state is x = m + L xi, and component i is z_i = E z_i + f_i' xi + v_i. Measuring one changes the factor's rows L
    and the slopes f of the others by the same formula, so they are the rows of one `root`.

    Returns the rows (n + m, n), variances (n,) and means (n + m,) given all measurements, the m innovations, each given
    those before it, and the variances of the innovations.

    Args:
        root: rows (n + m, n) of L, and of the m components' slopes below.
        d: variances (n,) of the columns.
        means: of x (n,), and below it of each component minus its measured value, the innovation times -1 (m,).
        variance: of the components' noises (m,).
        rounding_variance: variance (m,) up to which slopes are rounding.
    """
    measure = _update_by_rows_in_loop if writes_short_programs() and len(variance) > 1 else _update_by_rows_one_by_one
    return measure(root, d, means, variance, rounding_variance)


def _update_by_rows_one_by_one(
    root: jax.Array, d: jax.Array, means: jax.Array, variance: jax.Array, rounding_variance: jax.Array
) -> Measured:
    """Measure the m rows of `root` below the state's n rows, written out row after row.

    Arguments and results are those of `update_by_rows`: `means` has the state's mean and, below it, the innovations
    times -1; `rounding_variance` is the variance up to which a row's slopes count as rounding. The first row's slopes
    never do, since nothing was subtracted from them.
    """
    n, innovations, variances = len(d), list[jax.Array](), list[jax.Array]()
    for i in range(len(variance)):
        root, d, gain, innovation_variance = update_by_row(
            root, d, root[n + i], variance[i], rounding_variance[i] if i else None
        )
        innovations.append(-means[n + i])
        variances.append(innovation_variance)
        means = means + gain * innovations[i]
        rounding_variance = propagate_slope_rounding(
            rounding_variance, gain[n:], rounding_variance[i] if i else rounding_of_products(n, innovation_variance)
        )
    return root, d, means, stack_numbers(innovations), stack_numbers(variances)


def _update_by_rows_in_loop(
    root: jax.Array, d: jax.Array, means: jax.Array, variance: jax.Array, rounding_variance: jax.Array
) -> Measured:
    """Compute `update_by_rows` in a loop, which is a shorter program than `_update_by_rows_one_by_one`.

    A Kalman update by m scalar measurements, one after another. The state is x = mean + L xi with Cov xi = diag(d), and
    measurement i has the slope f_i: z_i = E z_i + f_i' xi + v_i. `root` (n + m, n) has the n rows of L and the m slopes
    below, `means` (n + m,) the state's mean and the innovations times -1, since one formula updates both; `variance`
    (m,) has the variances of v, and `rounding_variance` (m,) those up to which slopes are rounding.

    Each iteration measures row n, the first one below the state's n rows, and then moves it to the end. So the row to
    measure always has the index n, and after the last iteration all rows are in their first order again.
    """
    n = len(d)

    def measure_next(carry: Carried, noise: jax.Array) -> tuple[Carried, tuple[jax.Array, jax.Array]]:
        """Measure row n of the root and move it to the end; return the next carry, and (innovation, its variance).

        `means` holds the state's mean and the innovations times -1. `rounding_variance` holds the variances up to which
        slopes are rounding, -1 for the first row.
        """
        root, d, means, rounding_variance = carry
        # Gain K of all rows, S = f diag(d) f' + noise, and the rows and d given this measurement.
        rows, d, gain, variance_of_row = update_by_row(root, d, root[n], noise, rounding_variance[0])
        innovation = -means[n]
        # The first row has no rounding from earlier rows, only that of its own products.
        rounding = jnp.where(rounding_variance[0] < 0, rounding_of_products(n, variance_of_row), rounding_variance[0])
        rounding_variance = propagate_slope_rounding(rounding_variance, gain[n:], rounding)
        means = means + gain * innovation
        carry = _move_row_to_end(rows, n), d, _move_row_to_end(means, n), _move_row_to_end(rounding_variance, i=0)
        return carry, (innovation, variance_of_row)

    # -1 is below every variance: before the first row nothing was rounded.
    start = root, d, means, jnp.concatenate([jnp.full_like(rounding_variance[:1], -1.0), rounding_variance[1:]])
    (root, d, means, _), (values, totals) = lax.scan(measure_next, start, variance)
    return root, d, means, values, totals


def _move_row_to_end(rows: jax.Array, i: int) -> jax.Array:
    """Return the rows in a new order: row i is the last, all others stay in their order."""
    return jnp.concatenate([rows[:i], rows[i + 1 :], rows[i : i + 1]])


def stack_numbers(entries: list[jax.Array]) -> jax.Array:
    """Return a list of numbers () as a vector; `jnp.stack` refuses an empty list, of which it is an empty one."""
    return jnp.stack(entries) if entries else jnp.zeros(0)
