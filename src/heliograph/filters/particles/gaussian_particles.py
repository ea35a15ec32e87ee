"""Particles that are Gaussians in each of several modes: their state, and sums of their moments."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.particles.moments import FirstSums, StateSums, second_sums
from heliograph.filters.particles.resampling import effective_number
from heliograph.numerics.angles.angle import Angles, wrap_angles
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import Bool, Float, Int


class Cloud(NamedTuple):
    """N particles, each a mixture: the Gaussian of x (n,) in each of M modes, and log probabilities of the modes.

    Shapes: the Gaussians (N, M, n), log_mode (N, M).
    """

    gaussian: Gaussian
    log_mode: jax.Array


class PartlyDrawn(NamedTuple):
    """N particles: of each the Gaussian of x in every mode, drawn states first, with log probabilities of the modes.

    Where mode and drawn states are drawn, one mode has probability 1, and the drawn states have variance 0 in it.
    `moved` is true from the first prediction on.

    Shapes: the Gaussians (N, M, n), log_mode (N, M), log_weight (N,), the largest 0, key (2,).
    """

    gaussian: Gaussian
    log_mode: Float[jax.Array, "N M"]
    log_weight: Float[jax.Array, " N"]
    key: Int[jax.Array, " 2"]
    moved: Bool[jax.Array, ""]

    @property
    @in_float64
    def weight(self) -> jax.Array:
        """Weights (N,), which sum to 1."""
        return jax.nn.softmax(self.log_weight)

    @property
    @in_float64
    def effective_number(self) -> jax.Array:
        """1 / sum of the squared weights: how many particles of equal weight would say as much."""
        return effective_number(self.weight)


def repeat_for_modes(x: Gaussian, modes: int) -> Gaussian:
    """Return N Gaussians of n states, each repeated for every one of M modes: means (N, n) become (N, M, n)."""
    repeated: Gaussian = jax.tree.map(lambda leaf: jnp.repeat(leaf[:, None], modes, axis=1), x)
    return repeated


def sum_clouds_for_mean(weight: jax.Array, particles: Cloud, angles: Angles) -> StateSums:
    """Return sums over B particles, from which the mean of x and the modes' probabilities follow.

    Each particle is a mixture of a Gaussian in each of M modes. The sums are those of weights, of squared weights, of
    weighted means, and of weighted sines and cosines of angles: a Gaussian angle has E exp(i angle) =
    exp(i mean - variance / 2). Beside them the sum of weights in each mode (M,), None if there is one mode.
    """
    weights, mean = _list_parts(weight, particles)
    variances = jnp.diagonal(particles.gaussian.covariance, axis1=-2, axis2=-1).reshape(mean.shape)
    angle = mean[:, list(angles)]
    length = weights[:, None] * jnp.exp(-variances[:, list(angles)] / 2)
    sines_and_cosines = jnp.sum(length * jnp.sin(angle), axis=0), jnp.sum(length * jnp.cos(angle), axis=0)
    sums = FirstSums(jnp.sum(weight), jnp.sum(weight**2), weights @ mean, *sines_and_cosines)
    modes = particles.log_mode.shape[1]
    return StateSums(sums, jnp.sum(weights.reshape(-1, modes), axis=0) if modes > 1 else None)


def sum_clouds_for_covariance(weight: jax.Array, particles: Cloud, sums: StateSums, angles: Angles) -> jax.Array:
    """Return the sum over particles and modes of w (d d' + P) (n, n), from which the covariance of x follows.

    w is a particle's weight times its mode's probability, P the Gaussian's covariance and d the difference of its mean
    from the mean of all particles, which `sums` (over all of them) give. Differences of `angles` are within half a
    turn.
    """
    weights, mean = _list_parts(weight, particles)
    deviation = wrap_angles(mean - sums.first.mean(angles), angles)
    n = mean.shape[1]
    covariances = particles.gaussian.covariance.reshape(len(weights), n, n)
    return second_sums(weights, deviation) + jnp.einsum("a,aij->ij", weights, covariances)


def _list_parts(weight: jax.Array, particles: Cloud) -> tuple[jax.Array, jax.Array]:
    """Return a list of all pairs of particle and mode: their weights (B M,), and means of their Gaussians (B M, n).

    A pair's weight is the particle's weight (`weight` (B,)) times the probability of the mode.
    """
    x, log_mode = particles
    weights = (weight[:, None] * jax.nn.softmax(log_mode, axis=1)).ravel()
    return weights, jnp.asarray(x.mean).reshape(len(weights), -1)
