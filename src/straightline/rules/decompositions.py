"""Rules of small matrices' decompositions: symmetric ones by Jacobi rotations until diagonal, others as L U."""

import math
from collections.abc import Callable
from functools import cache
from itertools import combinations
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn

from straightline.lowering import IN_MEMORY, Lowering, Value, arrange_nodes, make_placeholder, result_shape
from straightline.nodes import Unsupported
from straightline.size_limits import FEW

SWEEPS = 30  # at most; a handful is enough, more where sizes differ by many decades
Numbers = dict[tuple[int, int], jax.Array]  # entries by row and column


def eigh(a: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute eigenvectors (n, n), in columns, and eigenvalues (n,), ascending; all NaN if an entry is not finite.

    `a` (n, n) is symmetric; (a + a') / 2 is decomposed. Jacobi's method: each rotation makes one off-diagonal entry
    zero; a sweep rotates each pair of rows once, and sweeps end when the off-diagonal entries are below rounding. Pairs
    are in the order of a tournament: a turn rotates disjoint pairs of rows, at places that are fixed, and the rows move
    on to other places between turns. So all turns are the same program, of 6 n^2 operations.

    Source: Jacobi, Ueber ein leichtes Verfahren (1846); Golub and Van Loan, Matrix computations, section 8.5; Luk and
    Park, On parallel Jacobi orderings (1989), by which it converges as the order by rows does.
    """
    n, eps = len(a), float(np.finfo(a.dtype).eps)
    finite = jnp.all(jnp.isfinite(a))
    # The upper triangle of (A + A') / 2, in a unit in which squares of entries neither overflow nor vanish. Before the
    # first rotation the eigenvectors are the identity matrix.
    unit = _choose_power_of_two_unit(a)
    entries = {(i, j): (a[i, j] / unit + a[j, i] / unit) / 2 for i in range(n) for j in range(i, n)}
    vectors = {(i, j): jnp.asarray(float(i == j), a.dtype) for i in range(n) for j in range(n)}
    # Off-diagonal entries below eps ||A||_F / n are rounding; in the norm those above the diagonal count twice.
    rounding = eps * jnp.sqrt(sum((1 if i == j else 2) * x * x for (i, j), x in entries.items())) / n

    def goes_on(state: tuple[Numbers, Numbers, jax.Array]) -> jax.Array:
        """Return whether to go on: an entry above the diagonal exceeds `rounding`, and sweeps are fewer than SWEEPS."""
        entries, _vectors, sweeps = state
        large = [jnp.abs(entries[pair]) > rounding for pair in combinations(range(n), 2)]
        return jnp.any(jnp.stack(large)) & (sweeps < SWEEPS)

    turns, turn = _make_tournament_turn(n)

    def sweep(state: tuple[Numbers, Numbers, jax.Array]) -> tuple[Numbers, Numbers, jax.Array]:
        """Rotate each pair of rows once, so that the pair's entry becomes 0.

        A sweep is `turns` turns, after which each row is back in its place.
        """
        entries, vectors, sweeps = state
        (entries, vectors), _ = jax.lax.scan(turn, (entries, vectors), length=turns)
        return entries, vectors, sweeps + 1

    if n > 1:  # a matrix of one number is its eigenvalue
        entries, vectors, _ = jax.lax.while_loop(goes_on, sweep, (entries, vectors, jnp.asarray(0)))
    # Eigenvalues, now the diagonal entries, in ascending order, with their columns.
    diagonal = [entries[i, i] for i in range(n)]
    values, columns = _sort_by_transposition(diagonal, [[vectors[i, j] for i in range(n)] for j in range(n)])
    eigenvectors = jnp.stack([jnp.stack(column) for column in columns], axis=1)
    return jnp.where(finite, eigenvectors, jnp.nan), jnp.where(finite, jnp.stack(values) * unit, jnp.nan)


def _choose_power_of_two_unit(a: jax.Array) -> jax.Array:
    """Return a power of two by which a matrix is divided so that squares of its entries neither overflow nor vanish.

    It is 1 if the largest entry lies between 2^-p and 2^p, with p = 300 for doubles and 50 for floats: its square, at
    most 2^600 or 2^100, is then far from 2^1024 or 2^128. Else it is 4^p or 4^-p, which brings even the largest and
    smallest numbers of the type so near to 1 that their squares exist. Division by a power of two does not round.
    """
    largest, p = jnp.max(jnp.abs(a)), 300 if a.dtype == np.float64 else 50
    return jnp.where(largest > 2.0**p, 4.0**p, jnp.where(largest < 2.0**-p, 4.0**-p, 1.0))


def _make_tournament_turn(
    n: int,
) -> tuple[int, Callable[[tuple[Numbers, Numbers], None], tuple[tuple[Numbers, Numbers], None]]]:
    """Return how many turns a sweep of Jacobi's method has, and the function of one turn.

    A turn rotates disjoint pairs (p, q) of rows at fixed places, A <- J' A J and V <- V J with a rotation J for each,
    and then moves the rows on to other places. After all turns each row has met each other row once, and is back.
    """
    # As in a tournament of n players: place k plays place turns - k, all players but the last move on by one place
    # between turns, and the last one plays whoever is at place 0. With n odd there is no last one, and place 0 pauses.
    turns = n - 1 + n % 2
    is_even = n % 2 == 0
    pairs = [(k, turns - k) for k in range(1, turns // 2 + 1)] + ([(0, n - 1)] if is_even else [])
    moved = [*((i + 1) % turns for i in range(turns)), *range(turns, n)]  # place i gets the row at place moved[i]

    def turn(state: tuple[Numbers, Numbers], _: None) -> tuple[tuple[Numbers, Numbers], None]:
        """Rotate each of the `pairs` of rows, then move the rows: row i comes from place moved[i].

        The state is (entries of A, eigenvectors). A is symmetric, so only its entries (i, j) with i <= j are kept.
        """
        entries, vectors = map(dict, state)
        for p, q in pairs:
            _rotate_in_place(entries, vectors, p, q, n)
        entries = {(i, j): entries[min(moved[i], moved[j]), max(moved[i], moved[j])] for i, j in entries}
        return (entries, {(i, j): vectors[i, moved[j]] for i, j in vectors}), None

    return turns, turn


def _rotate_in_place(a: Numbers, vectors: Numbers, p: int, q: int, n: int) -> None:
    """Rotate rows and columns p and q of A, in place, so that a_pq = 0, and columns p and q of the eigenvectors V.

    With the rotation J, A <- J' A J and V <- V J. `a` has the entries (i, j) with i <= j of the symmetric A (n, n).
    """
    # The smaller root t = tan(angle) of t^2 + 2 h t - 1 = 0, h = (a_qq - a_pp) / (2 a_pq); c and s: cosine and sine.
    off = a[p, q]
    is_zero = off == 0
    h = (a[q, q] - a[p, p]) / jnp.where(is_zero, 1.0, 2 * off)
    tangent = jnp.where(h < 0, -1.0, 1.0) / (jnp.abs(h) + jnp.sqrt(h * h + 1))
    t = jnp.where(is_zero, 0.0, tangent)
    c = 1 / jnp.sqrt(t * t + 1)
    s = t * c
    a[p, p], a[q, q], a[p, q] = a[p, p] - t * off, a[q, q] + t * off, jnp.zeros_like(off)
    for k in range(n):
        if k not in (p, q):
            first, second = (min(k, p), max(k, p)), (min(k, q), max(k, q))
            a[first], a[second] = c * a[first] - s * a[second], s * a[first] + c * a[second]
        left, right = vectors[k, p], vectors[k, q]
        vectors[k, p], vectors[k, q] = c * left - s * right, s * left + c * right


def _sort_by_transposition(
    values: list[jax.Array], columns: list[list[jax.Array]]
) -> tuple[list[jax.Array], list[list[jax.Array]]]:
    """Return eigenvalues in ascending order, with their columns (eigenvectors), by odd-even transposition.

    That exchanges neighbours only, in the same order of places whatever the data: it needs no branches.
    """
    n = len(values)

    def exchange_neighbours(state: tuple[list[jax.Array], list[list[jax.Array]]], _: None) -> tuple[Any, None]:
        """Exchange neighbours that are in the wrong order, among n values and their columns.

        Pairs that begin at even places come first, then those at odd places.
        """
        values, columns = list(state[0]), list(state[1])
        for i in (*range(0, n - 1, 2), *range(1, n - 1, 2)):
            _exchange_if_descending(values, columns, i)
        return (values, columns), None

    after, _ = jax.lax.scan(exchange_neighbours, (values, columns), length=(n + 1) // 2)
    return after


def _exchange_if_descending(values: list[jax.Array], columns: list[list[jax.Array]], i: int) -> None:
    """Exchange values i and i + 1, and their columns, in these lists if value i is the greater one: by selections."""
    is_descending = values[i] > values[i + 1]
    values[i], values[i + 1] = jnp.minimum(values[i], values[i + 1]), jnp.maximum(values[i], values[i + 1])
    pairs = list(zip(columns[i], columns[i + 1], strict=True))
    columns[i] = [jnp.where(is_descending, second, first) for first, second in pairs]
    columns[i + 1] = [jnp.where(is_descending, first, second) for first, second in pairs]


def _eigh(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Return eigenvectors and eigenvalues of symmetric matrices of up to FEW rows, by `eigh` written out."""
    avals: list[Any] = [v.aval for v in equation.invars]
    shape = avals[0].shape
    if shape[-1] > FEW or equation.params.get("subset_by_index") is not None:
        raise Unsupported(f"eigenvalues of a matrix of {shape[-1]} rows")
    return _decompose_each(lowering, _trace_eigh(shape[-1], avals[0].dtype), equation, inputs[0])


def _decompose_each(lowering: Lowering, program: ClosedJaxpr, equation: JaxprEqn, matrices: Value) -> list[Value]:
    """Return the results of a program of one matrix for each matrix of a stack (..., n, m).

    The program is written out once for each matrix. Array k holds its k-th results, along the same leading axes.
    """
    (of_one_matrix,) = program.in_avals
    leading = matrices.shape[: len(matrices.shape) - len(of_one_matrix.shape)]
    flat = lowering.nodes(matrices).reshape(math.prod(leading), *of_one_matrix.shape)
    results = [[lowering.nodes(x) for x in lowering.inline_program(program, [matrix])] for matrix in flat]
    arrays = []
    for k in range(len(equation.outvars)):
        nodes = [node for of_matrix in results for node in of_matrix[k].ravel()]
        arrays.append(arrange_nodes(nodes, result_shape(equation, k)))
    return arrays


@cache
def _trace_eigh(n: int, dtype: Any) -> ClosedJaxpr:
    """Return the program of `eigh` for a matrix (n, n) of this type, as JAX traces it.

    Each use of JAX's operation writes it out as scalar operations; it is traced once for each size and type.
    """
    with jax.enable_x64(True):
        return jax.make_jaxpr(eigh)(make_placeholder((n, n), dtype))


IN_MEMORY |= {"eigh": _eigh}


def lu(a: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Compute L below the diagonal and U (n, n), the pivot row of each step (n,), and the order of rows (n,).

    Each step takes the largest entry of the rest of its column, and needs one reciprocal.

    Source: Golub and Van Loan, Matrix computations, section 3.4.
    """
    n = len(a)
    rows, order, pivots = list(a), list(jnp.arange(n, dtype=jnp.int32)), []
    for j in range(n):
        # Partial pivoting: the largest |a_ij|, i >= j.
        column = jnp.abs(jnp.stack([row[j] for row in rows[j:]]))
        taken = j + jnp.argmax(column).astype(jnp.int32)
        pivots.append(taken)
        for i in range(j + 1, n):  # exchange rows j and i where i is taken
            _exchange_if(taken == i, rows, i, j)
            _exchange_if(taken == i, order, i, j)
        # Elimination: l_ij = a_ij / a_jj, a_i <- a_i - l_ij a_j; below a pivot of zero the column is zeros, and stays.
        scale = 1 / jnp.where(rows[j][j] == 0, 1.0, rows[j][j])
        for i in range(j + 1, n):
            factor = rows[i][j] * scale
            rest = rows[i][j + 1 :] - factor * rows[j][j + 1 :]
            rows[i] = jnp.concatenate([rows[i][:j], factor[None], rest])
    return jnp.stack(rows), jnp.stack(pivots), jnp.stack(order)


def _exchange_if(condition: jax.Array, items: list[jax.Array], i: int, j: int) -> None:
    """Exchange items i and j of the list, in place, where the condition holds: by selections, without a branch."""
    a, b = items[i], items[j]
    items[i], items[j] = jnp.where(condition, b, a), jnp.where(condition, a, b)


def permutation(pivots: jax.Array, size: int) -> jax.Array:
    """Return the order of `size` rows after row j was exchanged with row pivots[j] >= j, for j = 0, 1, ...

    The data decide the pivots. So each row i > j is exchanged with row j by a selection, if pivots[j] is i.
    """
    order = list(jnp.arange(size, dtype=pivots.dtype))
    for j in range(len(pivots)):
        for i in range(j + 1, size):
            _exchange_if(pivots[j] == i, order, i, j)
    return jnp.stack(order)


def _lu(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Return the factors, pivots and order of rows of square matrices of up to FEW rows, by `lu` written out.

    The factors L and U share one matrix.
    """
    avals: list[Any] = [v.aval for v in equation.invars]
    shape = avals[0].shape
    if shape[-2] != shape[-1] or shape[-1] > FEW:
        raise Unsupported(f"factors of a matrix of shape {shape[-2:]}")
    return _decompose_each(lowering, _trace_lu(shape[-1], avals[0].dtype), equation, inputs[0])


@cache
def _trace_lu(n: int, dtype: Any) -> ClosedJaxpr:
    """Return the program of `lu` for a matrix (n, n) of this type, as JAX traces it; cached, as it is used again."""
    with jax.enable_x64(True):
        return jax.make_jaxpr(lu)(make_placeholder((n, n), dtype))


def _permutation(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Return the order of rows after the row exchanges of an L U factorisation, by `permutation` written out.

    The input has the pivots of each matrix along its last axis: row j was exchanged with row pivots[j].
    """
    pivots = inputs[0]
    program = _trace_permutation(pivots.shape[-1], equation.params["permutation_size"])
    return _decompose_each(lowering, program, equation, pivots)


@cache
def _trace_permutation(count: int, size: int) -> ClosedJaxpr:
    """Return the program of `permutation` for `count` pivots and `size` rows, as JAX traces it.

    Pivot j of an L U factorisation is the row with which row j is exchanged; the program returns the resulting order of
    rows. Native code is written from such programs of JAX, and this one is traced once for each pair of sizes.
    """
    pivots = make_placeholder((count,), np.int32)
    with jax.enable_x64(True):
        return jax.make_jaxpr(lambda pivots: permutation(pivots, size))(pivots)


def _linear_solve(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Return the solution of a linear system (JAX's `linear_solve`) by the program `solve` that it comes with.

    The inputs are the constants of its programs matvec, vecmat, solve and transpose_solve, and then the right sides.
    """
    programs, lengths = equation.params["jaxprs"], equation.params["const_lengths"]
    first = lengths.matvec + lengths.vecmat  # the first constant of `solve`
    constants = inputs[first : first + lengths.solve]
    right_sides = inputs[first + lengths.solve + lengths.transpose_solve :]
    return lowering.inline_program(programs.solve, [*constants, *right_sides])


IN_MEMORY |= {"lu": _lu, "lu_pivots_to_permutation": _permutation, "custom_linear_solve": _linear_solve}
