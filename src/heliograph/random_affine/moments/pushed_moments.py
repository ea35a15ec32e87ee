"""Moments of y carried through a map to those of z, without forming the matrix E[Sym^k(H)] of that order.

A lift of degree d needs moments of order 2 d, but only as one vector: what is pushed is (E[mono_k(y)]), and the
largest matrix that a known matrix A needs is Sym^(k/2)(A).
"""

from functools import reduce, singledispatch

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.caching import cache_arrays
from heliograph.numerics.check import fail
from heliograph.numerics.numpy_or_jax import is_traced, plain, stack_parts
from heliograph.numerics.types import Float
from heliograph.random_affine.base import AbstractRandomAffine, check_forgets
from heliograph.random_affine.hop import GainAndNoise, affine_matrix, tabulate_gain_moments
from heliograph.random_affine.mixture import Mixture
from heliograph.random_affine.moments.monomials import (
    Exponents,
    count_monomials,
    degrees,
    list_exponents,
    plan_binomial_sums,
    position,
    product_table,
    symmetric_power,
)
from heliograph.random_affine.noises.noise import AbstractNoise, Number, noise_moment_vector
from heliograph.random_affine.series_and_stack import Series

Array1 = Float[jax.Array | np.ndarray, " n"]
Array2 = Float[jax.Array | np.ndarray, "n m"]


@singledispatch
def push_moments(channel: AbstractRandomAffine, order: int, moments: Array1) -> Array1:
    """Return all moments of z = G y + n up to `order`, from the same `moments` of y, which is independent of G and n.

    They are the means of the monomials of total degree k = `order` in (z, 1), and in (y, 1), in the order of
    `list_exponents`. Maps of known structure have methods that need less memory; this one, for any other map,
    multiplies by the matrix E[Sym^k(H)].

    Shapes: moments (C(inputs + k, k),) -> (C(outputs + k, k),).
    """
    return channel.moments(order).expect(_read_moments(channel, order, moments))


@push_moments.register
def _push_through_hop(channel: GainAndNoise, order: int, moments: Array1) -> Array1:
    """Return the means of all monomials of (z, 1), z = g A y + n, from the `moments`, those of (y, 1).

    E[z^a] = sum_{b <= a} C(a, b) E[n^(a-b)] E[g^|b|] E[(A y)^b].
    """
    of_known_map = push_through_known_map(affine_matrix(channel.matrix), order, _read_moments(channel, order, moments))
    scaled = of_known_map * tabulate_gain_moments(channel.law, order)[degrees(channel.outputs, order)]
    row, column, remainder, binomial = plan_binomial_sums(channel.outputs, order)
    noise_moments = noise_moment_vector(channel.noise, order)
    terms = binomial * noise_moments[remainder] * scaled[column]
    if is_traced(terms):
        return jnp.bincount(row, terms, length=len(scaled))
    return np.bincount(row, np.asarray(terms), minlength=len(scaled))


@push_moments.register
def _push_through_series(channel: Series, order: int, moments: Array1) -> Array1:
    """Return the moments of z behind maps in series: from y through the first map, then through the next, and so on."""
    return reduce(lambda m, affine: push_moments(affine, order, m), channel.maps, moments)


@push_moments.register
def _push_through_mixture(channel: Mixture, order: int, moments: Array1) -> Array1:
    """Return the moments of z behind a map that is drawn from several: sum_i p_i E_i[mono(z)], p_i their weights."""
    parts = [push_moments(affine, order, moments) for affine in channel.maps]
    return channel.choice.probabilities @ stack_parts(parts)


