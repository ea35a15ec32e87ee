"""Weighted Gaussians of a sum: cut to where a component lies, joined, and reduced to few."""

from collections.abc import Sequence
from functools import partial
from itertools import combinations
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.columns import Columns
from heliograph.factors.gaussian import Gaussian, leading, merge, of_columns, revise
from heliograph.filters.event.truncated_normal import truncated_normal, upper_tail
from heliograph.numerics.types import Array, Float

FLOOR = 1e-6  # probability of what the rule forbids
CERTAIN = 1e-24  # a variance below this share of its mean square and of the interval's is rounding


class GaussianSum(NamedTuple):
    """Gaussians of a sum, with what is known of the sender in each.

    log_weight (K,), gaussian of N components with a leading axis K, label (K, senders, ...): probabilities of each
    sender's label given the Gaussian.
    """

    log_weight: Float[jax.Array, " K"]
    gaussian: Gaussian
    label: Float[jax.Array, "K senders ..."]

    def labelled(self, s: int, label: jax.Array) -> "GaussianSum":
        """Relabel sender s with (K, ...) whose sum is no longer 1: the sum goes into the weight."""
        shape = (-1, *[1] * (label.ndim - 1))
        total = jnp.sum(label, axis=tuple(range(1, label.ndim)))
        share = label / jnp.where(total > 0, total, 1.0).reshape(shape)
        share = jnp.where((total > 0).reshape(shape), share, self.label[:, s])
        return self._replace(log_weight=self.log_weight + safe_log(total), label=self.label.at[:, s].set(share))

    def times(self, log_factor: Array | float) -> "GaussianSum":
        """Multiply the weights by a factor."""
        return self._replace(log_weight=self.log_weight + log_factor)

    def some(self, first: int, stop: int | None = None) -> "GaussianSum":
        """Take some of the Gaussians."""
        few: GaussianSum = jax.tree.map(lambda leaf: leaf[first:stop], self)
        return few

    def keep(self, places: np.ndarray) -> "GaussianSum":
        """Keep some components of the Gaussians, in the order of `places`."""
        if np.array_equal(places, np.arange(len(places))):
            return self._replace(gaussian=leading(self.gaussian, len(places)))

        def keep_one(x: Gaussian) -> Gaussian:
            return of_columns(x.mean[places], Columns(x.root[places], x.variances))

        return self._replace(gaussian=jax.vmap(keep_one)(self.gaussian))


def safe_log(x: jax.Array) -> jax.Array:
    """log x, -inf at 0 without a derivative that is no number."""
    return jnp.where(x > 0, jnp.log(jnp.where(x > 0, x, 1.0)), -jnp.inf)


def log_total(log_weight: jax.Array) -> jax.Array:
    """log of the sum of weights; -inf where all are 0."""
    top = jnp.max(log_weight)
    top = jnp.where(jnp.isfinite(top), top, 0.0)
    return top + safe_log(jnp.sum(jnp.exp(log_weight - top)))


def together(parts: Sequence[GaussianSum]) -> GaussianSum:
    """Put several sums together as one."""
    every: GaussianSum = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    return every


@jax.jit
def cut(parts: GaussianSum, direction: jax.Array, lower: jax.Array, upper: jax.Array) -> GaussianSum:
    """Cut each Gaussian to lower <= d'x <= upper, (K,) or (), and take the Gaussian of the same moments."""
    row, variance = _component(parts, direction)
    ends = [jnp.broadcast_to(end, variance.shape) for end in (lower, upper)]
    return _cut(parts, parts.gaussian.mean @ direction, row, variance, ends)


@jax.jit
def cut_away(parts: GaussianSum, direction: jax.Array, edge: jax.Array) -> GaussianSum:
    """Cut each Gaussian to d'x >= edge, and after all these each to d'x <= -edge, (2 K,)."""
    row, variance = _component(parts, direction)
    centre, edges = parts.gaussian.mean @ direction, jnp.full(2 * len(variance), edge)
    centre, row = jnp.concatenate([centre, -centre]), jnp.concatenate([row, -row])
    return _cut(together([parts, parts]), centre, row, jnp.tile(variance, 2), [edges])


