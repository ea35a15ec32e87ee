"""Maps made of maps: the atom, one random gain times a matrix plus noise; in series, mixed and stacked."""

from collections.abc import Callable, Sequence
from functools import reduce
from itertools import product
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.check import array, fail, show_value
from heliograph.numerics.traced import library, scatter, stack_parts
from heliograph.numerics.types import ArrayLike, Float, PyTree
from heliograph.random_affine.base import (
    AbstractComposite,
    AbstractRandomAffine,
    AbstractUniform,
    check_forgets,
    check_maps,
)
from heliograph.random_affine.law import AbstractLaw, Constant, Discrete
from heliograph.random_affine.moments.monomials import (
    Moments,
    count_monomials,
    degrees,
    exponents,
    multiply_polynomials,
    position,
    product_table,
    refuse_if_too_large,
    sum_plan,
    symmetric_power,
)
from heliograph.random_affine.noise import AbstractNoise, Gaussian, Matrix, Vector, as_noise, noise_vector


class AbstractHop(AbstractRandomAffine):
    """Random affine map z = g A y + n of a known matrix A and a noise n, whatever the law of its gain g is."""

    matrix: eqx.AbstractVar[Matrix]
    noise: eqx.AbstractVar[AbstractNoise]

    @property
    def outputs(self) -> int:
        """Length of z."""
        return int(self.matrix.shape[-2])

    @property
    def inputs(self) -> int:
        """Length of y."""
        return int(self.matrix.shape[-1])


