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
    rule says otherwise. A step merges components to mixtures (`mixing_weights`), moves these by the modes' plants to
    new components (`list_moves`), corrects pairs of a component and a mode with z (`list_update_pairs`), and merges
    these to the components that are kept (`keep_components`).
    """

    @property
    def corrects_pairs(self) -> bool:
        """True if each pair of the mode before a step and the mode after it has a Gaussian that is corrected with z.

        They are merged afterwards. False if Gaussians are merged by the mode after the step before z corrects them.
        """
        return False

    def initial_weights(self, law: jax.Array) -> jax.Array:
        """Return the weights (K, M) of components and modes before any data, from the modes' law (M,).

        Here component j belongs to mode j alone, so that they are diagonal.
        """
        return jnp.diag(law)

    def merge_by_mode(self, gaussians: Gaussian, weight: jax.Array) -> Gaussian:
        """Return one Gaussian for each mode, from the K components after a correction and their weights (K, M).

        Here there is one component for each mode already.
        """
        return gaussians

    def mixing_weights(self, weight: jax.Array, transition: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return how components are merged before the plants move them, and the weights of the components afterwards.

        Args:
            weight: [c, j], probability of component c and mode j before the step (K, M).
            transition: of the modes (M, M).

        Returns:
            Weights [c, g] of component c in mixture g (K, G), whose columns need not sum to 1; and the weights (K, M)
            after the step. Each component after the step is one mixture moved by one mode's plant.
        """
        raise unwritten(self, "mixing")

    def list_moves(self, modes: int) -> tuple[np.ndarray, np.ndarray]:
        """Return for each component after a step the mixture that it was, and the mode whose plant moved it.

        Here mixture j is moved by mode j alone.
        """
        numbers = np.arange(modes)
        return numbers, numbers

    def list_update_pairs(self, modes: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the components and the modes of all pairs (component, mode) that may have a weight and are corrected.

        Here component j belongs to mode j alone.
        """
        numbers = np.arange(modes)
        return numbers, numbers

    def keep_components(self, gaussians: Gaussian, weight: jax.Array, modes: int) -> tuple[Gaussian, jax.Array]:
        """Return the components that are kept after a correction with z, and their weights (K, M).

        `gaussians` and `weight` (pairs,) are those of the pairs (component, mode) that `list_update_pairs` lists, after
        the correction. Here pair j is component j with its own mode j: all are kept, with diagonal weights.
        """
        return gaussians, jnp.diag(weight)


class MergeAll(AbstractMerging):
    """One Gaussian for all modes (GPB1)."""

    def mixing_weights(self, weight: jax.Array, transition: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the weights (K, 1) of K components in one mixture, and those of the M components after the step.

        `weight` (K, M) is that of components and modes before the step. Afterwards component j is the mixture moved by
        mode j. It belongs to mode j alone, so its weights (M, M) are diagonal: P(j) = sum_ci weight_ci Pi_ij.
        """
        return jnp.sum(weight, axis=1, keepdims=True), jnp.diag(jnp.sum(weight @ transition, axis=0))

    def list_moves(self, modes: int) -> tuple[np.ndarray, np.ndarray]:
        """Return for each component after a step its mixture, always number 0, and the mode whose plant moved it."""
        return np.zeros(modes, int), np.arange(modes)


class MergeByNextMode(AbstractMerging):
    """One Gaussian per mode, mixed by the mode that the chain comes from (IMM)."""

    def mixing_weights(self, weight: jax.Array, transition: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the weights (K, M) of K components in a mixture for each next mode, and those of the mixtures (M, M).

        `weight` [c, i] is P(component c, mode i) before the step, and `transition` is the modes' matrix Pi.
        """
        # [c, j]: P(component c, next mode j) = sum_i weight_ci Pi_ij
        mixing = weight @ transition
        # After the step component j belongs to mode j alone, with P(next mode j) on the diagonal.
        return mixing, jnp.diag(jnp.sum(mixing, axis=0))


class MergeByMode(AbstractMerging):
    """One Gaussian per mode, each updated in every next mode (GPB2), of a plant that all modes move alike."""

    @property
    def corrects_pairs(self) -> bool:
        """True: a step's z corrects a Gaussian for each pair (mode before, mode after), and then pairs are merged.

        A smoother asks this, to know whether later data act on Gaussians before z or after it.
        """
        return True

    def mixing_weights(self, weight: jax.Array, transition: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return weights (M, M) that merge nothing, as component i is that of mode i, and the weights after the step.

        `weight` is diagonal: P(mode i). After the step weight [i, j] is P(mode i before, mode j) = P(i) Pi_ij.
        """
        return weight, jnp.sum(weight, axis=0)[:, None] * transition

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
        """True: a step's z corrects a Gaussian for each pair (mode before, mode after), and then pairs are merged.

        A smoother asks this, to know whether later data act on Gaussians before z or after it.
        """
        return True

    def merge_by_mode(self, gaussians: Gaussian, weight: jax.Array) -> Gaussian:
        """Return one Gaussian for each present mode, merged from its pairs (mode before, present mode)."""
        return jax.vmap(partial(merge_mixture, gaussians), in_axes=1)(normalise_columns(weight))

    def initial_weights(self, law: jax.Array) -> jax.Array:
        """Return the weights (M^2, M) of pairs before any data: the law (M,) on pairs of equal modes."""
        modes = len(law)
        return self._by_mode(jnp.eye(modes).reshape(-1) * jnp.repeat(law, modes), modes)

    def mixing_weights(self, weight: jax.Array, transition: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the weights (M^2, M) of pairs (i, j) in a mixture for each mode j, and those of pairs after the step.

        `weight` holds P(mode i before, mode j now) of pair (i, j) in column j, and so merges all pairs that end in mode
        j. After the step the pair (j, l) is mixture j moved by mode l, with P(j, l) = P(j) Pi_jl in column l.
        """
        modes = len(transition)
        pair_probability = jnp.sum(weight, axis=0)[:, None] * transition
        return weight, self._by_mode(pair_probability.reshape(-1), modes)

    def list_moves(self, modes: int) -> tuple[np.ndarray, np.ndarray]:
        """Return for each pair (j, l) after a step its mixture j, and the mode l whose plant moved it."""
        return np.repeat(np.arange(modes), modes), np.tile(np.arange(modes), modes)

    def list_update_pairs(self, modes: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the pairs (component, mode) of the update: each component, a pair of modes, with its present mode."""
        return np.arange(modes**2), np.tile(np.arange(modes), modes)

    def keep_components(self, gaussians: Gaussian, weight: jax.Array, modes: int) -> tuple[Gaussian, jax.Array]:
        """Return all components, pairs of modes, as they are until the next move, and their weights (M^2, M)."""
        return gaussians, self._by_mode(weight, modes)

    def _by_mode(self, weight: jax.Array, modes: int) -> jax.Array:
        """Return the weights (M^2,) of pairs (i, j) as a matrix (M^2, M), each in the column of its present mode j.

        Pairs are listed with j running fastest.
        """
        return jnp.asarray(weight[:, None] * (np.tile(np.arange(modes), modes)[:, None] == np.arange(modes)))


def normalise_columns(weight: jax.Array) -> jax.Array:
    """Divide weights (components, mixtures) by their column sums, so that each column is a law.

    A column of zeros, of a mixture that has no probability, becomes equal weights, so that nothing is NaN.
    """
    total = jnp.sum(weight, axis=0)
    is_positive = total > float(np.finfo(total.dtype).tiny)  # the reciprocal of a smaller number would be infinite
    return jnp.where(is_positive, weight * (1 / jnp.where(is_positive, total, 1.0)), 1 / len(weight))


def mix_and_predict(
    plant: AbstractPlant,
    transform: AbstractTransform,
    components: Gaussian,
    weight: jax.Array,
    u: jax.Array,
    initial_power: jax.Array,
) -> Gaussian:
    """Return for each mixture the Gaussian (mixtures, n) of the mean and covariance of f(x, u) + w, x from the mixture.

    Args:
        plant: holds the transition f and the law of the process noise w.
        transform: how moments pass a nonlinear function, such as cubature points; not used for a linear plant.
        components: the Gaussians that are mixed (components, n), for example the posterior of each mode.
        weight: weight[c, g] is the weight of component c in mixture g; columns need not sum to 1.
        u: input of the plant.
        initial_power: E[x_i^2] before any data (n,): the size of x, in proportion to which rounding is assumed.
    """
    shares = normalise_columns(weight)
    # Nonlinear plant: first each mixture becomes one Gaussian of its moments, which then passes through f.
    if not isinstance(plant, LinearPlant):
        mixtures = jax.vmap(partial(merge_mixture, components), in_axes=1)(shares)
        return jax.vmap(lambda x: predict_gaussian(plant, transform, x, u, initial_power))(mixtures)
    # A linear plant moves each component once before they are mixed, not once for each mixture: to the mean
    # A m + B u + E w and the covariance A P A'.
    matrix, noise = plant.transition_matrix(u), factor_process_noise(plant, u, initial_power).covariance
    means = jax.vmap(lambda mean: matrix @ mean + plant.shift(u))(components.mean)
    covariances = jax.vmap(lambda x: x.columns.through(matrix).covariance)(components)

    def mix_moved(weights: jax.Array) -> Gaussian:
        """Return the Gaussian of one mixture of the moved components, with process noise: Cov(mixture) + Q.

        With the means m_c and covariances A P_c A' of the moved components and `weights` w_c: m = sum w_c m_c, and
        Cov(mixture) = sum w_c (A P_c A' + (m_c - m) (m_c - m)').
        """
        mean, covariance = moments_of_mixture(means, covariances, weights)
        return from_covariance_by_elimination(mean, covariance + noise)

    moved: Gaussian = jax.vmap(mix_moved, in_axes=1)(shares)
    return moved


def mix_and_predict_by_mode(
    plants: Sequence[AbstractPlant],
    plant_of: np.ndarray,
    transform: AbstractTransform,
    components: Gaussian,
    weight: jax.Array,
    moves: tuple[np.ndarray, np.ndarray],
    u: jax.Array,
    initial_power: jax.Array,
) -> Gaussian:
    """Return the Gaussians after a step: mixtures of the components, each moved by the plant of a mode.

    A filter of several modes replaces each mixture by a Gaussian of its mean and covariance, so that their number does
    not grow, and then predicts it.

    Args:
        plants: the different plants; several modes may share one.
        plant_of: [j], number of the plant of mode j.
        transform: of moments, for a nonlinear plant.
        components: Gaussians that are mixed, leading axis c.
        weight: [c, g], weight of component c in mixture g, not normalised.
        moves: two arrays with an entry for each Gaussian after the step: the number of the mixture that it was before,
            and the mode that moves it.
        u: input.
        initial_power: E[x_i^2] before any data (n,), on which rounding acts.
    """
    mixture_of, mode_of = moves
    if len(plants) == 1:  # each mixture is moved once, however many modes it has afterwards
        moved = mix_and_predict(plants[0], transform, components, weight, u, initial_power)
        in_order = np.array_equal(mixture_of, np.arange(weight.shape[1]))
        return moved if in_order else jax.tree.map(lambda leaf: leaf[mixture_of], moved)
    # Plant after plant, the mixtures that it moves; then all results in the order of the components after the step.
    mixtures = mix_moments(components, normalise_columns(weight))
    plant_of_result, results = plant_of[mode_of], []
    for number, plant in enumerate(plants):
        indices = mixture_of[plant_of_result == number]
        mixtures_of_plant = jax.tree.map(lambda leaf, indices=indices: leaf[indices], mixtures)
        results.append(_predict_each(plant, transform, mixtures_of_plant, u, initial_power))
    order_by_plant = np.concatenate([np.flatnonzero(plant_of_result == number) for number in range(len(plants))])
    inverse_order = np.argsort(order_by_plant)
    joined: Gaussian = jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[inverse_order], *results)
    return joined


class MixtureMoments(NamedTuple):
    """Means (mixtures, n) and covariances (mixtures, n, n) of several mixtures of Gaussians."""

    mean: jax.Array
    covariance: jax.Array


def mix_moments(gaussians: Gaussian, share: jax.Array) -> MixtureMoments:
    """Return mean and covariance of several mixtures of the same Gaussians.

    `share` (components, mixtures): column g has the shares, which sum to 1, of the components in mixture g.
    """
    covariances = jax.vmap(lambda x: x.covariance)(gaussians)

    def mix(shares: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return mean and covariance of the mixture with these shares of the components."""
        return moments_of_mixture(gaussians.mean, covariances, shares)

    mean, covariance = jax.vmap(mix, in_axes=1)(share)
    return MixtureMoments(mean, covariance)


def _predict_each(
    plant: AbstractPlant, transform: AbstractTransform, x: MixtureMoments, u: jax.Array, initial_power: jax.Array
) -> Gaussian:
    """Return the Gaussian of f(x, u) + w for the mean and covariance of each mixture `x`.

    A linear plant moves covariances, A P A', without factors of them. `initial_power`: E[x_i^2] at the start, for
    rounding.
    """
    if not isinstance(plant, LinearPlant):
        gaussians = jax.vmap(from_covariance_by_elimination)(*x)
        return jax.vmap(lambda gaussian: predict_gaussian(plant, transform, gaussian, u, initial_power))(gaussians)
    matrix, noise = plant.transition_matrix(u), factor_process_noise(plant, u, initial_power).covariance

    def move(mean: jax.Array, covariance: jax.Array) -> Gaussian:
        """Return the Gaussian of A m + B u + E w and A P A' + Q, from one mean m and covariance P."""
        return from_covariance_by_elimination(matrix @ mean + plant.shift(u), matrix @ covariance @ matrix.T + noise)

    moved: Gaussian = jax.vmap(move)(*x)
    return moved


def align_angles(plant: AbstractPlant, mean: jax.Array, weight: jax.Array) -> jax.Array:
    """Return means (components, n) with full turns added to their angles, so that they may be averaged.

    Each angle is then within half a turn of that of the component with the largest `weight` (components,).
    """
    return plant.near(mean, mean[jnp.argmax(weight)]) if plant.circular else mean


def replicate(x: T, count: int) -> T:
    """Return `count` copies of a tree of arrays, stacked along a new first axis of each array."""
    copies: T = jax.tree.map(lambda leaf: jnp.repeat(jnp.asarray(leaf)[None], count, axis=0), x)
    return copies
