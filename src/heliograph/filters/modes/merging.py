"""When the Gaussians of modes are merged, and the mixtures' moments: one Gaussian for all modes, or one for each."""

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

    Shapes: mean (M, n), covariance (M, n, n), weight (M, M); `moved` once the chain was used.
    """

    mean: Float[jax.Array, "M n"]
    covariance: Float[jax.Array, "M n n"]
    weight: Float[jax.Array, "M M"]
    moved: Bool[jax.Array, ""]


class AbstractMerging(Module):
    """When Gaussians are merged."""

    def moved(self, state: ModalBeliefs, rows: jax.Array) -> ModalBeliefs:
        """Components and weights after the chain has moved, before the plant does."""
        raise NotImplementedError

    def pairs(self, modes: int) -> tuple[np.ndarray, np.ndarray]:
        """Components and modes to hear with: all that may have a weight."""
        items = np.arange(modes)
        return items, items


class MergeAll(AbstractMerging):
    """One Gaussian for all modes (GPB1)."""

    def moved(self, state: ModalBeliefs, rows: jax.Array) -> ModalBeliefs:
        """Every component is the whole mixture."""
        law = jnp.sum(state.weight @ rows, axis=0)
        whole, _ = merged(state.mean, state.covariance, jnp.sum(state.weight, axis=1, keepdims=True))
        every = [jnp.repeat(part, len(rows), axis=0) for part in whole]
        return state._replace(mean=every[0], covariance=every[1], weight=jnp.diag(law))


class MergeByNextMode(AbstractMerging):
    """A Gaussian for each mode, mixed by where the chain comes from (IMM)."""

    def moved(self, state: ModalBeliefs, rows: jax.Array) -> ModalBeliefs:
        """Component j is the mixture of all that lead to mode j."""
        (mean, covariance), law = merged(state.mean, state.covariance, state.weight @ rows)
        return state._replace(mean=mean, covariance=covariance, weight=jnp.diag(law))


class MergeByMode(AbstractMerging):
    """A Gaussian for each mode, each heard with in every next mode (GPB2)."""

    def moved(self, state: ModalBeliefs, rows: jax.Array) -> ModalBeliefs:
        """Components stay with the mode they were heard in."""
        (mean, covariance), law = merged(state.mean, state.covariance, state.weight)
        return state._replace(mean=mean, covariance=covariance, weight=law[:, None] * rows)

    def pairs(self, modes: int) -> tuple[np.ndarray, np.ndarray]:
        """Every component with every mode."""
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
