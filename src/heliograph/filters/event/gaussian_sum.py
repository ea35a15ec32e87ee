"""A sum of weighted Gaussians: truncated to an interval of one component, merged, and reduced to few."""

from collections.abc import Sequence
from functools import partial
from itertools import combinations
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns
from heliograph.factors.factored_gaussian import (
    Gaussian,
    from_columns,
    merge_mixture,
    take_leading,
)
from heliograph.filters.truncation import truncate_gaussians
from heliograph.numerics.trace_settings import trace_settings
from heliograph.numerics.types import Array, Float

FLOOR = 1e-6  # least probability of data that contradict the sender's rule


class GaussianSum(NamedTuple):
    """Gaussians of a sum, with what is known of the sender in each.

    log_weight (K,), gaussian of N components with a leading axis K, status (K, senders, ...): probabilities of each
    sender's status (such as link mode, steps since it sent, transmissions lost) given the Gaussian.
    """

    log_weight: Float[jax.Array, " K"]
    gaussian: Gaussian
    status: Float[jax.Array, "K senders ..."]

    def with_sender_status(self, s: int, status: jax.Array) -> "GaussianSum":
        """Give sender s the status probabilities `status` (K, ...), one array for each of the K Gaussians.

        They need not sum to 1: their sum multiplies the Gaussian's weight. If the sum is 0, the old ones stay.
        """
        one_per_gaussian = (-1, *[1] * (status.ndim - 1))  # shape of totals (K,) that broadcasts against `status`
        total = jnp.sum(status, axis=tuple(range(1, status.ndim)))
        normalised = status / jnp.where(total > 0, total, 1.0).reshape(one_per_gaussian)
        normalised = jnp.where((total > 0).reshape(one_per_gaussian), normalised, self.status[:, s])
        return self._replace(log_weight=self.log_weight + safe_log(total), status=self.status.at[:, s].set(normalised))

    def scale_weights(self, log_factor: Array | float) -> "GaussianSum":
        """Return the sum with all weights multiplied by exp(log_factor)."""
        return self._replace(log_weight=self.log_weight + log_factor)

    def select_range(self, first: int, stop: int | None = None) -> "GaussianSum":
        """Return the sum of the Gaussians first, ..., stop - 1 alone; their weights stay."""
        few: GaussianSum = jax.tree.map(lambda leaf: leaf[first:stop], self)
        return few

    def select_components(self, indices: np.ndarray) -> "GaussianSum":
        """Return the sum of the marginal laws of some components, in the order of `indices`."""
        # The first components alone need no new factorisation.
        if np.array_equal(indices, np.arange(len(indices))):
            return self._replace(gaussian=take_leading(self.gaussian, len(indices)))

        def select(x: Gaussian) -> Gaussian:
            """Return the marginal law of these components under one Gaussian."""
            return from_columns(x.mean[indices], WeightedColumns(x.root[indices], x.variances))

        return self._replace(gaussian=jax.vmap(select)(self.gaussian))


def safe_log(x: jax.Array) -> jax.Array:
    """Return log x; at x = 0 it is -inf, with the derivative 0 in place of NaN."""
    return jnp.where(x > 0, jnp.log(jnp.where(x > 0, x, 1.0)), -jnp.inf)


def log_total_weight(log_weight: jax.Array) -> jax.Array:
    """Return the log of the sum of the weights exp(log_weight) (K,); -inf if all weights are 0.

    The weights are divided by the largest one first, so that no exponential overflows.
    """
    largest = jnp.max(log_weight)
    largest = jnp.where(jnp.isfinite(largest), largest, 0.0)
    return largest + safe_log(jnp.sum(jnp.exp(log_weight - largest)))


def concatenate_sums(sums: Sequence[GaussianSum]) -> GaussianSum:
    """Concatenate the Gaussians of several sums into one sum."""
    every: GaussianSum = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *sums)
    return every


