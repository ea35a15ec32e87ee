"""Moments of a Gaussian that is known to lie in a ball, or outside of it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.columns import WeightedColumns, eliminate, join_columns, zero_covariance
from heliograph.factors.gaussian import Gaussian, condition_on_observation, from_columns
from heliograph.filters.event.gaussian_sum import GaussianSum
from heliograph.filters.event.truncated_normal import truncated_normal, upper_tail
from heliograph.filters.truncation import CERTAIN
from heliograph.numerics.lapack import eigh

MOST_COMPONENTS = 3  # nodes are a grid over all but one of them
REACH = 9.0  # deviations from the centre beyond which there is no probability that counts
NODES, WEIGHTS = (array / 2 for array in np.polynomial.legendre.leggauss(32))
NODES = NODES + 0.5  # on (0, 1)


class BallMoments(NamedTuple):
    """log P(e in the region), and mean (m,) and covariance (m, m) of e there."""

    log_mass: jax.Array
    mean: jax.Array
    covariance: jax.Array


def ball_moments(centre: jax.Array, variance: jax.Array, radius: jax.Array, inside: bool) -> BallMoments:
    """Return the moments of independent e_i ~ N(centre_i, variance_i) where |e| <= radius, or where not.

    Slices: given e_1 = radius sin(t) the others lie in a ball of radius cos(t) times as large, whose moments are those
    of fewer components; the last is a truncated normal. 32 Gauss-Legendre nodes in t where e_1 has its probability. As
    means and covariances of a mixture, so that no variance is negative.

    Shapes: centre and variance (m,), variance positive; radius ().
    """
    if len(centre) == 1:
        return _join_pieces(_truncate_component(centre[0], variance[0], radius, inside))
    # e_1 = radius sin(t) inside of the radius, t only where e_1 has its probability: within REACH deviations of the
    # point of [-radius, radius] that is nearest to its mean. At each node: the moments of the other components.
    first, deviation = centre[0], jnp.sqrt(variance[0])
    near = jnp.clip(first, -radius, radius)
    low, high = (jnp.arcsin(jnp.clip((near + side * REACH * deviation) / radius, -1.0, 1.0)) for side in (-1.0, 1.0))
    angle = low + (high - low) * NODES
    e = radius * jnp.sin(angle)
    others = jax.lax.map(lambda r: ball_moments(centre[1:], variance[1:], r, inside), radius * jnp.cos(angle))
    # log of the node's weight in t, of de_1 / dt = radius cos(t), and of the density of e_1.
    weight = jnp.log(WEIGHTS * (high - low) * radius * jnp.cos(angle) / deviation) - np.log(2 * np.pi) / 2
    weight = weight - ((e - first) / deviation) ** 2 / 2
    mean = jnp.concatenate([e[:, None], others.mean], axis=1)
    covariance = jnp.zeros((len(e), *variance.shape * 2)).at[:, 1:, 1:].set(others.covariance)
    pieces = BallMoments(weight + others.log_mass, mean, covariance)
    if inside:
        return _join_pieces(pieces)
    # Outside also where |e_1| > radius, above or below (two Gaussians): there the others may lie anywhere.
    tails = _truncate_component(first, variance[0], radius, False)
    mean = jnp.concatenate([tails.mean, jnp.broadcast_to(centre[1:], (2, len(centre) - 1))], axis=1)
    free = jnp.broadcast_to(jnp.diag(variance), (2, *variance.shape * 2))
    wide = BallMoments(tails.log_mass, mean, free.at[:, 0, 0].set(tails.covariance[:, 0, 0]))
    return _join_pieces(BallMoments(*(jnp.concatenate(both) for both in zip(pieces, wide, strict=True))))


def truncate_to_ball(parts: GaussianSum, directions: jax.Array, radius: jax.Array, inside: bool) -> GaussianSum:
    """Return each Gaussian cut to |D x| <= radius (`inside`), or to where it is more, with the moments kept.

    With Cov(D x) = V diag(s) V', e = V' D x has independent components. Of those that are known to vary, x is given
    exactly, and then E e and Cov e enter with K = Cov(x, e) diag(s)^-1: mean m + K (E e - V' D m), and columns K more.

    Shapes: directions (m, N).
    """

    def truncate_one(x: Gaussian) -> tuple[jax.Array, Gaussian]:
        """Truncate one Gaussian: diagonalise what is seen, take its moments in the ball, carry them to all of x."""
        rows, centre = directions @ x.root, directions @ x.mean
        variance, turn = eigh(WeightedColumns(rows, x.variances).covariance)
        # What has no variance lies where it is.
        least = CERTAIN**0.5 * (radius**2 + jnp.sum(centre**2))
        rows, centre = turn.T @ rows, turn.T @ centre
        size = jnp.maximum(variance, least)
        moments = ball_moments(centre, size, radius, inside)
        varies = (variance > least) & jnp.isfinite(moments.log_mass)
        gain = jnp.where(varies, (x.root * x.variances) @ rows.T / size, 0.0)
        given, _ = condition_on_observation(x, rows, jnp.zeros(len(rows)), zero_covariance(len(rows)), varies)
        mean = x.mean + gain @ jnp.where(varies, moments.mean - centre, 0.0)
        spread = eliminate(moments.covariance).through(gain)
        return moments.log_mass, from_columns(mean, join_columns(given.columns, spread))

    log_mass, after = jax.lax.map(truncate_one, parts.gaussian)
    return GaussianSum(parts.log_weight + log_mass, after, parts.label)


def _truncate_component(centre: jax.Array, variance: jax.Array, radius: jax.Array, inside: bool) -> BallMoments:
    """Return the moments of one component within the radius, (1, ...), or below and above it, (2, ...)."""
    deviation = jnp.sqrt(variance)
    edge = jnp.array([-1.0, 1.0]) * radius
    if inside:
        side, moments = jnp.ones(1), truncated_normal((edge[:1] - centre) / deviation, (edge[1:] - centre) / deviation)
    else:
        side = jnp.array([-1.0, 1.0])
        moments = upper_tail((radius - side * centre) / deviation)
    possible = jnp.isfinite(moments.log_mass)
    mean = jnp.where(possible, centre + deviation * side * moments.mean, centre)
    spread = jnp.where(possible, variance * moments.variance, variance)
    return BallMoments(jnp.where(possible, moments.log_mass, -jnp.inf), mean[:, None], spread[:, None, None])


def _join_pieces(pieces: BallMoments) -> BallMoments:
    """Return the moments of the mixture of pieces, (piece, ...)."""
    # Masses relative to the largest one; where none has any, equal shares.
    top = jnp.max(pieces.log_mass)
    top = jnp.where(jnp.isfinite(top), top, 0.0)
    weight = jnp.exp(pieces.log_mass - top)
    total = jnp.sum(weight)
    share = jnp.where(total > 0, weight, 1.0) / jnp.where(total > 0, total, len(weight))
    mean = share @ pieces.mean
    apart = pieces.mean - mean
    covariance = jnp.tensordot(share, pieces.covariance + apart[:, :, None] * apart[:, None], axes=1)
    return BallMoments(top + jnp.log(total), mean, covariance)
