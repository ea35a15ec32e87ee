"""When and how the Gaussians of modes are merged (GPB1, IMM, GPB2), and the prediction of the mixtures."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.factored_gaussian import (
    Gaussian,
    from_covariance_by_elimination,
    merge_mixture,
    moments_of_mixture,
)
from heliograph.filters.gaussian.gaussian_prediction import factor_process_noise, predict_gaussian
from heliograph.filters.gaussian.moment_transforms import AbstractTransform
from heliograph.model.plant import AbstractPlant, LinearPlant
from heliograph.numerics.module import Module, unwritten
from heliograph.numerics.types import PyTree

T = TypeVar("T", bound=PyTree)


class AbstractMerging(Module):
    """Rule that decides when the Gaussians of modes are merged.

    Components c are K Gaussians, weight[c, j] the probability of component c and present mode j of M; K is M unless a
    rule says otherwise.
    """

    @property
    def corrects_pairs(self) -> bool:
        """True if what was moved is merged after its correction alone, pair by pair of modes."""
        return False

    def initial_weights(self, law: jax.Array) -> jax.Array:
        """Return the weights (K, M) of the components before any data, of the modes' law (M,)."""
        return jnp.diag(law)

    def merge_by_mode(self, gaussians: Gaussian, weight: jax.Array) -> Gaussian:
        """Return one Gaussian for each mode, of components and weights (K, M) as `keep_components` returns them."""
        return gaussians

    def mixing_weights(self, weight: jax.Array, rows: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return how components are mixed before a move: weights (K, G) of K components in G mixtures.

        And the weights (K, M) of the components after the move. `rows`: transition matrix (M, M) of the modes.
        """
        raise unwritten(self, "mixing")

    def list_moves(self, modes: int) -> tuple[np.ndarray, np.ndarray]:
        """Return for each component after the prediction which mixture it was before, and which mode moved it."""
        places = np.arange(modes)
        return places, places

    def list_update_pairs(self, modes: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the pairs (component, mode) of the measurement update: all that can have a weight."""
        places = np.arange(modes)
        return places, places

    def keep_components(self, gaussians: Gaussian, weight: jax.Array, modes: int) -> tuple[Gaussian, jax.Array]:
        """Return the components after the update of all pairs, and their weights (K, M)."""
        return gaussians, jnp.diag(weight)


class MergeAll(AbstractMerging):
    """One Gaussian for all modes (GPB1)."""

    def mixing_weights(self, weight: jax.Array, rows: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return weights (K, 1) of one mixture of all, and (M, M) of its copies in the modes after the move."""
        return jnp.sum(weight, axis=1, keepdims=True), jnp.diag(jnp.sum(weight @ rows, axis=0))

    def list_moves(self, modes: int) -> tuple[np.ndarray, np.ndarray]:
        """Return which mixture each predicted component was and which mode moved it: each mode moves one."""
        return np.zeros(modes, int), np.arange(modes)


class MergeByNextMode(AbstractMerging):
    """One Gaussian per mode, mixed by the mode that the chain comes from (IMM)."""

    def mixing_weights(self, weight: jax.Array, rows: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return weights (K, M) that mix for each next mode all that lead to it, and those (M, M) after the move."""
        mixed = weight @ rows
        return mixed, jnp.diag(jnp.sum(mixed, axis=0))


class MergeByMode(AbstractMerging):
    """One Gaussian per mode, each updated in every next mode (GPB2), of a plant that all modes move alike."""

    @property
    def corrects_pairs(self) -> bool:
        """Always True."""
        return True

    def mixing_weights(self, weight: jax.Array, rows: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return weights (K, M) that mix each mode's component alone, and the joint probabilities after the move."""
        return weight, jnp.sum(weight, axis=0)[:, None] * rows

    def list_update_pairs(self, modes: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the pairs (component, mode) of the update: every component with every mode."""
        return np.repeat(np.arange(modes), modes), np.tile(np.arange(modes), modes)

    def keep_components(self, gaussians: Gaussian, weight: jax.Array, modes: int) -> tuple[Gaussian, jax.Array]:
        """Return one component for each present mode, merged over the modes before, and the weights (M, M).

        `gaussians` and `weight` hold a Gaussian and its weight for each pair (mode before, present mode). The returned
        weights are diagonal, since each component belongs to one mode.
        """
        _, present_mode = self.list_update_pairs(modes)
        weight_by_mode = weight[:, None] * (present_mode[:, None] == np.arange(modes))  # (pair, present mode)
        merged = jax.vmap(partial(merge_mixture, gaussians), in_axes=1)(normalise_columns(weight_by_mode))
        return merged, jnp.diag(jnp.sum(weight_by_mode, axis=0))


class MergePairs(AbstractMerging):
    """One Gaussian per pair of the mode before and the present one (GPB2), merged by mode before each move."""

    @property
    def corrects_pairs(self) -> bool:
        """Always True."""
        return True

    def merge_by_mode(self, gaussians: Gaussian, weight: jax.Array) -> Gaussian:
        """Return one Gaussian for each present mode, merged from its pairs."""
        return jax.vmap(partial(merge_mixture, gaussians), in_axes=1)(normalise_columns(weight))

    def initial_weights(self, law: jax.Array) -> jax.Array:
        """Return the weights (M^2, M) of pairs before any data: the law (M,) on pairs of equal modes."""
        modes = len(law)
        return self._by_mode(jnp.eye(modes).reshape(-1) * jnp.repeat(law, modes), modes)

    def mixing_weights(self, weight: jax.Array, rows: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return weights (M^2, M) that merge what ends in one mode, and those of pairs (j, l) after it, P(j) T_jl."""
        modes = len(rows)
        return weight, self._by_mode((jnp.sum(weight, axis=0)[:, None] * rows).reshape(-1), modes)

    def list_moves(self, modes: int) -> tuple[np.ndarray, np.ndarray]:
        """Return which mixture each predicted component was and which mode moved it: each mode moves all."""
        return np.repeat(np.arange(modes), modes), np.tile(np.arange(modes), modes)

    def list_update_pairs(self, modes: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the pairs (component, mode) of the update: each component, a pair of modes, with its present mode."""
        return np.arange(modes**2), np.tile(np.arange(modes), modes)

    def keep_components(self, gaussians: Gaussian, weight: jax.Array, modes: int) -> tuple[Gaussian, jax.Array]:
        """Return all components, pairs of modes, as they are until the next move, and their weights (M^2, M)."""
        return gaussians, self._by_mode(weight, modes)

    def _by_mode(self, weight: jax.Array, modes: int) -> jax.Array:
        """Return the weights (M^2,) of pairs as (M^2, M), each in the column of its present mode."""
        return jnp.asarray(weight[:, None] * (np.tile(np.arange(modes), modes)[:, None] == np.arange(modes)))


def normalise_columns(weight: jax.Array) -> jax.Array:
    """Divide weights (components, mixtures) by their column sums; a column of zeros becomes equal weights."""
    total = jnp.sum(weight, axis=0)
    is_positive = total > float(np.finfo(total.dtype).tiny)  # the reciprocal of a smaller number would be infinite
    return jnp.where(is_positive, weight * (1 / jnp.where(is_positive, total, 1.0)), 1 / len(weight))


def mix_and_predict(
    plant: AbstractPlant,
    transform: AbstractTransform,
    parts: Gaussian,
    weight: jax.Array,
    u: jax.Array,
    initial_power: jax.Array,
) -> Gaussian:
    """Return for each mixture the Gaussian (mixtures, n) of the mean and covariance of f(x, u) + w, x from the mixture.

    Args:
        plant: f, and the law of w.
        transform: of moments, for a nonlinear plant.
        parts: Gaussians that are mixed, one a component.
        weight: [c, g], weight of component c in mixture g; columns need not sum to 1.
        u: input.
        initial_power: E[x_i^2] before any data (n,), on which rounding acts.
    """
    share = normalise_columns(weight)
    # Through a nonlinear plant each mixture goes as one Gaussian.
    if not isinstance(plant, LinearPlant):
        mixtures = jax.vmap(partial(merge_mixture, parts), in_axes=1)(share)
        return jax.vmap(lambda x: predict_gaussian(plant, transform, x, u, initial_power))(mixtures)
    # A linear plant moves the parts before they are mixed, each once rather than once for each mixture: their means
    # A m + shift(u), the shift with the mean of w in it, and their covariances A P A'.
    matrix, noise = plant.transition_matrix(u), factor_process_noise(plant, u, initial_power).covariance
    means = jax.vmap(lambda mean: matrix @ mean + plant.shift(u))(parts.mean)
    spreads = jax.vmap(lambda x: x.columns.through(matrix).covariance)(parts)

    def mix_moved(weights: jax.Array) -> Gaussian:
        """Return one mixture of the moved parts, with the process noise."""
        mean, covariance = moments_of_mixture(means, spreads, weights)
        return from_covariance_by_elimination(mean, covariance + noise)

    moved: Gaussian = jax.vmap(mix_moved, in_axes=1)(share)
    return moved


def mix_and_predict_by_mode(
    plants: Sequence[AbstractPlant],
    plant_of: np.ndarray,
    transform: AbstractTransform,
    parts: Gaussian,
    weight: jax.Array,
    moves: tuple[np.ndarray, np.ndarray],
    u: jax.Array,
    initial_power: jax.Array,
) -> Gaussian:
    """Return the Gaussians after a step: mixtures of `parts` by weights (components, mixtures), moved by modes' plants.

    Args:
        plants: the different plants.
        plant_of: [j], number of the plant of mode j.
        transform: of moments, for a nonlinear plant.
        parts: Gaussians that are mixed, one a component.
        weight: (components, mixtures).
        moves: two arrays, of each Gaussian after the step the number of the mixture that it was before, and the mode
            that moves it.
        u: input.
        initial_power: E[x_i^2] before any data (n,), on which rounding acts.
    """
    mixture_of, mode_of = moves
    if len(plants) == 1:  # each mixture is moved once, however many modes it has afterwards
        moved = mix_and_predict(plants[0], transform, parts, weight, u, initial_power)
        in_order = np.array_equal(mixture_of, np.arange(weight.shape[1]))
        return moved if in_order else jax.tree.map(lambda leaf: leaf[mixture_of], moved)
    # Plant after plant, the components that it moves; then all of them in order again.
    mixtures = mix_moments(parts, normalise_columns(weight))
    plant_of_component, results = plant_of[mode_of], []
    for number, plant in enumerate(plants):
        sources = mixture_of[plant_of_component == number]
        before = jax.tree.map(lambda leaf, sources=sources: leaf[sources], mixtures)
        results.append(_predict_each(plant, transform, before, u, initial_power))
    moved_order = np.concatenate([np.flatnonzero(plant_of_component == number) for number in range(len(plants))])
    place_among_results = np.argsort(moved_order)  # of each component: the inverse permutation
    joined: Gaussian = jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[place_among_results], *results)
    return joined


class MixtureMoments(NamedTuple):
    """Means (parts, n) and covariances (parts, n, n)."""

    mean: jax.Array
    covariance: jax.Array


def mix_moments(gaussians: Gaussian, share: jax.Array) -> MixtureMoments:
    """Return the moments of mixtures of Gaussians, by their shares (components, mixtures)."""
    covariances = jax.vmap(lambda x: x.covariance)(gaussians)

    def mix(shares: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return mean and covariance of the mixture with these shares of the components."""
        return moments_of_mixture(gaussians.mean, covariances, shares)

    mean, covariance = jax.vmap(mix, in_axes=1)(share)
    return MixtureMoments(mean, covariance)


def _predict_each(
    plant: AbstractPlant, transform: AbstractTransform, x: MixtureMoments, u: jax.Array, initial_power: jax.Array
) -> Gaussian:
    """Return the Gaussian of f(x, u) + w for each of some moments (..., n) of x.

    Moments of a linear plant are moved as they are, without factors before. `initial_power`: E[x_i^2] at the start,
    for rounding.
    """
    if not isinstance(plant, LinearPlant):
        before = jax.vmap(from_covariance_by_elimination)(*x)
        return jax.vmap(lambda part: predict_gaussian(plant, transform, part, u, initial_power))(before)
    matrix, noise = plant.transition_matrix(u), factor_process_noise(plant, u, initial_power).covariance

    def move(mean: jax.Array, covariance: jax.Array) -> Gaussian:
        """Move one pair of moments."""
        return from_covariance_by_elimination(matrix @ mean + plant.shift(u), matrix @ covariance @ matrix.T + noise)

    moved: Gaussian = jax.vmap(move)(*x)
    return moved


def align_angles(plant: AbstractPlant, mean: jax.Array, weight: jax.Array) -> jax.Array:
    """Return means (components, n) with angles near those of the most probable component, so that they average."""
    return plant.near(mean, mean[jnp.argmax(weight)]) if plant.circular else mean


def replicate(x: T, count: int) -> T:
    """Replicate an object `count` times along a new first axis."""
    copies: T = jax.tree.map(lambda leaf: jnp.repeat(jnp.asarray(leaf)[None], count, axis=0), x)
    return copies