@jax.jit
def truncate_between(mixture: GaussianSum, direction: jax.Array, lower: jax.Array, upper: jax.Array) -> GaussianSum:
    """Truncate each of K Gaussians x to lower <= d'x <= upper, and replace it by the Gaussian of the same moments.

    d is `direction` (N,); the ends are numbers, or (K,) with one for each Gaussian. The weights are multiplied by the
    probabilities of the interval.
    """
    slopes, mean = _project_on_direction(mixture, direction)
    return _truncate(mixture, mean, slopes, [jnp.broadcast_to(end, mean.shape) for end in (lower, upper)])


@jax.jit
def truncate_outside(mixture: GaussianSum, direction: jax.Array, edge: jax.Array) -> GaussianSum:
    """Truncate each of K Gaussians to d'x >= edge, and each to d'x <= -edge; return the sum of these 2 K.

    `mean` and `slopes` are those of d'x in each Gaussian: d'x = mean + slopes xi for x = m + L xi.
    """
    slopes, mean = _project_on_direction(mixture, direction)
    # d'x <= -edge is (-d)'x >= edge, so mean and slopes change sign in the second half.
    edges = jnp.full(2 * len(mean), edge)
    mean = jnp.concatenate([mean, -mean])
    slopes = jnp.concatenate([slopes, -slopes])
    return _truncate(concatenate_sums([mixture, mixture]), mean, slopes, [edges])


