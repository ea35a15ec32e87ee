"""Maps made of maps: in series, mixed, stacked, and lifted to monomials."""

from collections.abc import Sequence
from functools import reduce
from itertools import product
from math import prod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree

from heliograph.numerics.caching import cached
from heliograph.numerics.check import fail
from heliograph.numerics.traced import library, stacked
from heliograph.numerics.types import ArrayLike
from heliograph.random_affine.atoms import GainAndNoise
from heliograph.random_affine.base import AbstractOfOneShape, AbstractRandomAffine, as_maps, check_forgets
from heliograph.random_affine.law import Constant, Discrete
from heliograph.random_affine.moments.moments import Moments
from heliograph.random_affine.moments.monomials import (
    count,
    exponents,
    multiply,
    position,
    product_table,
    refuse_if_too_large,
)
from heliograph.random_affine.noise import Gaussian, Matrix, Vector

Corners = Float[jax.Array | np.ndarray, "corner rows columns"]


class _Parts(AbstractRandomAffine):
    """Map made of several maps: its state is the tuple of theirs, and all of them move at each draw."""

    maps: eqx.AbstractVar[tuple[AbstractRandomAffine, ...]]

    @property
    def erases(self) -> bool:
        """True if one of the maps erases."""
        return any(m.erases for m in self.maps)

    @property
    def remembers(self) -> bool:
        """True if one of the maps remembers."""
        return any(m.remembers for m in self.maps)

    def _init(self, key: jax.Array) -> PyTree[jax.Array]:
        """The maps' states."""
        keys = jax.random.split(key, len(self.maps))
        return tuple(m.init(k) for m, k in zip(self.maps, keys, strict=True)) if self.remembers else ()

    def _draw_each(
        self, state: PyTree[jax.Array], keys: Sequence[jax.Array] | jax.Array
    ) -> tuple[PyTree[jax.Array], list[jax.Array]]:
        """Next state and one H of each map."""
        states = state if self.remembers else ((),) * len(self.maps)
        pairs = [m.draw(s, k) for m, s, k in zip(self.maps, states, keys, strict=True)]
        return tuple(s for s, _ in pairs) if self.remembers else (), [h for _, h in pairs]


class Series(_Parts):
    """Series of independent maps, z = H_last ... H_2 H_1 y; E[Sym^k] is the product of the E[Sym^k].

    Args:
        maps: the maps, first the one that takes y; each takes as many inputs as the one before has outputs.
    """

    maps: tuple[AbstractRandomAffine, ...]

    def __init__(self, maps: Sequence[AbstractRandomAffine]):
        self.maps = as_maps("series", maps)
        for first, second in zip(self.maps, self.maps[1:], strict=False):
            if first.outputs != second.inputs:
                raise fail("series", f"a map that takes {first.outputs} inputs", f"one that takes {second.inputs}")

    @property
    def outputs(self) -> int:
        """Outputs of the last map."""
        return self.maps[-1].outputs

    @property
    def inputs(self) -> int:
        """Inputs of the first map."""
        return self.maps[0].inputs

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Draw each map and multiply."""
        state, drawn = self._draw_each(state, jax.random.split(key, len(self.maps)))
        then = _after if self.erases else jnp.matmul
        return state, reduce(lambda h, part: then(part, h), drawn)

    @cached
    def moments(self, order: int) -> Moments:
        """E[Sym^k(H2 H1)] = E[Sym^k(H2)] E[Sym^k(H1)]."""
        check_forgets("moments of a map", self)
        matrix = reduce(lambda done, part: part.moments(order).matrix @ done, self.maps[1:],
                        self.maps[0].moments(order).matrix)  # fmt: skip
        return Moments(matrix, self.outputs, self.inputs, order)

    def extremes(self) -> tuple[AbstractRandomAffine, ...]:
        """All combinations of the parts' extremes: moments are linear in the law of each part."""
        return tuple(Series(parts) for parts in product(*(m.extremes() for m in self.maps)))

    @cached
    def corner_moments(self, order: int) -> Corners:
        """Products of the parts' corners."""
        first, *rest = (m.corner_moments(order) for m in self.maps)
        for part in rest:
            items = part @ first[:, None]
            first = items.reshape(-1, *items.shape[2:])
        return first

    def corner_count(self) -> int:
        """Product of the parts' counts."""
        return prod(m.corner_count() for m in self.maps)

    def mean_gain(self) -> AbstractRandomAffine:
        """Each part with its mean gain."""
        return Series([m.mean_gain() for m in self.maps])


def _after(second: jax.Array, first: jax.Array) -> jax.Array:
    """The product of two drawn maps, where NaN rows of the first are lost: what has no gain on them is not."""
    lost = jnp.isnan(first).any(axis=1)
    reached = jnp.any((second != 0) & lost, axis=1) | jnp.isnan(second).any(axis=1)
    return jnp.where(reached[:, None], jnp.nan, second @ jnp.where(lost[:, None], 0.0, first))


