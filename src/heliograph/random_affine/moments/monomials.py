"""Monomials of (y, 1) of one total degree: the half-vectorised basis in which joint moments are stored.

With Y = (y_1, ..., y_p, 1), the monomials of degree k in Y are all monomials of y up to degree k. The symmetric power
Sym^k(H) of a homogeneous matrix H takes the monomials of Y to those of Z = H Y, and Sym^k(H2 H1) = Sym^k(H2) Sym^k(H1).
"""

from collections.abc import Callable
from functools import cache, wraps
from itertools import combinations_with_replacement, product
from math import comb, prod
from typing import Any

import equinox as eqx
import jax
import numpy as np

from heliograph.numerics.caching import cache_arrays
from heliograph.numerics.check import array, fail
from heliograph.numerics.module import Module
from heliograph.numerics.numpy_or_jax import is_zero, plain, scatter
from heliograph.numerics.types import Float

MEMORY_LIMIT_ENTRIES = 50_000_000  # 400 MB of float64: more is refused with the number

Exponents = tuple[int, ...]
Numbers = Any  # an array of NumPy or JAX, or a list of numbers


@cache
def list_exponents(variables: int, degree: int) -> tuple[Exponents, ...]:
    """Return the exponents of all monomials of total degree `degree` in (y_1, ..., y_p, 1).

    There are p + 1 = `variables`. The last is the constant 1, so that monomials of a lower degree in y are among these.
    The monomials of degree 1 are y_1, ..., y_p, 1 in this order.
    """
    monomials = []
    for choice in combinations_with_replacement(range(variables), degree):
        powers = [0] * variables
        for index in choice:
            powers[index] += 1
        monomials.append(tuple(powers))
    return tuple(monomials)


@cache
def position(variables: int, degree: int) -> dict[Exponents, int]:
    """Return the position of each monomial in `list_exponents(variables, degree)`, by its exponents."""
    return {powers: i for i, powers in enumerate(list_exponents(variables, degree))}


def count_monomials(variables: int, degree: int) -> int:
    """Count the monomials of total degree `degree`: C(variables + degree - 1, degree)."""
    return comb(variables + degree - 1, degree)


@cache_arrays
def factor_variables(variables: int, degree: int) -> np.ndarray:
    """Return the indices of the variables that each monomial multiplies (monomials, degree): 0, 0, 2 for y_0 y_0 y_2.

    The monomials, and the variables in each, are in the order of `list_exponents`.
    """
    choices = combinations_with_replacement(range(variables), degree)
    all_variables = np.fromiter((variable for choice in choices for variable in choice), np.int64)
    return all_variables.reshape(count_monomials(variables, degree), degree)


def place_monomials(chosen: np.ndarray, variables: int) -> np.ndarray:
    """Return the position of each monomial in `list_exponents`, from the variables (..., degree) that it multiplies.

    The variables may be in any order, and are sorted: s_1 <= s_2 <= ... The monomials before it in the list have, for
    some t, the same variables before the t-th, and a smaller t-th variable. These are counted for each t.
    """
    ordered = np.sort(chosen, axis=-1)
    previous = np.concatenate([np.zeros_like(ordered[..., :1]), ordered], axis=-1)
    rank = np.zeros(chosen.shape[:-1], dtype=np.int64)
    for t in range(chosen.shape[-1]):
        # counts[n]: number of monomials of the remaining degree in the last n variables.
        variables_left = chosen.shape[-1] - t
        counts = np.array([count_monomials(n, variables_left) for n in range(variables + 1)])
        rank += counts[variables - previous[..., t]] - counts[variables - previous[..., t + 1]]
    return rank


def refuse_if_too_large(rows: int, columns: int, what: str) -> None:
    """Raise ValueError if a moment matrix, named `what`, would have more than MEMORY_LIMIT_ENTRIES."""
    if rows * columns > MEMORY_LIMIT_ENTRIES:
        got = f"{rows * columns:,} entries; use a lower order, or fewer states, outputs or stacked sensors at once"
        raise fail(what, f"at most {MEMORY_LIMIT_ENTRIES:,} entries of a moment matrix", got)


def evaluate_monomials(y: Numbers, degree: int) -> Numbers:
    """Return the values of all monomials of (y, 1) of total degree `degree`, for y of shape (p,).

    They are a NumPy array if y is one, else a JAX array.
    """
    values: list[Numbers] = [*y, 1.0]
    terms = []
    for powers in list_exponents(len(values), degree):
        factors = (value**power for value, power in zip(values, powers, strict=True) if power)
        terms.append(prod(factors, start=1.0))
    if isinstance(y, np.ndarray):
        return np.array(terms, dtype=np.float64)
    import jax.numpy as jnp

    return jnp.stack([jnp.asarray(term, dtype=float) for term in terms])


