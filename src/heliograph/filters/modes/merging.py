"""Merging of the Gaussians of modes: mixture moments, with one Gaussian for all modes or one per mode."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.gaussian.belief import Belief
from heliograph.numerics.module import Module
from heliograph.numerics.over_runs import runs_last
from heliograph.numerics.small_matrix import symmetric
from heliograph.numerics.types import Bool, Float


class ModalBeliefs(NamedTuple):
    """A Gaussian for each of M components, and weight[i, j], the probability of component i and present mode j.

    Shapes: mean (M, n), covariance (M, n, n), weight (M, M). `moved` is true from the first prediction on.
    """

    mean: Float[jax.Array, "M n"]
    covariance: Float[jax.Array, "M n n"]
    weight: Float[jax.Array, "M M"]
    moved: Bool[jax.Array, ""]


class AbstractMerging(Module):
    """Rule that decides when the Gaussians of modes are merged."""

    def moved(self, state: ModalBeliefs, rows: jax.Array) -> ModalBeliefs:
        """Components and weights after a transition of the chain, before that of the plant."""
        raise NotImplementedError

    def pairs(self, modes: int) -> tuple[np.ndarray, np.ndarray]:
        """Pairs (component, mode) of the measurement update: all that can have a weight."""
        items = np.arange(modes)
        return items, items


class MergeAll(AbstractMerging):
    """One Gaussian for all modes (GPB1)."""

    def moved(self, state: ModalBeliefs, rows: jax.Array) -> ModalBeliefs:
        """Replace every component by the whole mixture."""
        law = jnp.sum(state.weight @ rows, axis=0)
        whole, _ = merged(state.mean, state.covariance, jnp.sum(state.weight, axis=1, keepdims=True))
        every = [jnp.repeat(part, len(rows), axis=0) for part in whole]
        return state._replace(mean=every[0], covariance=every[1], weight=jnp.diag(law))


class MergeByNextMode(AbstractMerging):
    """One Gaussian per mode, mixed by the mode that the chain comes from (IMM)."""

    def moved(self, state: ModalBeliefs, rows: jax.Array) -> ModalBeliefs:
        """Component j becomes the mixture of all components that lead to mode j."""
        (mean, covariance), law = merged(state.mean, state.covariance, state.weight @ rows)
        return state._replace(mean=mean, covariance=covariance, weight=jnp.diag(law))


class MergeByMode(AbstractMerging):
    """One Gaussian per mode, each updated in every next mode (GPB2)."""

    def moved(self, state: ModalBeliefs, rows: jax.Array) -> ModalBeliefs:
        """Components keep the mode of their last update."""
        (mean, covariance), law = merged(state.mean, state.covariance, state.weight)
        return state._replace(mean=mean, covariance=covariance, weight=law[:, None] * rows)

    def pairs(self, modes: int) -> tuple[np.ndarray, np.ndarray]:
        """Pair every component with every mode."""
        return np.repeat(np.arange(modes), modes), np.tile(np.arange(modes), modes)


@runs_last
def merged(mean: jax.Array, covariance: jax.Array, weight: jax.Array) -> tuple[Belief, jax.Array]:
    """Means and covariances of the mixtures with weight (components, mixtures), and each mixture's weight."""
    law = jnp.sum(weight, axis=0)
    share = jnp.where(law > 0, weight * (1 / jnp.where(law > 0, law, 1.0)), 1 / len(weight))
    center = jnp.sum(share[:, :, None] * mean[:, None], axis=0)
    apart = mean[:, None] - center
    inside = covariance[:, None] + apart[:, :, :, None] * apart[:, :, None]
    spread = jnp.sum(share[:, :, None, None] * inside, axis=0)
    return Belief(center, jnp.moveaxis(symmetric(jnp.moveaxis(spread, 0, 2)), 2, 0)), law
