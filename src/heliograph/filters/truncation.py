"""Moments of Gaussians cut to an interval of one combination of their components, such as limits of a state."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.factored_gaussian import Gaussian, impose_moments_of_combination
from heliograph.factors.pivots import spoil_derivatives
from heliograph.filters.event.truncated_normal import truncated_normal, upper_tail
from heliograph.numerics.trace_settings import writes_for_derivatives

PlacedLimits = tuple[tuple[int, float, float], ...]  # place, lowest and highest value of each limited component
CERTAIN = 1e-24  # a variance below this share of its mean square and of the interval's is rounding


@jax.jit
def truncate_gaussians(
    x: Gaussian, centre: jax.Array, row: jax.Array, ends: Sequence[jax.Array]
) -> tuple[jax.Array, Gaussian]:
    """Truncate Gaussians to where d'x = centre + row xi is above the first end, and below the second if there is one.

    Each of the K Gaussians is x = m + L xi, where xi has the independent variances `x.variances`; so d'x has the mean
    `centre` and the coefficients `row` = d'L. Let S be the variance of d'x, and mu and v the mean and variance of a
    standard normal number cut to the same interval. Then the mean of d'x moves by sqrt(S) mu, its variance becomes v S,
    and the law of x given d'x stays. Returns log P(d'x in the interval) (K,), -inf where d'x has no variance and lies
    outside, and the Gaussians with the moments of the cut laws.

    Shapes: x (K, n), centre (K,), row (K, n), ends (K,) each.
    """
    # S = row diag(variances) row'. Where it is only rounding (`certain`), d'x lies inside or outside for certain; the
    # deviation is 1 there, so that nothing is divided by zero.
    variance = jnp.sum(row**2 * x.variances, axis=1)
    certain = variance <= CERTAIN * (centre**2 + sum(end**2 for end in ends))
    deviation = jnp.sqrt(jnp.where(certain, 1.0, variance))
    inside = (ends[0] <= centre) & (centre <= ends[-1] if len(ends) > 1 else True)
    # log mass, mu and v of a standard normal number between both standardised ends (end - centre) / sqrt(S), or above
    # the only one.
    moments = (truncated_normal if len(ends) > 1 else upper_tail)(*((end - centre) / deviation for end in ends))
    log_mass = jnp.where(certain, jnp.where(inside, 0.0, -jnp.inf), moments.log_mass)
    # Cut only where the part inside has a probability above 0; elsewhere shift 0 and ratio 1 leave x as it is.
    changes = jnp.isfinite(log_mass) & ~certain
    shift = deviation * jnp.where(changes, moments.mean, 0.0)
    ratio = jnp.where(changes, moments.variance, 1.0)
    return log_mass, jax.vmap(impose_moments_of_combination)(x, jnp.where(changes[:, None], row, 0.0), shift, ratio)


def hold_mean_within_limits(x: Gaussian, limits: PlacedLimits) -> Gaussian:
    """Move the mean to the most likely point within each limit, one limit after another; the covariance stays.

    A limit has the component's index i, its low and its high end. The most likely point with x_i = c is
    m + P e_i (c - m_i) / P_ii. If P_ii is 0, the mean does not change.

    Source: Simon, Kalman filtering with state constraints (2010), Section 2.4, with P^-1 as weight.
    """
    mean, covariance = x.mean, x.columns
    for i, low, high in limits:
        column = covariance.matrix @ (covariance.weights * covariance.matrix[i])  # P e_i
        value = mean[i]
        nearest = jnp.clip(value, low, high)
        is_certain = column[i] <= 0
        most_likely = mean + column * ((nearest - value) / jnp.where(is_certain, 1.0, column[i]))
        mean = jnp.where(is_certain, mean, most_likely.at[i].set(nearest))
        if writes_for_derivatives():  # as P_ii goes to 0 the way into the limits depends on how it does
            is_known = column[i] <= CERTAIN * (value**2 + nearest**2)
            mean = spoil_derivatives(mean, is_known & (nearest != value))
    return x._replace(mean=mean)


def truncate_to_limits(x: Gaussian, limits: PlacedLimits) -> tuple[jax.Array, Gaussian]:
    """Condition Gaussians (K, n) on limits of their components; return log P(within) (K,) and the conditional moments.

    A limit has the component's index, its low and its high end, one of which may be infinite. For one limited component
    the moments are exact. Several are imposed one after another, each on the Gaussian after those before it. The result
    is approximate if limited components are correlated.

    Source: Simon and Simon, Constrained Kalman filtering via density function truncation (2010).
    """
    log_probability = jnp.zeros(len(x.mean))
    for i, low, high in limits:
        # `truncate_gaussians` needs a low end: x <= high is -x >= -high.
        sign = 1.0 if np.isfinite(low) else -1.0
        mean, slopes = sign * x.mean[:, i], sign * x.root[:, i]
        ends = sorted(sign * end for end in (low, high) if np.isfinite(end))
        log_mass, x = truncate_gaussians(x, mean, slopes, [jnp.full(len(x.mean), end) for end in ends])
        log_probability = log_probability + log_mass
    return log_probability, x