@cache_arrays
def _tabulate_quotient_positions(variables: int, degree: int) -> np.ndarray:
    """Return at [i, c] the position, among monomials of degree - 1, of monomial i divided by variable c.

    If monomial i does not contain c, the position is one past the end, where the caller puts a zero.
    """
    lower = position(variables, degree - 1)
    table = np.full((count_monomials(variables, degree), variables), len(lower), dtype=np.int64)
    for i, powers in enumerate(list_exponents(variables, degree)):
        for c, power in enumerate(powers):
            if power:
                table[i, c] = lower[(*powers[:c], power - 1, *powers[c + 1 :])]
    return table


@cache_arrays
def _find_dividing_variable(variables: int, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Return for each monomial the last variable that divides it, and the quotient's position at degree - 1."""
    table = _tabulate_quotient_positions(variables, degree)
    exponents = list_exponents(variables, degree)
    divisor = np.array([max(c for c, power in enumerate(powers) if power) for powers in exponents])
    return divisor, table[np.arange(len(divisor)), divisor]


def symmetric_power(h: Numbers, degree: int) -> Numbers:
    """Return Sym^k(H), k = `degree`: row a has the coefficients of the monomial a of Z = H Y in the monomials of Y.

    H (m + 1, p + 1) takes Y = (y, 1) to Z = (z, 1). A monomial z_i z_j ... is a product of linear forms in Y, and is
    built degree by degree: S_k[a, g] = sum_c H[i, c] S_{k-1}[a / z_i, g / y_c], for any z_i in a.

    Shapes: (m + 1, p + 1) -> (C(m + k, k), C(p + k, k)).
    """
    outputs, inputs = h.shape
    refuse_if_too_large(count_monomials(outputs, degree), count_monomials(inputs, degree), f"moments of order {degree}")
    power = h
    for k in range(2, degree + 1):
        divisor, parent = _find_dividing_variable(outputs, k)
        table = _tabulate_quotient_positions(inputs, k)
        padded = _append_zero_column(power)[parent]  # zero for g / y_c where g has no y_c
        power = sum(h[divisor, c][:, None] * padded[:, table[:, c]] for c in range(inputs))
    return power


def _append_zero_column(a: Numbers) -> Numbers:
    """Return the matrix with a last column of zeros appended, as an array of NumPy or JAX as it is itself."""
    if isinstance(a, np.ndarray):
        return np.pad(a, ((0, 0), (0, 1)))
    import jax.numpy as jnp

    return jnp.pad(a, ((0, 0), (0, 1)))


@cache_arrays
def product_table(variables: int, first: int, second: int) -> np.ndarray:
    """Return at (i, j) the position, among monomials of degree first + second, of the product of monomials i and j.

    Monomial i has the degree `first`, and j has the degree `second`.
    """
    a = factor_variables(variables, first)
    b = factor_variables(variables, second)
    shape = len(a), len(b)
    of_a = np.broadcast_to(a[:, None], (*shape, first))
    of_b = np.broadcast_to(b, (*shape, second))
    return place_monomials(np.concatenate([of_a, of_b], axis=-1), variables)


def multiply_polynomials(a: Numbers, first: int, b: Numbers, second: int, variables: int) -> Numbers:
    """Return the coefficients of the product of two homogeneous polynomials in `variables` variables.

    `a` are the coefficients of the monomials of degree `first`, and `b` those of degree `second`, as in
    `list_exponents`.
    """
    terms = a[:, None] * b
    return scatter((count_monomials(variables, first + second),), product_table(variables, first, second), terms)


def multiply_by_linear_form(polynomial: dict[Exponents, Numbers], row: Numbers) -> dict[Exponents, Numbers]:
    """Return p(u) sum_j row_j u_j, a polynomial times a linear form.

    A polynomial is held as the coefficient of each monomial, with the monomial's exponents as key.
    """
    product: dict[Exponents, Numbers] = {}
    nonzero = [j for j, entry in enumerate(row) if not is_zero(entry)]
    for a, coefficient in polynomial.items():
        for j in nonzero:
            exponents_times_u_j = (*a[:j], a[j] + 1, *a[j + 1 :])
            product[exponents_times_u_j] = product.get(exponents_times_u_j, 0.0) + coefficient * plain(row[j])
    return product


@cache_arrays
def degrees(dimension: int, order: int) -> np.ndarray:
    """Return the degree |a| of each monomial y^a 1^(order - |a|) of total degree `order`; y has `dimension` numbers."""
    return np.array([order - powers[-1] for powers in list_exponents(dimension + 1, order)])


@cache_arrays
def plan_binomial_sums(dimension: int, order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the terms of (y + n)^a = sum_b C(a, b) n^(a-b) y^b: the positions of a, of b and of a - b, and C(a, b).

    There is a term for each monomial a of (y, 1) of this order and each b <= a. y has `dimension` numbers. Positions
    are those in `list_exponents`: y^b and n^(a-b) are multiplied by powers of 1 up to this order.
    """
    position_of, terms = position(dimension + 1, order), []
    for row, powers in enumerate(list_exponents(dimension + 1, order)):
        a = powers[:-1]
        for b in product(*(range(x + 1) for x in a)):
            remainder = tuple(x - y for x, y in zip(a, b, strict=True))  # a - b
            binomial = prod(comb(x, y) for x, y in zip(a, b, strict=True))  # C(a, b) = prod_i C(a_i, b_i)
            column = position_of[(*b, order - sum(b))]
            terms.append((row, column, position_of[(*remainder, order - sum(remainder))], binomial))
    rows, columns, remainders, binomials = np.array(terms, dtype=np.int64).T
    return rows, columns, remainders, binomials


class JointMoments(Module):
    """Joint moments of (G, n) of one order: the matrix E[Sym^k(H)].

    It takes the monomials of (y, 1) of degree k to the conditional expectations of those of (z, 1),
    E[mono_k(z) | y] = matrix mono_k(y). A map in series is the product of the matrices.

    Shapes: matrix (C(outputs + k, k), C(inputs + k, k)).
    """

    matrix: Float[jax.Array | np.ndarray, "rows columns"]
    outputs: int = eqx.field(static=True)
    inputs: int = eqx.field(static=True)
    order: int = eqx.field(static=True)

    @property
    def mean(self) -> Float[jax.Array | np.ndarray, "outputs+1 inputs+1"]:
        """E[H] of shape (outputs + 1, inputs + 1).

        The monomials z_i = z_i 1^(k-1) are among those of degree k, so that E[H] is a part of the matrix E[Sym^k(H)].
        """
        return self.lower(1)

    @property
    def second(self) -> Float[jax.Array | np.ndarray, "m m p+1 p+1"]:
        """T with E[z_i z_j | y] = sum_ab T[i, j, a, b] Y_a Y_b, Y = (y, 1), symmetric in (i, j) and in (a, b)."""
        # Rows of z_i z_j and columns of Y_a Y_b in the matrix of order 2.
        rows = product_table(self.outputs + 1, first=1, second=1)[:-1, :-1]
        columns = product_table(self.inputs + 1, first=1, second=1)
        shares = np.where(np.eye(self.inputs + 1, dtype=bool), 1, 2)  # a coefficient of Y_a Y_b is at (a, b) and (b, a)
        tensor: jax.Array | np.ndarray = self.matrix[rows[:, :, None, None], columns] / shares
        return tensor

    def lower(self, order: int) -> Float[jax.Array | np.ndarray, "rows columns"]:
        """Return E[Sym^order(H)], of an `order` up to self.order, as a part of the matrix E[Sym^k(H)], k = self.order.

        A monomial of lower degree times 1^(k - order) is one of degree k. So rows and columns are selected.
        """
        rows_and_columns = _place_lower_monomials(self.outputs, self.inputs, self.order, order)
        matrix: jax.Array | np.ndarray = self.matrix[rows_and_columns]
        return matrix

    def expect(self, y_moments: Float[jax.Array | np.ndarray, " columns"]) -> Float[jax.Array | np.ndarray, " rows"]:
        """Return E[mono_k(z)] from E[mono_k(y)], for y independent of the map."""
        return self.matrix @ y_moments


@cache_arrays
def _place_lower_monomials(outputs: int, inputs: int, high: int, low: int) -> tuple[np.ndarray, ...]:
    """Return the index of the matrix E[Sym^high(H)] that selects E[Sym^low(H)] from it.

    Row by row these are the positions of the monomials of (z, 1) of degree `low`, times 1^(high - low), among those of
    degree `high`; column by column those of (y, 1).
    """
    rows = times_one(outputs + 1, low, high)
    columns = times_one(inputs + 1, low, high)
    return np.ix_(rows, columns)


@cache_arrays
def times_one(variables: int, low: int, high: int) -> np.ndarray:
    """Return the positions, among monomials of degree `high`, of those of degree `low` times 1^(high - low).

    The constant 1 is the last of the `variables`.
    """
    factors = factor_variables(variables, low)
    factors_with_ones = np.pad(factors, ((0, 0), (0, high - low)), constant_values=variables - 1)
    return place_monomials(factors_with_ones, variables)


def give_moments(own_method: Callable[[Any, int], Any]) -> Callable[[Any, int], JointMoments]:
    """Return a method `moments` that returns `JointMoments`, where a map's `own_method` may return only a matrix.

    Raises:
        ValueError: a matrix whose shape is not that of the map's monomials.
    """

    @wraps(own_method)
    def moments(channel: Any, order: int) -> JointMoments:
        """Return E[Sym^order(H)] of a map as `JointMoments`, where its own method may return the matrix alone."""
        result = own_method(channel, order)
        if isinstance(result, JointMoments):
            return result
        shape = count_monomials(channel.outputs + 1, order), count_monomials(channel.inputs + 1, order)
        matrix = array(f"moments({order}) of {type(channel).__name__}", result, shape)
        return JointMoments(matrix, channel.outputs, channel.inputs, order)

    return moments
