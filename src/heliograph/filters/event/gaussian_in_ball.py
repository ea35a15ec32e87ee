"""Log probability, mean and covariance of a Gaussian that is known to lie in a ball, or outside of it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, eliminate, join_columns, zero_covariance
from heliograph.factors.factored_gaussian import Gaussian, condition_on_observation, from_columns
from heliograph.filters.event.gaussian_sum import GaussianSum
from heliograph.filters.event.truncated_normal import truncated_normal, upper_tail
from heliograph.filters.truncation import CERTAIN
from heliograph.numerics.lapack import eigh

MOST_COMPONENTS = 3  # nodes are a grid over all but one of them
REACH = 9.0  # deviations from the centre beyond which there is no probability that counts
NODES, WEIGHTS = (array / 2 for array in np.polynomial.legendre.leggauss(32))
NODES = NODES + 0.5  # on (0, 1)


class BallMoments(NamedTuple):
    """Moments of a Gaussian vector e in a region: log_mass is log P(e in it); mean (m,) and covariance (m, m) there."""

    log_mass: jax.Array
    mean: jax.Array
    covariance: jax.Array


def ball_moments(centre: jax.Array, variance: jax.Array, radius: jax.Array, inside: bool) -> BallMoments:
    """Return log probability, mean and covariance of independent e_i ~ N(centre_i, variance_i) in a ball or outside.

    This is a recursion on the components. Given e_1 = radius sin(t), the others lie in (or outside) a ball with the
    radius radius cos(t), so one component less is left. A single component is a truncated normal number. The integral
    over t is a sum over 32 Gauss-Legendre nodes. Its terms are joined like the components of a mixture, so that no
    variance is negative.

    Args:
        centre: means (m,).
        variance: variances (m,), positive.
        radius: of the ball about 0, ().
        inside: |e| <= radius; else |e| > radius.
    """
    if len(centre) == 1:
        return _join_pieces(_truncate_component(centre[0], variance[0], radius, inside))
    pieces = _slice_by_first_component(centre, variance, radius, inside)
    if not inside:
        pieces = _append_outer_tails(pieces, centre, variance, radius)
    return _join_pieces(pieces)


def _slice_by_first_component(centre: jax.Array, variance: jax.Array, radius: jax.Array, inside: bool) -> BallMoments:
    """Return the moments of e ~ N(centre, diag(variance)), inside or outside the ball |e| <= radius, at nodes of e_1.

    Slices of the ball at fixed e_1 are balls of one dimension less, so moments in m dimensions follow from those in
    m - 1 by quadrature over e_1. With e_1 = radius sin(t) and density p of e_1, the mass where |e_1| <= radius is the
    integral over t of

        p(e_1) (de_1 / dt) P(the other components lie inside, or outside, the ball of radius sqrt(radius^2 - e_1^2))

    At a node t, e_1 has no variance. The log mass (32,) holds the node's term of this sum, mean is (32, m) and
    covariance (32, m, m).
    """
    # Integrate where e_1 has its probability: within REACH deviations of the point of [-radius, radius] that is nearest
    # to its mean. The nodes t and weights are those of a quadrature on [0, 1].
    mean_1, deviation = centre[0], jnp.sqrt(variance[0])
    nearest = jnp.clip(mean_1, -radius, radius)
    low, high = (jnp.arcsin(jnp.clip((nearest + side * REACH * deviation) / radius, -1.0, 1.0)) for side in (-1.0, 1.0))
    t = low + (high - low) * NODES
    e_1 = radius * jnp.sin(t)
    # The other components given e_1: sqrt(radius^2 - e_1^2) = radius cos(t).
    others = jax.lax.map(lambda r: ball_moments(centre[1:], variance[1:], r, inside), radius * jnp.cos(t))
    # log of (quadrature weight) (de_1 / dt) p(e_1), with de_1 / dt = radius cos(t).
    weight = jnp.log(WEIGHTS * (high - low) * radius * jnp.cos(t) / deviation) - np.log(2 * np.pi) / 2
    weight = weight - ((e_1 - mean_1) / deviation) ** 2 / 2
    # Moments of e at each node: e_1 is known, the others have theirs.
    mean = jnp.concatenate([e_1[:, None], others.mean], axis=1)
    m = len(variance)
    covariance = jnp.zeros((len(t), m, m)).at[:, 1:, 1:].set(others.covariance)
    return BallMoments(weight + others.log_mass, mean, covariance)


def _append_outer_tails(pieces: BallMoments, centre: jax.Array, variance: jax.Array, radius: jax.Array) -> BallMoments:
    """Append the moments of e where e_1 < -radius and where e_1 > radius: there the other components lie anywhere.

    `pieces` are the moments (piece, ...) of e ~ N(centre, diag(variance)) outside the ball where |e_1| <= radius.
    """
    tails = _truncate_component(centre[0], variance[0], radius, inside=False)
    mean = jnp.concatenate([tails.mean, jnp.broadcast_to(centre[1:], (2, len(centre) - 1))], axis=1)
    covariance = jnp.broadcast_to(jnp.diag(variance), (2, *variance.shape * 2))
    covariance = covariance.at[:, 0, 0].set(tails.covariance[:, 0, 0])
    outer_pieces = BallMoments(tails.log_mass, mean, covariance)
    return BallMoments(
        *(jnp.concatenate(pieces_and_tails) for pieces_and_tails in zip(pieces, outer_pieces, strict=True))
    )


def truncate_to_ball(mixture: GaussianSum, directions: jax.Array, radius: jax.Array, inside: bool) -> GaussianSum:
    """Return the sum with each Gaussian x of N components cut to |D x| <= radius, or to |D x| > radius.

    A cut Gaussian is replaced by the Gaussian of the same mean and covariance, and its weight is multiplied by the
    probability of the region. With Cov(D x) = V diag(s) V', e = V' D x has independent components with moments E e and
    Cov e in the region, and x = m + K (e - V' D m) + rest, K = Cov(x, e) diag(s)^-1, the rest independent of e. So
    the mean becomes m + K (E e - V' D m), and the covariance Cov(x | e) + K Cov(e) K'.

    Args:
        mixture: the sum of K Gaussians.
        directions: D (m, N).
        radius: radius of the ball, a number.
        inside: True for |D x| <= radius, else |D x| > radius.
    """

    def truncate_one(x: Gaussian) -> tuple[jax.Array, Gaussian]:
        """Return the log probability of the region under one Gaussian, and the Gaussian cut to it."""
        # x = m + L xi, so D x = D m + slopes xi; Cov(D x) = V diag(s) V' with s = `variance`, and e = V' D x.
        slopes, centre = directions @ x.root, directions @ x.mean
        variance, eigenvectors = eigh(WeightedColumns(slopes, x.variances).covariance)
        # Components without variance, up to rounding, stay where they are.
        least = CERTAIN**0.5 * (radius**2 + jnp.sum(centre**2))
        slopes = eigenvectors.T @ slopes
        centre = eigenvectors.T @ centre
        variance_or_least = jnp.maximum(variance, least)
        # Log probability of the region, E e and Cov e in it. `varies`: components to be changed, of a possible region.
        moments = ball_moments(centre, variance_or_least, radius, inside)
        varies = (variance > least) & jnp.isfinite(moments.log_mass)
        # K = Cov(x, e) diag(s)^-1
        gain = jnp.where(varies, (x.root * x.variances) @ slopes.T / variance_or_least, 0.0)
        # m + K (E e - V' D m), and Cov(x | e) + K Cov(e) K'
        given_e, _ = condition_on_observation(x, slopes, jnp.zeros(len(slopes)), zero_covariance(len(slopes)), varies)
        mean = x.mean + gain @ jnp.where(varies, moments.mean - centre, 0.0)
        explained_by_e = eliminate(moments.covariance).through(gain)
        return moments.log_mass, from_columns(mean, join_columns(given_e.columns, explained_by_e))

    log_mass, truncated = jax.lax.map(truncate_one, mixture.gaussian)
    return GaussianSum(mixture.log_weight + log_mass, truncated, mixture.status)


def _truncate_component(centre: jax.Array, variance: jax.Array, radius: jax.Array, inside: bool) -> BallMoments:
    """Return the moments of e ~ N(centre, variance) in [-radius, radius], (1, ...), or below and above it, (2, ...).

    Where there is no probability, the mean and variance are those without truncation, and the log mass is -inf.
    """
    deviation = jnp.sqrt(variance)
    edge = jnp.array([-1.0, 1.0]) * radius
    if inside:
        low = (edge[:1] - centre) / deviation
        high = (edge[1:] - centre) / deviation
        sign, moments = jnp.ones(1), truncated_normal(low, high)
    else:
        sign = jnp.array([-1.0, 1.0])
        # The lower tail of e is the upper one of -e.
        moments = upper_tail((radius - sign * centre) / deviation)
    possible = jnp.isfinite(moments.log_mass)
    mean = jnp.where(possible, centre + deviation * sign * moments.mean, centre)
    variance_inside = jnp.where(possible, variance * moments.variance, variance)
    return BallMoments(jnp.where(possible, moments.log_mass, -jnp.inf), mean[:, None], variance_inside[:, None, None])


def _join_pieces(pieces: BallMoments) -> BallMoments:
    """Return the moments of the union of disjoint regions, `pieces` (piece, ...), from those of each.

    The masses add up. Mean and covariance are those of the mixture of the pieces, weighted by their masses.
    """
    # Masses are divided by the largest one. If all are 0, the pieces get equal shares.
    largest = jnp.max(pieces.log_mass)
    largest = jnp.where(jnp.isfinite(largest), largest, 0.0)
    weight = jnp.exp(pieces.log_mass - largest)
    total = jnp.sum(weight)
    share = jnp.where(total > 0, weight, 1.0) / jnp.where(total > 0, total, len(weight))
    mean = share @ pieces.mean
    deviation = pieces.mean - mean
    second = pieces.covariance + deviation[:, :, None] * deviation[:, None]  # about the mixture's mean
    covariance = jnp.tensordot(share, second, axes=1)
    return BallMoments(largest + jnp.log(total), mean, covariance)
