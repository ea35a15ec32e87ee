"""Maps made of independent maps: in series, and side by side."""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.check import fail
from heliograph.numerics.traced import stack_parts
from heliograph.numerics.types import Float, PyTree
from heliograph.random_affine.base import AbstractRandomAffine, check_forgets, check_maps
from heliograph.random_affine.composite import AbstractComposite
from heliograph.random_affine.moments.monomials import (
    Moments,
    count_monomials,
    exponents,
    multiply_polynomials,
    position,
    refuse_if_too_large,
)

Corners = Float[jax.Array | np.ndarray, "corner rows columns"]


class AbstractCombination(AbstractComposite):
    """Map made of several maps: its state is the tuple of theirs, and all of them move at each draw."""

    maps: eqx.AbstractVar[tuple[AbstractRandomAffine, ...]]

    @property
    def inputs(self) -> int:
        """Inputs of the first map."""
        return self.maps[0].inputs

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


class Series(AbstractCombination):
    """Series of independent maps, z = H_last ... H_2 H_1 y; E[Sym^k] is the product of the E[Sym^k].

    Args:
        maps: the maps, first the one that takes y; each takes as many inputs as the one before has outputs.
    """

    maps: tuple[AbstractRandomAffine, ...]

    def __init__(self, maps: Sequence[AbstractRandomAffine]):
        self.maps = check_maps("series", maps)
        for first, second in zip(self.maps, self.maps[1:], strict=False):
            if first.outputs != second.inputs:
                raise fail("series", f"a map that takes {first.outputs} inputs", f"one that takes {second.inputs}")

    @property
    def outputs(self) -> int:
        """Outputs of the last map."""
        return self.maps[-1].outputs

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Draw each map and multiply."""
        state, drawn = self._draw_each(state, jax.random.split(key, len(self.maps)))
        then = _compose_draws if self.erases else jnp.matmul
        return state, reduce(lambda h, matrix: then(matrix, h), drawn)

    @cache_by_object
    def moments(self, order: int) -> Moments:
        """E[Sym^k(H2 H1)] = E[Sym^k(H2)] E[Sym^k(H1)]."""
        check_forgets("moments of a map", self)
        matrix = reduce(lambda done, affine: affine.moments(order).matrix @ done, self.maps[1:],
                        self.maps[0].moments(order).matrix)  # fmt: skip
        return Moments(matrix, self.outputs, self.inputs, order)

    @cache_by_object
    def corner_moments(self, order: int) -> Corners:
        """Products of the parts' corners."""
        first, *rest = (m.corner_moments(order) for m in self.maps)
        for corners in rest:
            products = corners @ first[:, None]
            first = products.reshape(-1, *products.shape[2:])
        return first


def maps_in_series(channel: AbstractRandomAffine) -> list[AbstractRandomAffine]:
    """Return the maps of a channel in series, those of series within it too; itself alone where it is none."""
    return [m for affine in channel.maps for m in maps_in_series(affine)] if isinstance(channel, Series) else [channel]


def _compose_draws(second: jax.Array, first: jax.Array) -> jax.Array:
    """The product of two drawn maps, where NaN rows of the first are lost: what has no gain on them is not."""
    lost = jnp.isnan(first).any(axis=1)
    reached = jnp.any((second != 0) & lost, axis=1) | jnp.isnan(second).any(axis=1)
    return jnp.where(reached[:, None], jnp.nan, second @ jnp.where(lost[:, None], 0.0, first))


class Stack(AbstractCombination):
    """Stack of independent maps of the same y, outputs one above the other; moments are products of polynomials."""

    maps: tuple[AbstractRandomAffine, ...]

    def __init__(self, maps: Sequence[AbstractRandomAffine]):
        self.maps = check_maps("stack", maps)
        if len({m.inputs for m in self.maps}) != 1:
            raise fail("stack", "maps of one number of inputs", [m.inputs for m in self.maps])

    @property
    def outputs(self) -> int:
        """Sum of the maps' outputs."""
        return sum(m.outputs for m in self.maps)

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Draw each map and stack the rows."""
        state, drawn = self._draw_each(state, jax.random.split(key, len(self.maps)))
        rows = [h[:-1] for h in drawn]
        return state, jnp.concatenate([*rows, np.eye(1, self.inputs + 1, self.inputs)], axis=0)

    @cache_by_object
    def moments(self, order: int) -> Moments:
        """E[z1^a z2^b | y] = E[z1^a | y] E[z2^b | y], a product of polynomials in y."""
        check_forgets("moments of a map", self)
        refuse_if_too_large(
            count_monomials(self.outputs + 1, order),
            count_monomials(self.inputs + 1, order),
            f"moments of order {order}",
        )
        items = [m.moments(order) for m in self.maps]
        tables = [[m.lower(k) if k else None for k in range(order + 1)] for m in items]
        return Moments(
            stack_parts(stack_rows(self, order, tables, multiply_polynomials)), self.outputs, self.inputs, order
        )


def stack_rows(channel: Stack, order: int, tables: list[list[Any]], times: Callable[..., Any]) -> list[Any]:
    """Return E[z^a | y] = prod_parts E[z_part^(a_part) | y] for each power a, as polynomials in y.

    Args:
        channel: the stack.
        order: degree of the monomials of (z, 1).
        tables: of each part and degree its polynomials (..., rows, columns); None of degree 0.
        times: product of two polynomials, from (a, degree of a, b, degree of b, number of variables).
    """
    variables, rows = channel.inputs + 1, []
    for powers in exponents(channel.outputs + 1, order):
        polynomial, degree, start = np.ones(1), 0, 0
        for m, table in zip(channel.maps, tables, strict=True):
            a = powers[start : start + m.outputs]
            start, k = start + m.outputs, sum(a)
            if k:
                factor = table[k][..., position(m.outputs + 1, k)[(*a, 0)], :]
                polynomial, degree = times(polynomial, degree, factor, k, variables), degree + k
        constant = np.zeros(count_monomials(variables, powers[-1]))
        constant[-1] = 1.0  # 1^(order - |a|)
        rows.append(times(polynomial, degree, constant, powers[-1], variables))
    return rows