class GainAndNoise(AbstractHop):
    """Random affine map z = g A y + n with a scalar random gain g, a known matrix A and noise n, all independent.

    Args:
        law: law of the gain g; `Constant` for a known number.
        matrix: A (m, p).
        noise: law of n with m components, its covariance (m, m), or a variance that all components have.

    Raises:
        ValueError: a gain that is no law, shapes that do not fit, numbers that are not finite.
    """

    law: AbstractLaw
    matrix: Matrix
    noise: AbstractNoise

    def __init__(
        self, law: AbstractLaw, matrix: "Float[ArrayLike, 'm p']", noise: "AbstractNoise | Float[ArrayLike, '*m']"
    ):
        if not isinstance(law, AbstractLaw):
            raise fail("gain of a hop", "a law (Constant for a number)", show_value(law))
        self.law = law
        self.matrix = array("gain matrix", matrix, ("outputs", "inputs"))
        self.noise = as_noise("channel noise", noise, self.matrix.shape[0])

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw [[g A, n], [0, 1]]."""
        gain_key, noise_key = jax.random.split(key)
        top = jnp.concatenate(
            [self.law.sample(gain_key) * jnp.asarray(self.matrix), self.noise.sample(noise_key)[:, None]],
            axis=1,
        )
        return jnp.concatenate([top, np.eye(1, self.inputs + 1, self.inputs)], axis=0)

    @property
    def remembers(self) -> bool:
        """Always False: draws are independent over time."""
        return False

    @cache_by_object
    def moments(self, order: int) -> Moments:
        """Return sum_k E[g^k] B_k, with B_k the `gain_coefficients`."""
        gains = gain_moments(self.law, order)
        basis = self.gain_coefficients(order)
        return Moments(library(gains, basis).tensordot(gains, basis, axes=1), self.outputs, self.inputs, order)

    @cache_by_object
    def gain_coefficients(self, order: int) -> Float[jax.Array | np.ndarray, "order+1 rows columns"]:
        """Return B_k: E[prod_i (g (A y)_i + n_i)^a_i] = sum_{b <= a} C(a, b) E[g^|b|] (A y)^b E[n^(a-b)], |b| = k."""
        rows, columns = count_monomials(self.outputs + 1, order), count_monomials(self.inputs + 1, order)
        refuse_if_too_large(rows, columns, f"moments of order {order}")
        deterministic = symmetric_power(affine_matrix(self.matrix), order)  # rows (A y)^b, made homogeneous with 1
        row, column, rest, ways = sum_plan(self.outputs, order)
        terms = (ways * noise_vector(self.noise, order)[rest])[:, None] * deterministic[column]
        return scatter((order + 1, rows, columns), (degrees(self.outputs, order)[column], row), terms)

    def extremes(self) -> tuple[AbstractRandomAffine, ...]:
        """Return one map for each extreme law of the gain."""
        return tuple(GainAndNoise(law, self.matrix, self.noise) for law in self.law.extremes())

    def corner_count(self) -> int:
        """Number of extreme laws of the gain."""
        return len(self.law.corner_moments(0))

    def corner_moments(self, order: int) -> Float[jax.Array | np.ndarray, "corner rows columns"]:
        """Return the moments with E[g^k] of each extreme law."""
        gains, basis = self.law.corner_moments(order), self.gain_coefficients(order)
        moment_map: jax.Array | np.ndarray = library(gains, basis).tensordot(gains, basis, axes=1)
        return moment_map

    def mean_gain(self) -> AbstractRandomAffine:
        """Return the map E[g] A y + n."""
        return GainAndNoise(self.law.mean_law(), self.matrix, self.noise)


def affine_matrix(matrix: Matrix) -> Matrix:
    """[[A, 0], [0, 1]], which maps (y, 1) to (A y, 1)."""
    outputs, inputs = matrix.shape
    right, below = np.zeros((outputs, 1)), np.eye(1, inputs + 1, inputs)
    xp = library(matrix)
    extended: Matrix = xp.concatenate([xp.concatenate([matrix, right], axis=1), below])
    return extended


def gain_moments(law: AbstractLaw, order: int) -> Vector:
    """Return E[g^k] for k = 0, ..., order."""
    moment = law.moment  # of a module, whose methods are slow to look up
    return stack_parts([moment(k) for k in range(order + 1)])


def known(matrix: "Float[ArrayLike, 'm p']", offset: "Float[ArrayLike, ' m'] | None" = None) -> GainAndNoise:
    """Return the deterministic map z = A y + b.

    Args:
        matrix: A (m, p).
        offset: b (m,), zero unless given.

    Raises:
        ValueError: shapes that do not fit, or numbers that are not finite.
    """
    a = array("matrix", matrix, ("outputs", "inputs"))
    b = np.zeros(a.shape[0]) if offset is None else array("offset", offset, (a.shape[0],))
    return GainAndNoise(Constant(1.0), a, Gaussian(np.zeros((a.shape[0], a.shape[0])), b))


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


class Mixture(AbstractUniform, AbstractCombination):
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
        self.maps = check_maps("mixture", maps)
        self.choice = Discrete(np.arange(len(self.maps)), weights, radius)
        self.check_shapes("mixture")

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Draw which map, and every map."""
        choice_key, *keys = jax.random.split(key, len(self.maps) + 1)
        state, drawn = self._draw_each(state, keys)
        return state, jnp.stack(drawn)[self.choice.sample(choice_key).astype(int)]

    @cache_by_object
    def moments(self, order: int) -> Moments:
        """sum_i p_i E[Sym^k(H_i)]."""
        check_forgets("moments of a map", self)
        parts = [m.moments(order).matrix for m in self.maps]
        matrix = library(parts, self.choice.probabilities).tensordot(
            self.choice.probabilities, stack_parts(parts), axes=1
        )
        return Moments(matrix, self.outputs, self.inputs, order)

    def extremes(self) -> tuple[AbstractRandomAffine, ...]:
        """Extreme weights combined with the extremes of each map."""
        corners = [law for law in self.choice.extremes() if isinstance(law, Discrete)]
        return tuple(
            Mixture(parts, law.probabilities)
            for law in corners
            for parts in product(*(m.extremes() for m in self.maps))
        )

    @cache_by_object
    def corner_moments(self, order: int) -> Corners:
        """The corners of the weights, with every combination of the maps' corners."""
        parts, weights = [m.corner_moments(order) for m in self.maps], self.choice.corners()
        chosen = np.array(list(product(*(range(len(corners)) for corners in parts)))).T
        combined = stack_parts([corners[which] for corners, which in zip(parts, chosen, strict=True)])
        items = library(weights, combined).tensordot(weights, combined, axes=1)
        flat: Matrix = items.reshape(-1, *items.shape[2:])
        return flat

    def corner_count(self) -> int:
        """Extreme weights times the product of the maps' counts."""
        return len(self.choice.corners()) * super().corner_count()

    def mean_gain(self) -> AbstractRandomAffine:
        """Deterministic mean gain, with the noise covariance that the mixture has about E[n]."""
        moments = self.moments(2)
        mean = moments.mean
        second = moments.matrix[product_table(self.outputs + 1, 1, 1)[:-1, :-1], -1]  # E[n n'], the coefficients of 1
        offset = mean[:-1, -1]
        noise = Gaussian(second - offset[:, None] * offset, offset)
        return GainAndNoise(Constant(1.0), mean[:-1, :-1], noise)


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