class Mixture(AbstractOfOneShape, _Parts):
    """Mixture of maps, one of them drawn at each step; moments are linear in the (possibly uncertain) weights.

    Args:
        maps: maps of one shape.
        weights: their probabilities (maps,).
        radius: how far each probability may be off; one number or (maps,), 0 unless given.
    """

    maps: tuple[AbstractRandomAffine, ...]
    choice: Discrete

    def __init__(
        self,
        maps: Sequence[AbstractRandomAffine],
        weights: "Float[ArrayLike, ' maps']",
        radius: "Float[ArrayLike, '*maps']" = 0.0,
    ):
        self.maps = as_maps("mixture", maps)
        self.choice = Discrete(np.arange(len(self.maps)), weights, radius)
        self.check_shapes("mixture")

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Draw which map, and every map."""
        choice_key, *keys = jax.random.split(key, len(self.maps) + 1)
        state, drawn = self._draw_each(state, keys)
        return state, jnp.stack(drawn)[self.choice.sample(choice_key).astype(int)]

    @cached
    def moments(self, order: int) -> Moments:
        """sum_i p_i E[Sym^k(H_i)]."""
        check_forgets("moments of a map", self)
        parts = [m.moments(order).matrix for m in self.maps]
        matrix = library(parts, self.choice.probabilities).tensordot(self.choice.probabilities, stacked(parts), axes=1)
        return Moments(matrix, self.outputs, self.inputs, order)

    def extremes(self) -> tuple[AbstractRandomAffine, ...]:
        """Extreme weights combined with the extremes of each map."""
        corners = [law for law in self.choice.extremes() if isinstance(law, Discrete)]
        return tuple(
            Mixture(parts, law.probabilities)
            for law in corners
            for parts in product(*(m.extremes() for m in self.maps))
        )

    @cached
    def corner_moments(self, order: int) -> Corners:
        """The corners of the weights, with every combination of the maps' corners."""
        parts, weights = [m.corner_moments(order) for m in self.maps], self.choice.corners()
        chosen = np.array(list(product(*(range(len(part)) for part in parts)))).T
        combined = stacked([part[item] for part, item in zip(parts, chosen, strict=True)])
        items = library(weights, combined).tensordot(weights, combined, axes=1)
        result: Matrix = items.reshape(-1, *items.shape[2:])
        return result

    def corner_count(self) -> int:
        """Extreme weights times the product of the maps' counts."""
        return len(self.choice.corners()) * prod(m.corner_count() for m in self.maps)

    def mean_gain(self) -> AbstractRandomAffine:
        """Deterministic mean gain, with the noise covariance that the mixture has about E[n]."""
        moments = self.moments(2)
        mean = moments.mean
        second = moments.matrix[product_table(self.outputs + 1, 1, 1)[:-1, :-1], -1]  # E[n n'], the coefficients of 1
        offset = mean[:-1, -1]
        noise = Gaussian(second - offset[:, None] * offset, offset)
        return GainAndNoise(Constant(1.0), mean[:-1, :-1], noise)


class Stack(_Parts):
    """Independent maps that hear the same y, their outputs one above the other; moments are products of polynomials."""

    maps: tuple[AbstractRandomAffine, ...]

    def __init__(self, maps: Sequence[AbstractRandomAffine]):
        self.maps = as_maps("stack", maps)
        if len({m.inputs for m in self.maps}) != 1:
            raise fail("stack", "maps of one number of inputs", [m.inputs for m in self.maps])

    @property
    def outputs(self) -> int:
        """Sum of the maps' outputs."""
        return sum(m.outputs for m in self.maps)

    @property
    def inputs(self) -> int:
        """Inputs of each map."""
        return self.maps[0].inputs

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Draw each map and stack the rows."""
        state, drawn = self._draw_each(state, jax.random.split(key, len(self.maps)))
        rows = [h[:-1] for h in drawn]
        return state, jnp.concatenate([*rows, np.eye(1, self.inputs + 1, self.inputs)], axis=0)

    @cached
    def moments(self, order: int) -> Moments:
        """E[z1^a z2^b | y] = E[z1^a | y] E[z2^b | y], a product of polynomials in y."""
        check_forgets("moments of a map", self)
        refuse_if_too_large(count(self.outputs + 1, order), count(self.inputs + 1, order), f"moments of order {order}")
        items = [m.moments(order) for m in self.maps]
        tables = [[m.lower(k) if k else None for k in range(order + 1)] for m in items]
        rows = [self._row(powers, tables) for powers in exponents(self.outputs + 1, order)]
        return Moments(stacked(rows), self.outputs, self.inputs, order)

    def _row(self, powers: tuple[int, ...], tables: list[list[Matrix | None]]) -> Vector:
        variables, start = self.inputs + 1, 0
        result: Vector = np.ones(1)
        degree = 0
        for m, table in zip(self.maps, tables, strict=True):
            a = powers[start : start + m.outputs]
            start += m.outputs
            k = sum(a)
            part = table[k]
            if part is not None:
                polynomial = part[position(m.outputs + 1, k)[(*a, 0)]]
                result, degree = multiply(result, degree, polynomial, k, variables), degree + k
        constant = np.zeros(count(variables, powers[-1]))
        constant[-1] = 1.0  # 1^(order - |a|)
        result = multiply(result, degree, constant, powers[-1], variables)
        return result

    def extremes(self) -> tuple[AbstractRandomAffine, ...]:
        """All combinations of the parts' extremes."""
        return tuple(Stack(parts) for parts in product(*(m.extremes() for m in self.maps)))

    def corner_count(self) -> int:
        """Product of the parts' counts."""
        return prod(m.corner_count() for m in self.maps)

    def mean_gain(self) -> AbstractRandomAffine:
        """Each part with its mean gain."""
        return Stack([m.mean_gain() for m in self.maps])
