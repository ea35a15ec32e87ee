"""Joint moments E[z^a | y] of a sum of independent maps, z = t + r, from those of the summands.

By the binomial theorem E[(t + r)^c | y] = sum_{b <= c} C(c, b) E[t^b | y] E[r^(c-b) | y]. Each factor is a polynomial
in the components of y that its summand takes.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.caching import cache_arrays
from heliograph.numerics.numpy_or_jax import library, scatter
from heliograph.numerics.types import Float
from heliograph.random_affine.moments.monomials import (
    count_monomials,
    factor_variables,
    list_exponents,
    place_monomials,
    plan_binomial_sums,
    position,
    times_one,
)

Components = tuple[int, ...]  # indices of components of y
Corners = Float[jax.Array | np.ndarray, "corner rows columns"]


class SumMoments(NamedTuple):
    """Moments E[t^a | y] of a vector t, for each extreme law ("corner"), as homogeneous polynomials in (y, 1).

    components: indices of the components of y on which t depends, in increasing order. by_degree: for each degree
    |a| = 0, 1, ... the coefficients (corner, monomial t^a, monomial of these components and 1), both of this degree.
    """

    components: Components
    by_degree: list[Corners]


def expand_map_moments(matrix: Corners, outputs: int, components: Components, order: int) -> SumMoments:
    """Return the polynomials E[t^a | y], |a| <= order, of one map t = H (y_c, 1), y_c some components of y.

    Args:
        matrix: E[Sym^order(H)] under each extreme law ("corner") of the map (corners, rows, columns). Its row for the
            monomial t^a 1^(order - |a|) has the coefficients of E[t^a | y], for the monomials of (y_c, 1).
        outputs: length of t.
        components: indices in y of y_c, in any order. The polynomials returned have them in increasing order.
        order: order of the moments.
    """
    ordered = tuple(sorted(components))
    variables = len(components) + 1
    # For each variable of H, its number in the increasing order; the constant 1 is last in both.
    sorted_variable = np.array([ordered.index(i) for i in components] + [len(components)])
    by_degree = [library(matrix).ones((len(matrix), 1, 1))]
    for degree in range(1, order + 1):
        rows = find_monomials_of_degree(outputs, degree, order)
        columns = times_one(variables, degree, order)
        # Column j of H's order goes to the position of monomial j in the increasing order; argsort inverts this.
        new_positions = place_monomials(sorted_variable[factor_variables(variables, degree)], variables)
        by_degree.append(matrix[:, rows[:, None], columns[np.argsort(new_positions)]])
    return SumMoments(ordered, by_degree)


@cache_arrays
def find_monomials_of_degree(outputs: int, degree: int, order: int) -> np.ndarray:
    """Return the positions of z^a 1^(order - degree), |a| = degree, among the monomials of (z, 1) of degree `order`.

    `outputs` is the length of z. The constant 1 is the last variable.
    """
    factors = factor_variables(outputs, degree)
    factors_with_ones = np.pad(factors, ((0, 0), (0, order - degree)), constant_values=outputs)
    return place_monomials(factors_with_ones, outputs + 1)


def sum_moments_by_halves(summands: Sequence[SumMoments], outputs: int) -> SumMoments:
    """Return the moments E[t^a | y] of the sum t of independent summands, from those of its halves.

    Polynomials of few variables are so multiplied first, which is fastest.
    """
    if len(summands) == 1:
        return summands[0]
    middle = len(summands) // 2
    first_half = sum_moments_by_halves(summands[:middle], outputs)
    second_half = sum_moments_by_halves(summands[middle:], outputs)
    return add_independent_moments(first_half, second_half, outputs)


def add_independent_moments(t: SumMoments, r: SumMoments, outputs: int) -> SumMoments:
    """Return the moments of t + r, independent of each other, for each pair of an extreme law of t and one of r.

    `t` and `r` are random affine functions of y with `outputs` components; moments are polynomials in y. For
    multi-indices c of each degree E[(t + r)^c | y] = sum_{b <= c} C(c, b) E[t^b | y] E[r^(c-b) | y], with C the
    binomial coefficients. An extreme law ("corner") is a vertex of the set of possible laws; that of t varies slowest
    in the result.
    """
    # Components of y on which t + r depends; with 1 they are the `size` variables of the polynomials.
    components = tuple(sorted({*t.components, *r.components}))
    size = len(components) + 1
    corners = len(t.by_degree[0]) * len(r.by_degree[0])
    # For each polynomial the indices of its own variables among those of both.
    variables_of_t, variables_of_r = (
        (*(components.index(i) for i in summand.components), size - 1) for summand in (t, r)
    )
    # Degree 0 is 1.
    by_degree = [library(t.by_degree[0], r.by_degree[0]).ones((corners, 1, 1))]
    for degree in range(1, len(t.by_degree)):
        # The axes are monomial of (y, 1), monomial of t + r, and corner.
        total: Corners = np.zeros((count_monomials(size, degree), count_monomials(outputs, degree), corners))
        for degree_of_t, terms in enumerate(_list_binomial_terms(outputs, degree)):
            degree_of_r = degree - degree_of_t
            # C(c, b) E[t^b | y] and E[r^(c-b) | y]: (corner of t, corner of r, term, monomial in each polynomial).
            of_t = t.by_degree[degree_of_t][:, None, terms.b, :, None] * terms.binomial[:, None, None]
            of_r = r.by_degree[degree_of_r][None, :, terms.remainder, None, :]
            products = (of_t * of_r).reshape(corners, len(terms.c), -1)
            columns = _place_products(variables_of_t, variables_of_r, degree_of_t, degree_of_r, size).reshape(-1)
            # Add up the terms of each c, then the products that are the same monomial of (y, 1).
            shape = (count_monomials(outputs, degree), len(columns), corners)
            rows = scatter(shape, terms.c, products.transpose(1, 2, 0))
            total = total + scatter((count_monomials(size, degree), *rows.shape[::2]), columns, rows.swapaxes(0, 1))
        by_degree.append(total.transpose(2, 1, 0))
    return SumMoments(components, by_degree)


class _BinomialTerms(NamedTuple):
    """Terms C(c, b) t^b r^(c-b) of powers (t + r)^c, one in each entry.

    c, b, remainder: positions of the monomials c, b and c - b, each among those of its own degree. binomial: C(c, b).
    """

    c: np.ndarray
    b: np.ndarray
    remainder: np.ndarray
    binomial: np.ndarray


@cache_arrays
def _list_binomial_terms(outputs: int, degree: int) -> tuple[_BinomialTerms, ...]:
    """Return the terms of (t + r)^c = sum_b C(c, b) t^b r^(c-b) for all c with |c| = degree, sorted by |b|.

    Entry k of the result has the terms with |b| = k, k = 0, 1, ..., degree. t and r have `outputs` components.
    """
    exponents = list_exponents(outputs + 1, degree)
    by_degree_of_b: list[list[tuple[int, ...]]] = [[] for _ in range(degree + 1)]
    for c, b, remainder, binomial in zip(*plan_binomial_sums(outputs, degree), strict=True):
        if not exponents[c][-1]:  # |c| = degree: no power of 1
            powers = [exponents[i][:-1] for i in (c, b, remainder)]
            positions = [position(outputs, sum(power))[power] for power in powers]
            by_degree_of_b[sum(exponents[b][:-1])].append((*positions, binomial))
    return tuple(_BinomialTerms(*map(np.array, zip(*terms, strict=True))) for terms in by_degree_of_b)


@cache_arrays
def _place_products(a: Components, b: Components, first: int, second: int, size: int) -> np.ndarray:
    """Return the positions of products of monomials of degree `first` in variables a and of degree `second` in b.

    Entry (i, j) is the position of monomial i times monomial j among those of degree first + second in all `size`
    variables.
    """
    variables_a = np.array(a)[factor_variables(len(a), first)]
    variables_b = np.array(b)[factor_variables(len(b), second)]
    shape = len(variables_a), len(variables_b)
    factors_of_a = np.broadcast_to(variables_a[:, None], (*shape, first))
    factors_of_b = np.broadcast_to(variables_b, (*shape, second))
    return place_monomials(np.concatenate([factors_of_a, factors_of_b], axis=-1), size)


def assemble_moments(moments: SumMoments, outputs: int, inputs: int, order: int) -> Corners:
    """Return E[Sym^order(H)] of z = H (y, 1) for each extreme law, from the polynomials E[z^a | y], |a| <= order.

    H is the random matrix of a channel, and Sym^order(H) the matrix that takes the monomials of (y, 1) of degree
    `order` to those of (z, 1). An extreme law is a vertex of the set of possible laws ("corner"). Row z^a
    1^(order - |a|) of the result has the coefficients of E[z^a | y] in the monomials of (y, 1); a monomial of lower
    degree |a| is filled up by the factor 1^(order - |a|).

    Args:
        moments: the polynomials E[z^a | y] by degree |a|, in the components of y on which z depends.
        outputs: length of z.
        inputs: length of y.
        order: order of the moments.
    """
    size = len(moments.components) + 1
    corners = len(moments.by_degree[0])
    # Indices of the polynomials' variables in (y, 1); 1 is the last one, number `inputs`.
    variables = np.array([*moments.components, inputs])
    xp = library(moments.by_degree)
    matrix: Corners = xp.zeros((corners, count_monomials(outputs + 1, order), count_monomials(inputs + 1, order)))
    for degree, polynomials in enumerate(moments.by_degree):
        # Rows of the monomials z^a with |a| = degree.
        rows = find_monomials_of_degree(outputs, degree, order)
        # Columns: the factors of each monomial, filled up with 1 to the degree `order`.
        factors = variables[factor_variables(size, degree)]
        factors_with_ones = np.pad(factors, ((0, 0), (0, order - degree)), constant_values=inputs)
        columns = place_monomials(factors_with_ones, inputs + 1)
        if xp is np:
            matrix[:, rows[:, None], columns] = polynomials
        else:
            matrix = jnp.asarray(matrix).at[:, rows[:, None], columns].set(polynomials)
    return matrix
