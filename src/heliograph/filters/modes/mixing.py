"""When the Gaussians of modes are merged, and how: mixtures of them by two moments, and what a plant makes of these."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.gaussian import Gaussian, from_covariance_by_elimination, merge_mixture, moments_of_mixture
from heliograph.filters.gaussian.belief import predict_gaussian, process_noise
from heliograph.filters.gaussian.transform import AbstractTransform
from heliograph.model.plant import AbstractPlant, LinearPlant
from heliograph.numerics.module import Module, unwritten


class AbstractMerging(Module):
    """Rule that decides when the Gaussians of modes are merged."""

    def mixing_weights(self, weight: jax.Array, rows: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Weights (M, K) of the components in K mixtures that replace them, and those after the chain's transition.

        K is M, or 1 where all components become the same.
        """
        raise unwritten(self, "mixing")

    def update_pairs(self, modes: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the pairs (component, mode) of the measurement update: all that can have a weight."""
        places = np.arange(modes)
        return places, places

    def kept(self, parts: Gaussian, weight: jax.Array) -> tuple[Gaussian, jax.Array]:
        """Return the components after the update of all pairs, and the probability of each present mode."""
        return parts, weight


class MergeAll(AbstractMerging):
    """One Gaussian for all modes (GPB1)."""

    def mixing_weights(self, weight: jax.Array, rows: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Replace every component by the whole mixture."""
        return jnp.sum(weight, axis=1, keepdims=True), jnp.diag(jnp.sum(weight @ rows, axis=0))


class MergeByNextMode(AbstractMerging):
    """One Gaussian per mode, mixed by the mode that the chain comes from (IMM)."""

    def mixing_weights(self, weight: jax.Array, rows: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Component j becomes the mixture of all components that lead to mode j."""
        mixed = weight @ rows
        return mixed, jnp.diag(jnp.sum(mixed, axis=0))


class MergeByMode(AbstractMerging):
    """One Gaussian per mode, each updated in every next mode (GPB2)."""

    def mixing_weights(self, weight: jax.Array, rows: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Components keep the mode of their last update."""
        return weight, jnp.sum(weight, axis=0)[:, None] * rows

    def update_pairs(self, modes: int) -> tuple[np.ndarray, np.ndarray]:
        """Pair every component with every mode."""
        return np.repeat(np.arange(modes), modes), np.tile(np.arange(modes), modes)

    def kept(self, parts: Gaussian, weight: jax.Array) -> tuple[Gaussian, jax.Array]:
        """Return one component for each present mode."""
        modes = math.isqrt(len(weight))
        pairs = weight[:, None] * (self.update_pairs(modes)[1][:, None] == np.arange(modes))
        return jax.vmap(partial(merge_mixture, parts), in_axes=1)(normalise_columns(pairs)), jnp.sum(pairs, axis=0)


def normalise_columns(weight: jax.Array) -> jax.Array:
    """Divide weights (components, mixtures) by their column sums; equal weights where a column is zero."""
    law = jnp.sum(weight, axis=0)
    some = law > float(np.finfo(law.dtype).tiny)  # the reciprocal of less is infinite
    return jnp.where(some, weight * (1 / jnp.where(some, law, 1.0)), 1 / len(weight))


def mix_and_predict(
    plant: AbstractPlant,
    transform: AbstractTransform,
    parts: Gaussian,
    weight: jax.Array,
    u: jax.Array,
    start: jax.Array,
) -> Gaussian:
    """f(x, u) + w of each mixture (components, mixtures), by two moments; a linear plant moves the parts first."""
    share = normalise_columns(weight)
    if not isinstance(plant, LinearPlant):
        mixtures = jax.vmap(partial(merge_mixture, parts), in_axes=1)(share)
        return jax.vmap(lambda x: predict_gaussian(plant, transform, x, u, start))(mixtures)
    matrix, noise = plant.transition_matrix(u), process_noise(plant, u, start).covariance
    means = jax.vmap(lambda mean: matrix @ mean + plant.shift(u))(parts.mean)
    spreads = jax.vmap(lambda x: x.columns.through(matrix).covariance)(parts)

    def mix(weights: jax.Array) -> Gaussian:
        mean, covariance = moments_of_mixture(means, spreads, weights)
        return from_covariance_by_elimination(mean, covariance + noise)

    moved: Gaussian = jax.vmap(mix, in_axes=1)(share)
    return moved
