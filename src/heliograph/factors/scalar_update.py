"""One scalar measurement of a Gaussian in factors, by Bierman's update of the columns of L, and several one by one."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from heliograph.factors.columns import is_positive, reciprocal_or_one
from heliograph.numerics.linalg import WRITTEN


def measure_scalar(
    root: jax.Array, d: jax.Array, f: jax.Array, noise: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Update the rows V of a root and its variances d by one scalar measurement f' xi + v; return V, d, gain K and s.

    With Var v = r, s = f' diag(d) f + r is the variance of the innovation, and K = V diag(d) f / s.

    With s_j = r + sum_{k >= j} f_k^2 d_k and w_j = sum_{k >= j} d_k f_k V_k, columns V_j of V:
    d_j+ = d_j s_{j+1} / s_j and V_j+ = V_j - (f_j / s_{j+1}) w_{j+1}. Ratios of sums of positive terms.

    Source: Bierman, Factorization methods for discrete sequential estimation (1977), Section V.3, its order reversed
    since L is lower.
    """
    product = d * f
    return measure_product(root, d, f, (product, f * product), noise)


def measure_product(
    root: jax.Array, d: jax.Array, f: jax.Array, products: tuple[jax.Array, jax.Array], noise: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Measure f' xi + v as `measure_scalar`, given diag(d) f and f_j^2 d_j: both are zero of what says nothing."""
    product, power = products
    s = lax.rev(lax.cumsum(lax.concatenate([lax.reshape(noise, (1,)), lax.rev(power, (0,))], 0)), (0,))
    after, kept, w = revise_columns(root, d, product, f, s)
    return after, kept, w * reciprocal_or_one(s[0]), s[0]


def revise_columns(
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


def measure_parts(
    measure_part: Callable[..., tuple[jax.Array, jax.Array, jax.Array]],
    root: jax.Array,
    d: jax.Array,
    least: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Measure n parts one by one, many of them in a loop: rows, variances d and gains (rows, n) after them.

    Args:
        measure_part: from the part's number, rows, variances and its entry of `least` to rows, variances and its gain.
        root: rows of x, and below them those of the n parts.
        d: variances of the columns.
        least: variance (n,) up to which a part's slopes are rounding (`carry_rounding`).
    """
    n, gains = len(least), list[jax.Array]()
    first = len(root) - n
    if n > WRITTEN:

        def body(i: jax.Array, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
            """Measure part i, and put its gain beside those of the parts before it."""
            root, d, least, gains = carry
            root, d, gain = measure_part(i, root, d, least[i])
            gains = jnp.where(np.arange(n) == i, gain[:, None], gains)
            return root, d, carry_rounding(least, gain[first:], least[i]), gains

        root, d, _, looped = lax.fori_loop(0, n, body, (root, d, least, jnp.zeros((len(root), n), root.dtype)))
        return root, d, looped
    for i in range(n):
        root, d, gain = measure_part(i, root, d, least[i])
        least = carry_rounding(least, gain[first:], least[i])
        gains.append(lax.expand_dims(gain, (1,)))
    return root, d, lax.concatenate(gains, 1)


def carry_rounding(least: jax.Array, gain: jax.Array, measured: jax.Array) -> jax.Array:
    """Return the rounding (m,) of the slopes of parts from which a measured one is taken, times its gain (m,).

    Slopes become f_j - gain_j f_i: what rounding left of f_i, of a variance `measured`, is in those of all others.
    """
    return least + gain**2 * measured