def _project_on_direction(mixture: GaussianSum, direction: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return slopes f (K, N) and means d'm (K,) of d'x = d'm + f xi, for Gaussians x = m + L xi and a direction d."""
    return direction @ mixture.gaussian.root, mixture.gaussian.mean @ direction


def _truncate(mixture: GaussianSum, mean: jax.Array, slopes: jax.Array, ends: Sequence[jax.Array]) -> GaussianSum:
    """Truncate Gaussians x = m + L xi to where d'x is above the first end, and below the second if there is one.

    d'x = mean + slopes xi, with `mean` (K,) and `slopes` (K, N). Each cut law is replaced by the Gaussian of the same
    moments, and each weight is multiplied by the probability of the region.
    """
    log_mass, truncated = truncate_gaussians(mixture.gaussian, mean, slopes, ends)
    return GaussianSum(mixture.log_weight + log_mass, truncated, mixture.status)


def merge_groups(mixture: GaussianSum, groups: int = 1) -> GaussianSum:
    """Merge the sum by moment matching into `groups` Gaussians, each of one consecutive block (default: all)."""
    few: GaussianSum = _merge_groups(mixture, groups, trace_settings())
    return few


@partial(jax.jit, static_argnames=("groups", "settings"))
def _merge_groups(mixture: GaussianSum, groups: int, settings: tuple[object, ...]) -> GaussianSum:
    """Merge the components of each group into one Gaussian: compiled body of `merge_groups`.

    Groups are consecutive and of equal size. Status probabilities are averaged by weights.
    `settings` is only a key, so that a trace is not used again under other settings.
    """

    def merge_group(mixture: GaussianSum) -> GaussianSum:
        """Merge one group of Gaussians by their weights, or by equal shares if all weights are 0."""
        total = log_total_weight(mixture.log_weight)
        # Weights relative to their sum, which has the logarithm `total`.
        share = jnp.exp(mixture.log_weight - jnp.where(jnp.isfinite(total), total, 0.0))
        share = jnp.where(jnp.isfinite(total), share, 1 / len(share))
        return GaussianSum(total, merge_mixture(mixture.gaussian, share), jnp.tensordot(share, mixture.status, axes=1))

    size = len(mixture.log_weight) // groups
    few: GaussianSum = jax.vmap(merge_group)(
        jax.tree.map(lambda leaf: leaf.reshape(groups, size, *leaf.shape[1:]), mixture)
    )
    return few


def restore_if_impossible(mixture: GaussianSum, prior: GaussianSum) -> GaussianSum:
    """Return the corrected sum `mixture`, or `prior` with the likelihood FLOOR (1e-6) if all corrected weights are 0.

    Then the data contradict the rule of the sender. The prior may have more components, of which it keeps the leading.
    """
    unchanged = prior.select_components(np.arange(mixture.gaussian.mean.shape[1]))
    unchanged = unchanged._replace(log_weight=unchanged.log_weight + np.log(FLOOR))
    is_impossible = ~jnp.isfinite(log_total_weight(mixture.log_weight))
    restored: GaussianSum = jax.tree.map(lambda old, new: jnp.where(is_impossible, old, new), unchanged, mixture)
    return restored


def reduce_to_count(mixture: GaussianSum, count: int, places: slice) -> GaussianSum:
    """Merge the cheapest pair of Gaussians again and again, until at most `count` are left.

    The cost of a pair with weights w1 and w2 is w1 w2 / (w1 + w2) times its squared distance in the components
    `places` of the vector, each in units of its variance.
    """
    while len(mixture.log_weight) > count:
        mixture = _merge_cheapest_pair(mixture, (places.start, places.stop), trace_settings())
    return mixture


@partial(jax.jit, static_argnames=("ends", "settings"))
def _merge_cheapest_pair(mixture: GaussianSum, ends: tuple[int, int], settings: tuple[object, ...]) -> GaussianSum:
    """Return a sum of one Gaussian fewer: the cheapest pair (a, b) merged at a's place, the last one moved to b's.

    Cost of a pair: w_a w_b / (w_a + w_b) sum_i (m_a - m_b)_i^2 / (v_a + v_b)_i, w weight, m mean and v variance, over
    the components i from ends[0] to ends[1] - 1. It is how much the merged Gaussian spreads more than its parts, in
    units of their variance. A filter merges pairs to keep few Gaussians. `settings` is only a key, as
    of `_merge_groups`.
    """
    size, places = len(mixture.log_weight), slice(*ends)
    pairs = list(combinations(range(size), 2))
    first, second = (jnp.asarray(column) for column in zip(*pairs, strict=True))
    # Weights over the largest one, so that not all of them underflow; where all are 0 there is no largest one.
    top = jnp.max(mixture.log_weight)
    weight = jnp.exp(mixture.log_weight - jnp.where(jnp.isfinite(top), top, 0.0))
    mean = mixture.gaussian.mean[:, places]
    variance = jax.vmap(lambda x: x.columns.diagonal)(mixture.gaussian)[:, places]
    # Cost of each pair, and the pair of least cost. A pair of no variance or no weight is divided by 1, not by 0.
    w1, w2 = weight[first], weight[second]
    both = variance[first] + variance[second]
    apart = (mean[first] - mean[second]) ** 2 / jnp.where(both > 0, both, 1.0)
    cost = w1 * w2 / jnp.where(w1 + w2 > 0, w1 + w2, 1.0) * jnp.sum(apart, axis=1)
    least = jnp.argmin(cost)
    chosen = jnp.arange(len(pairs)) == least
    is_first = jnp.stack([jnp.any(chosen & (first == i)) for i in range(size)])
    is_second = jnp.stack([jnp.any(chosen & (second == i)) for i in range(size)])
    # The pair joined by its moments: a merge in which all others have no weight.
    merged = merge_groups(mixture._replace(log_weight=jnp.where(is_first | is_second, mixture.log_weight, -jnp.inf)))

    def replace_pair(values: jax.Array, joined: jax.Array) -> jax.Array:
        """Return `values` (K, ...) of the Gaussians after two are joined, (K - 1, ...).

        `joined`, the value of the joined pair, replaces the value of the pair's first Gaussian. The last Gaussian's
        value replaces that of the second one. The masks `is_first` and `is_second` (K,) say which two these are.
        """
        one_each = (-1, *[1] * (values.ndim - 1))  # shape of a mask (K,) that broadcasts against `values`
        with_last_moved = jnp.where(is_second.reshape(one_each), values[-1:], values)
        return jnp.where(is_first.reshape(one_each), joined, with_last_moved)[:-1]

    fewer: GaussianSum = jax.tree.map(replace_pair, mixture, merged)
    return fewer