def push_through_known_map(homogeneous: Array2, order: int, moments: Array1) -> Array1:
    """Return the means of all monomials of (z, 1), z = A y + b, from the `moments`, those of (y, 1).

    `homogeneous` is H = [[A, b], [0, 1]]. At an even order they are entries of Sym(H) E[Y Y'] Sym(H)', with Y the
    monomials of half the order. This takes fewer products.

    Shapes: (z + 1, y + 1), (C(y + k, k),) -> (C(z + k, k),).
    """
    mapped: Array1
    if order % 2:
        mapped = symmetric_power(homogeneous, order) @ moments
        return mapped
    outputs, inputs = homogeneous.shape
    lifted = symmetric_power(homogeneous, order // 2)
    mapped_products = lifted @ products_of_monomials(moments, inputs, order // 2) @ lifted.T
    mapped = mapped_products.reshape(-1)[_choose_product_indices(outputs, order // 2)]
    return mapped


class TabulatedNoise(AbstractNoise):
    """A noise whose moments up to an order were computed once, for models that read them at every step."""

    mean: Array1
    covariance: Array2
    source: AbstractNoise
    table: Array1
    order: int = eqx.field(static=True)

    def __init__(self, source: AbstractNoise, order: int):
        """Compute all moments of the noise `source` up to `order`, and hold them as a table."""
        self.mean, self.covariance, self.source = source.mean, source.covariance, source
        self.table = noise_moment_vector(source, order)
        self.order = order

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw a noise vector from the law `source` itself."""
        return self.source.sample(key)

    def moment(self, powers: Exponents) -> Number:
        """Look E[n^a] up in the table, for the exponents a = `powers`.

        The table has the monomials of total degree `order` in (n, 1): n^a is there as n^a 1^(order - |a|).
        """
        power_of_one = self.order - sum(powers)
        place = position(len(powers) + 1, self.order)[(*powers, power_of_one)]
        return plain(self.table[place])


@noise_moment_vector.register
def _read_tabulated_moments(noise: TabulatedNoise, order: int) -> Array1:
    """Return all moments of the noise up to `order`, selected from its table of a higher order."""
    return noise.table[_positions_of_lower_order(noise.dimension, order, noise.order)]


@cache_arrays
def _positions_of_lower_order(dimension: int, order: int, above: int) -> np.ndarray:
    """Return where a table of moments up to the order `above` has those up to a lower `order`.

    A table of order k holds E[n^a] for each monomial n^a 1^(k - |a|) of total degree k in (n, 1), in the order of
    `list_exponents`; n has `dimension` numbers. So from one table to the other only the power of 1 grows, by
    above - order.
    """
    position_above = position(dimension + 1, above)
    positions = []
    for *a, power_of_one in list_exponents(dimension + 1, order):
        positions.append(position_above[(*a, power_of_one + above - order)])
    return np.array(positions)


def products_of_monomials(moments: Array1, variables: int, degree: int) -> Array2:
    """Return E[Y Y'] of the monomials Y of `degree` in (y, 1) from the moments of order 2 degree; last row E[Y'].

    Shapes: (C(p + 2 k, 2 k),) -> (C(p + k, k), C(p + k, k)), with variables p + 1.
    """
    return moments[product_table(variables, degree, degree)]


def _read_moments(channel: AbstractRandomAffine, order: int, moments: Array1) -> Array1:
    """Return the moments; raise ValueError unless there is one for each monomial of (y, 1), y the channel's input.

    The channel must have no memory.
    """
    check_forgets("channel of a lift", channel)
    expected = count_monomials(channel.inputs + 1, order)
    if np.shape(moments) != (expected,):
        raise fail(f"moments of order {order}", f"shape ({expected},)", f"shape {np.shape(moments)}")
    return moments


@cache_arrays
def _choose_product_indices(variables: int, degree: int) -> np.ndarray:
    """Return for each monomial of degree 2 k one place in the flattened table of products of monomials of degree k.

    If several products give the same monomial, it is the place of the last one.
    """
    table = product_table(variables, degree, degree).reshape(-1)
    product_positions = np.zeros(count_monomials(variables, 2 * degree), dtype=np.int64)
    product_positions[table] = np.arange(table.size)
    return product_positions