def _component(parts: GaussianSum, direction: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The row f (K, N) of d'x = d'm + f xi, and its variance (K,)."""
    row = direction @ parts.gaussian.root
    return row, jnp.sum(row**2 * parts.gaussian.variances, axis=1)


def _cut(
    parts: GaussianSum, centre: jax.Array, row: jax.Array, variance: jax.Array, ends: Sequence[jax.Array]
) -> GaussianSum:
    """Cut the Gaussians to where d'x = centre + row xi is above the first end, and below the second if there is one.

    With S the variance of d'x and mu, v the moments of a standard normal number that is cut: d'x moves by sqrt(S) mu
    and has the variance v S; x given d'x stays.
    """
    # Without variance d'x lies inside or it does not.
    certain = variance <= CERTAIN * (centre**2 + sum(end**2 for end in ends))
    deviation = jnp.sqrt(jnp.where(certain, 1.0, variance))
    inside = (ends[0] <= centre) & (centre <= ends[-1] if len(ends) > 1 else True)
    # Moments of a standard normal number between the two, or beyond one.
    moments = (truncated_normal if len(ends) > 1 else upper_tail)(*((end - centre) / deviation for end in ends))
    log_mass = jnp.where(certain, jnp.where(inside, 0.0, -jnp.inf), moments.log_mass)
    # Moments of the part inside, where it has any probability.
    changes = jnp.isfinite(log_mass) & ~certain
    shift = deviation * jnp.where(changes, moments.mean, 0.0)
    ratio = jnp.where(changes, moments.variance, 1.0)
    after = jax.vmap(revise)(parts.gaussian, jnp.where(changes[:, None], row, 0.0), shift, ratio)
    return GaussianSum(parts.log_weight + log_mass, after, parts.label)


def join(parts: GaussianSum, groups: int = 1) -> GaussianSum:
    """Join the sum into one Gaussian of its moments, (1, ...), or each of so many groups of as many Gaussians."""
    few: GaussianSum = _join(parts, groups)
    return few


@partial(jax.jit, static_argnames="groups")
def _join(parts: GaussianSum, groups: int) -> GaussianSum:
    def joined(parts: GaussianSum) -> GaussianSum:
        total = log_total(parts.log_weight)
        share = jnp.exp(parts.log_weight - jnp.where(jnp.isfinite(total), total, 0.0))
        share = jnp.where(jnp.isfinite(total), share, 1 / len(share))
        return GaussianSum(total, merge(parts.gaussian, share), jnp.tensordot(share, parts.label, axes=1))

    size = len(parts.log_weight) // groups
    few: GaussianSum = jax.vmap(joined)(jax.tree.map(lambda leaf: leaf.reshape(groups, size, *leaf.shape[1:]), parts))
    return few


def reduce_parts(parts: GaussianSum, count: int, places: slice) -> GaussianSum:
    """Reduce to at most `count` Gaussians: pairs that are nearest in the components `places` are joined first.

    The cost of a pair is w1 w2 / (w1 + w2) times its squared distance, of each component in units of its variances.
    """
    while len(parts.log_weight) > count:
        parts = _one_fewer(parts, (places.start, places.stop))
    return parts


@partial(jax.jit, static_argnames="ends")
def _one_fewer(parts: GaussianSum, ends: tuple[int, int]) -> GaussianSum:
    """Join the pair of least cost; it takes the place of its first, the last Gaussian that of its second."""
    size, places = len(parts.log_weight), slice(*ends)
    pairs = list(combinations(range(size), 2))
    first, second = (jnp.asarray(column) for column in zip(*pairs, strict=True))
    top = jnp.max(parts.log_weight)
    weight = jnp.exp(parts.log_weight - jnp.where(jnp.isfinite(top), top, 0.0))
    centre, spread = parts.gaussian.mean[:, places], jax.vmap(lambda x: x.columns.diagonal)(parts.gaussian)[:, places]
    # Cost of each pair, and the least.
    w1, w2 = weight[first], weight[second]
    both = spread[first] + spread[second]
    apart = (centre[first] - centre[second]) ** 2 / jnp.where(both > 0, both, 1.0)
    cost = w1 * w2 / jnp.where(w1 + w2 > 0, w1 + w2, 1.0) * jnp.sum(apart, axis=1)
    least = jnp.argmin(cost)
    chosen = jnp.arange(len(pairs)) == least
    is_first = jnp.stack([jnp.any(chosen & (first == i)) for i in range(size)])
    is_second = jnp.stack([jnp.any(chosen & (second == i)) for i in range(size)])
    # The two joined; the others keep their places.
    merged = join(parts._replace(log_weight=jnp.where(is_first | is_second, parts.log_weight, -jnp.inf)))

    def placed(values: jax.Array, new: jax.Array) -> jax.Array:
        shape = (-1, *[1] * (values.ndim - 1))
        moved = jnp.where(is_second.reshape(shape), values[-1:], values)
        return jnp.where(is_first.reshape(shape), new, moved)[:-1]

    fewer: GaussianSum = jax.tree.map(placed, parts, merged)
    return fewer
