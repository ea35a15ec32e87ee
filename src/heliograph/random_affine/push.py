"""Moments of y carried through a map to those of z, without forming the matrix E[Sym^k(H)] of that order.

A lift of degree d needs moments of order 2 d, but only as one vector: what is pushed is (E[mono_k(y)]), and the
largest matrix that a known matrix A needs is Sym^(k/2)(A).
"""

from functools import cache, reduce, singledispatch
from itertools import product
from math import comb, prod

import equinox as eqx
import jax
import numpy as np

from heliograph.numerics.check import fail
from heliograph.random_affine.atoms import GainAndNoise
from heliograph.random_affine.base import AbstractRandomAffine, check_forgets
from heliograph.random_affine.combine import Mixture, Series
from heliograph.random_affine.monomials import Exponents, count, exponents, position, product_table, symmetric_power
from heliograph.random_affine.noise import AbstractNoise


@singledispatch
def push(channel: AbstractRandomAffine, order: int, moments: np.ndarray) -> np.ndarray:
    """E[mono_order(z)] from E[mono_order(y)], for y independent of the map.

    The same numbers as `channel.moments(order).expect(moments)`, which is what a map of no known structure does.

    Shapes: moments (C(inputs + k, k),) -> (C(outputs + k, k),).

    Raises:
        ValueError: a vector that does not have one entry for each monomial, or moments of more than the stated memory.
    """
    result: np.ndarray = channel.moments(order).expect(_checked(channel, order, moments))
    return result


@push.register
def _(channel: GainAndNoise, order: int, moments: np.ndarray) -> np.ndarray:
    """(A y)^b, then E[g^|b|], then sum_b C(a, b) E[n^(a-b)] (A y)^b."""
    homogeneous = np.zeros((channel.outputs + 1, channel.inputs + 1))
    homogeneous[:-1, :-1], homogeneous[-1, -1] = channel.matrix, 1.0
    known = push_known(homogeneous, order, _checked(channel, order, moments))
    gains = np.array([channel.gain.moment(k) for k in range(order + 1)])
    scaled = known * gains[_degrees(channel.outputs, order)]
    row, column, noise, weight = _sum_plan(channel.outputs, order)
    terms = weight * noise_vector(channel.noise, order)[noise] * scaled[column]
    return np.bincount(row, terms, minlength=len(scaled))


@push.register
def _(channel: Series, order: int, moments: np.ndarray) -> np.ndarray:
    return reduce(lambda m, part: push(part, order, m), channel.maps, moments)


@push.register
def _(channel: Mixture, order: int, moments: np.ndarray) -> np.ndarray:
    parts = np.array([push(part, order, moments) for part in channel.maps])
    result: np.ndarray = channel.choice.probabilities @ parts
    return result


def push_known(homogeneous: np.ndarray, order: int, moments: np.ndarray) -> np.ndarray:
    """E[mono(z)] of z = A y + b with H = [[A, b], [0, 1]]: entries of Sym(H) E[Y Y'] Sym(H)' at half the order.

    Shapes: (z + 1, y + 1), (C(y + k, k),) -> (C(z + k, k),).
    """
    if order % 2:
        result: np.ndarray = symmetric_power(homogeneous, order) @ moments
        return result
    outputs, inputs = homogeneous.shape
    lifted = symmetric_power(homogeneous, order // 2)
    second = lifted @ second_moments(moments, inputs, order // 2) @ lifted.T
    return np.asarray(second.reshape(-1)[_one_place(outputs, order // 2)])


def noise_vector(noise: AbstractNoise, order: int) -> np.ndarray:
    """E[mono_order(n)] of a noise law: all moments up to `order`, (C(dimension + order, order),)."""
    moment = noise.moment
    return np.array([moment(powers[:-1]) for powers in exponents(noise.dimension + 1, order)])


class Tabulated(AbstractNoise):
    """A noise whose moments up to an order were computed once, for models that read them at every step."""

    mean: np.ndarray
    covariance: np.ndarray
    source: AbstractNoise
    table: dict[Exponents, float] = eqx.field(static=True)

    def __init__(self, source: AbstractNoise, order: int):
        self.mean, self.covariance, self.source = source.mean, source.covariance, source
        powers = [a[:-1] for a in exponents(source.dimension + 1, order)]
        self.table = dict(zip(powers, noise_vector(source, order).tolist(), strict=True))

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw from the law itself."""
        return self.source.sample(key)

    def moment(self, powers: Exponents) -> float:
        """Look E[n^a] up."""
        return self.table[tuple(powers)]


def second_moments(moments: np.ndarray, variables: int, degree: int) -> np.ndarray:
    """E[Y Y'] of the monomials Y of `degree` in (y, 1), gathered from the moments of order 2 degree; last row E[Y'].

    Shapes: (C(p + 2 k, 2 k),) -> (C(p + k, k), C(p + k, k)), with variables p + 1.
    """
    return np.asarray(moments[product_table(variables, degree, degree)])


def _checked(channel: AbstractRandomAffine, order: int, moments: np.ndarray) -> np.ndarray:
    check_forgets("channel of a lift", channel)
    expected = count(channel.inputs + 1, order)
    if np.shape(moments) != (expected,):
        raise fail(f"moments of order {order}", f"shape ({expected},)", f"shape {np.shape(moments)}")
    return moments


@cache
def _one_place(variables: int, degree: int) -> np.ndarray:
    """For each monomial of degree 2 k, one place (flattened) where it stands in the table of products."""
    table = product_table(variables, degree, degree).reshape(-1)
    places = np.zeros(count(variables, 2 * degree), dtype=np.int64)
    places[table] = np.arange(table.size)
    return places


@cache
def _degrees(dimension: int, order: int) -> np.ndarray:
    """Degree of each monomial in the variables other than 1."""
    return np.array([order - powers[-1] for powers in exponents(dimension + 1, order)])


@cache
def _sum_plan(dimension: int, order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(y + n)^a = sum_b C(a, b) n^(a-b) y^b as four columns: place of a, of b, of a - b, and C(a, b)."""
    places, terms = position(dimension + 1, order), []
    for row, powers in enumerate(exponents(dimension + 1, order)):
        a = powers[:-1]
        for b in product(*(range(x + 1) for x in a)):
            rest = tuple(x - y for x, y in zip(a, b, strict=True))
            weight = prod(comb(x, y) for x, y in zip(a, b, strict=True))
            terms.append((row, places[(*b, order - sum(b))], places[(*rest, order - sum(rest))], weight))
    row_, column, noise, weight_ = np.array(terms, dtype=np.int64).T
    return row_, column, noise, weight_
