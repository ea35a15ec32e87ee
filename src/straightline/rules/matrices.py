"""Rules of sums, products and decompositions: written out, entry by entry."""

import math
from collections.abc import Sequence
from functools import reduce
from typing import Any

import numpy as np
from jax.extend.core import JaxprEqn

from straightline.constant_folding import DTYPES
from straightline.graph import Graph
from straightline.lowering import RULES, Lowering, Rule, arrange_nodes, result_shape, result_type
from straightline.nodes import REAL, Node, Type, Unsupported


def combine_nodes(graph: Graph, op: str, type: Type, nodes: Sequence[Node], empty: float) -> Node:
    """Return the node of n_0 op n_1 op n_2 ..., from the left; the constant `empty` if there are no nodes.

    Nodes are scalar operations of the program that is being written, `graph`; those of this chain are added to it.
    """
    if not nodes:
        return graph.constant(empty, type)
    return reduce(lambda a, b: graph.node(op, type, a, b), nodes)


def _make_reduction_rule(op: str, empty: float) -> Rule:
    """Return the rule of an operation that reduces an array along axes by `op`.

    `empty` is the result where there are no entries.
    """

    def lower_operation(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
        """Return an array of nodes reduced by `op` along the operation's axes; of no entries the result is `empty`."""
        axes, shape, type = equation.params["axes"], result_shape(equation), result_type(equation)
        # Make a row of terms for each entry of the result; a reduction of no entries has rows of length 0.
        terms = math.prod(inputs[0].shape[axis] for axis in axes)
        rows = np.moveaxis(inputs[0], axes, range(-len(axes), 0)).reshape(math.prod(shape), terms)
        of_no_entries = _replace_not_finite(type, empty)
        nodes = [combine_nodes(lowering.graph, op, type, row, of_no_entries) for row in rows.tolist()]
        return [arrange_nodes(nodes, shape)]

    return lower_operation


# Stands for the number of a type that has all bits set, the neutral element of "and": true, -1 of a signed type, or the
# greatest unsigned integer. It is this NaN object, known by `is`.
ALL_BITS = np.nan


def _replace_not_finite(type: Type, number: float) -> float:
    """Return the result of reducing no entries as a number of a type.

    For integers and flags, infinity becomes the greatest number of the type, minus infinity the least, and ALL_BITS
    the one with all bits set. Finite numbers, and all numbers of a real type, stay as they are.
    """
    if type in REAL or np.isfinite(number):
        return number
    has_all_bits = number is ALL_BITS
    if type == "bool":
        return has_all_bits or number > 0
    limits = np.iinfo(DTYPES[type])
    if has_all_bits:
        return -1 if limits.min < 0 else limits.max
    return limits.max if number > 0 else limits.min


def _make_accumulation_rule(op: str) -> Rule:
    """Return the rule of an operation such as `cumsum`, which accumulates an array along an axis by `op`."""

    def lower_operation(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
        """Return an array of nodes accumulated by `op` along the operation's axis, in reverse from its last entry on.

        Entry k of the result combines entries 0 to k: each is one more scalar operation of the program.
        """
        axis, type, reverse = equation.params["axis"], result_type(equation), equation.params["reverse"]
        if not inputs[0].size:
            return inputs
        # Make the axis the first one; each row is then combined with what is accumulated so far.
        x = np.moveaxis(inputs[0], axis, 0)
        shape = x.shape
        x = (x[::-1] if reverse else x).reshape(len(x), -1)
        rows = [x[0].tolist()]
        for row in x[1:].tolist():
            rows.append([lowering.graph.node(op, type, a, b) for a, b in zip(rows[-1], row, strict=True)])
        cumulated = arrange_nodes([n for row in rows for n in row], shape)
        return [np.moveaxis(cumulated[::-1] if reverse else cumulated, 0, axis)]

    return lower_operation


def _make_extreme_index_rule(op: str) -> Rule:
    """Return the rule by which JAX's `argmax` or `argmin` is written as comparisons of numbers.

    `op` is the comparison by which an entry beats the best one so far: "gt" (greater) for argmax, "lt" for argmin.
    """

    def lower_argument_of_extreme(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
        """Return the indices of the extremes of an array along the operation's only axis.

        The array's entries are nodes, the scalar operations of the program (`lowering.graph`), to which the comparisons
        are added; so are the entries of the result.
        """
        axis = equation.params["axes"][0]
        rows = np.moveaxis(inputs[0], axis, -1).reshape(-1, inputs[0].shape[axis])
        indices = [_find_first_extreme(lowering.graph, op, result_type(equation), row) for row in rows.tolist()]
        return [arrange_nodes(indices, result_shape(equation))]

    return lower_argument_of_extreme


def _find_first_extreme(graph: Graph, op: str, type: Type, row: list[Node]) -> Node:
    """Return the first index of the greatest (op "gt") or least ("lt") number of a row of nodes.

    If there is a NaN, it is the index of the first NaN, as in JAX. `type` is the type of the index.
    """
    best, index = row[0], graph.constant(0, type)
    for number, entry in enumerate(row[1:], 1):
        # A later entry replaces the best one if it is beyond it or NaN, unless the best is NaN already.
        best_is_number = graph.node("eq", "bool", best, best)
        beyond = graph.node(op, "bool", entry, best)
        is_nan = graph.node("ne", "bool", entry, entry)
        better = graph.node("and", "bool", best_is_number, graph.node("or", "bool", beyond, is_nan))
        best = graph.node("select", entry.type, better, entry, best)
        index = graph.node("select", type, better, graph.constant(number, type), index)
    return index


def write_product(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Write out a product of two arrays (JAX's `dot_general`) entry by entry: A B' for each index of the batch axes.

    The inputs are arrays of nodes, the scalar operations of the program that is being written (`lowering.graph`). Batch
    axes are common to both inputs and come first in the result, contracted axes are summed over, and free axes belong
    to one input: those of the first, and then those of the second, are the result's other axes.
    """
    (x_contracted, y_contracted), (x_batch, y_batch) = equation.params["dimension_numbers"]
    number_type = result_type(equation)
    x, y = (_convert(lowering.graph, number_type, array) for array in inputs)
    a = _as_matrices(x, x_contracted, x_batch)  # (batch, free axes of x, contracted)
    b = _as_matrices(y, y_contracted, y_batch)  # (batch, free axes of y, contracted)
    products = [_multiply_matrices(lowering, number_type, *factors) for factors in zip(a, b, strict=True)]
    # The nodes of all products in row-major order are those of the result.
    nodes = [n for product in products for n in product.ravel().tolist()]
    return [arrange_nodes(nodes, result_shape(equation))]


def _multiply_matrices(lowering: Lowering, type: Type, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return A B' of A (n, k) and B (m, k), arrays of nodes; if it is known to be symmetric, by its upper triangle.

    It is if A = C P and B = C, or A = C and B = C P, with a symmetric P: then A B' = C P C', as of a covariance. P may
    be a matrix, if C P was computed by this function before, or diagonal, if C P has columns of C times one number
    each. The product C C' needs no rule, since equal expressions are one node.
    """
    is_symmetric = any(_is_weighted(x, y) or _is_congruence(lowering, x, y) for x, y in ((a, b), (b, a)))
    computed = [(i, j) for i in range(len(a)) for j in range(i if is_symmetric else 0, len(b))]
    product = np.empty((len(a), len(b)), dtype=object)
    sums = _sum_products(lowering.graph, type, [(a[i], b[j]) for i, j in computed])
    for (i, j), entry in zip(computed, sums, strict=True):
        product[i, j] = entry
        if is_symmetric:
            product[j, i] = entry
    # `lowering.products` holds the factors of each product, and of its transpose, by the product's nodes. So a later
    # call sees that its A = C P is a product with C.
    lowering.products[_make_matrix_key(product)] = a, b
    lowering.products[_make_matrix_key(product.T)] = b, a
    return product


def _sum_products(graph: Graph, type: Type, pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[Node]:
    """Return sum_k a_k b_k for each pair of vectors (a, b).

    All sums grow together, term by term, so that the processor can compute them side by side. A term with a known zero
    is left out, whatever the data: a zero in a model's matrix says that nothing depends on that number, so that its
    NaN must not pass.
    """
    product, sum_ = ("and", "or") if type == "bool" else ("mul", "add")
    sums: list[Node | None] = [None] * len(pairs)
    for k in range(len(pairs[0][0]) if pairs else 0):
        for entry, (a, b) in enumerate(pairs):
            if _is_zero_term(a[k], b[k]) or _is_zero_term(b[k], a[k]):
                continue
            term, before = graph.node(product, type, a[k], b[k]), sums[entry]
            sums[entry] = term if before is None else graph.node(sum_, type, before, term)
    return [graph.constant(0.0 if type in REAL else 0, type) if s is None else s for s in sums]


def _is_zero_term(x: Node, y: Node) -> bool:
    """Return whether x is a known zero, and y no constant that is infinite or NaN."""
    return x.op == "constant" and not x.value and (y.op != "constant" or math.isfinite(y.value))


def _is_weighted(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether A = B diag(w) for some nodes w: each column of A is the column of B times one node.

    A and B are arrays of nodes (scalar operations), so that it is seen from the operations whether it holds. Then A B'
    is B diag(w) B', which is symmetric.
    """
    if a.shape != b.shape:
        return False
    weights = [[_find_weight(x, y) for x, y in zip(*columns, strict=True)] for columns in zip(a.T, b.T, strict=True)]
    return all(w is not None and w is column[0] for column in weights for w in column)


def _find_weight(x: Node, y: Node) -> Node | None:
    """Return the node w if x is the product w y, or None if it is not; if y is the constant 1, w is x itself."""
    if y.op == "constant" and y.value == 1:
        return x
    if x.op != "mul" or not any(factor is y for factor in x.args):
        return None
    first, second = x.args
    return second if first is y else first


def _is_congruence(lowering: Lowering, a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether A was computed before as B P' with a symmetric P, so that A B' = B P B' is symmetric.

    `lowering.products` has the two factors of each product of matrices so far, by the product's entries.
    """
    no_product = (a[:0], a[:0])
    factor, p = lowering.products.get(_make_matrix_key(a), no_product)
    return _is_same(factor, b) and _is_same(p, p.T)


def _is_same(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether two arrays have the same nodes."""
    return a.shape == b.shape and all(x is y for x, y in zip(a.ravel().tolist(), b.ravel().tolist(), strict=True))


def _make_matrix_key(matrix: np.ndarray) -> Any:
    """Return the shape and the nodes of a matrix, row by row: equal keys are equal matrices."""
    return matrix.shape, *matrix.ravel().tolist()


def _convert(graph: Graph, type: Type, x: np.ndarray) -> np.ndarray:
    """Return an array of nodes with each number converted to `type` where it has another one, as flags may have."""
    nodes = [n if n.type == type else graph.node("convert", type, n) for n in x.ravel().tolist()]
    return arrange_nodes(nodes, x.shape)


def _as_matrices(x: np.ndarray, contracted: Sequence[int], batch: Sequence[int]) -> np.ndarray:
    """Return an array as (batch, free, contracted): each kind of axes is merged into one.

    The free axes are those in neither list.
    """
    free = [d for d in range(x.ndim) if d not in contracted and d not in batch]
    sizes = [math.prod(x.shape[d] for d in axes) for axes in (batch, free, contracted)]
    return np.transpose(x, [*batch, *free, *contracted]).reshape(sizes)


def _for_each_matrix(function: Any) -> Rule:
    """Return the rule of an operation on matrices that JAX applies to each matrix of a stack (..., n, m).

    function(graph, parameters, *matrices) returns the result for one matrix of each argument, as nodes of the graph,
    the scalar operations of the program; `parameters` are those of JAX's operation.
    """

    def rule(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
        """Return what `function` makes of the matrices, one by one; they lie along each argument's last two axes."""
        stacks = [x.reshape(math.prod(x.shape[:-2]), *x.shape[-2:]) for x in inputs]
        results = [function(lowering.graph, equation.params, *matrices) for matrices in zip(*stacks, strict=True)]
        return [arrange_nodes((node for x in results for node in x.ravel().tolist()), result_shape(equation))]

    return rule


def _type_of(matrix: np.ndarray) -> Type:
    """Return the type of a matrix's numbers; of a matrix without entries "f64", since nothing is computed of it."""
    type: Type = matrix.flat[0].type if matrix.size else "f64"
    return type


def _cholesky(graph: Graph, params: Any, a: np.ndarray) -> np.ndarray:
    """Return the lower triangular L of A = L L', column by column; all NaN if A is not positive definite.

    The compiler unrolls it to operations on single numbers (nodes of the graph). `a`: nodes (n, n), of which only the
    lower triangle is read. `params`: parameters of JAX's operation, not used. Each column takes one reciprocal, which
    costs less than a division for each entry.
    """
    n, real = len(a), _type_of(a)
    zero, nan = graph.constant(0.0, real), graph.constant(float("nan"), real)
    definite = graph.constant(True, "bool")
    # L, zero above the diagonal.
    lower = np.full((n, n), zero, dtype=object)
    for j in range(n):
        # r_i = a_ij - sum_k<j l_ik l_jk for the rows i >= j.
        remainders = []
        for i in range(j, n):
            remainder = a[i, j]
            for k in range(j):
                remainder = graph.node("sub", real, remainder, graph.node("mul", real, lower[i, k], lower[j, k]))
            remainders.append(remainder)
        # l_jj = sqrt(r_j), l_ij = r_i / l_jj; r_j is the pivot. If it is zero or negative, the whole result is NaN. If
        # it is NaN, which is not "<= 0", only what is computed of it is NaN.
        root = graph.node("sqrt", real, remainders[0])
        is_bad = graph.node("le", "bool", remainders[0], zero)
        definite = graph.node("and", "bool", definite, graph.node("not", "bool", is_bad))
        scale = graph.node("div", real, graph.constant(1.0, real), root)
        lower[j, j] = root
        for i in range(j + 1, n):
            lower[i, j] = graph.node("mul", real, remainders[i - j], scale)
    # All NaN if a pivot was bad.
    numbers = [graph.node("select", real, definite, x, nan) for x in lower.ravel().tolist()]
    return arrange_nodes(numbers, lower.shape)


def _triangular_solve(graph: Graph, params: Any, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the solution X of A X = B with a triangular A (n, n), or of X A = B, or with A', by substitution.

    The substitution is written out as single operations, nodes of a graph from which code is made. A diagonal entry
    takes one reciprocal instead of a division for each column.

    Args:
        graph: the graph, to which nodes are added.
        params: of JAX's operation: "left_side" (A X, else X A), "lower" (else upper), "transpose_a", and
            "unit_diagonal", where A's diagonal is taken for ones.
        a: A, an array of nodes.
        b: B, an array of nodes.
    """
    if params["conjugate_a"]:
        raise Unsupported("complex numbers")
    lower, transposed = params["lower"], params["transpose_a"]
    if not params["left_side"]:  # X A = B is A' X' = B'
        transposed, b = not transposed, b.T
    if transposed:
        a, lower = a.T, not lower
    # Now A X = B, for each column of B: x_i = (b_i - sum_j a_ij x_j) / a_ii over the rows j solved before, from the
    # first row on if A is lower triangular, else from the last.
    n, real = len(a), _type_of(a)
    one = graph.constant(1.0, real)
    reciprocals = [one if params["unit_diagonal"] else graph.node("div", real, one, a[i, i]) for i in range(n)]
    x = np.empty(b.shape, dtype=object)
    order = list(range(n)) if lower else list(range(n))[::-1]
    for step, i in enumerate(order):
        for column in range(b.shape[1]):
            remainder = b[i, column]
            for j in order[:step]:
                remainder = graph.node("sub", real, remainder, graph.node("mul", real, a[i, j], x[j, column]))
            x[i, column] = graph.node("mul", real, remainder, reciprocals[i])
    return x if params["left_side"] else x.T


RULES |= {
    "reduce_sum": _make_reduction_rule("add", 0), "reduce_prod": _make_reduction_rule("mul", 1),
    "reduce_or": _make_reduction_rule("or", 0), "reduce_and": _make_reduction_rule("and", ALL_BITS),
    "reduce_xor": _make_reduction_rule("xor", 0),
    "reduce_max": _make_reduction_rule("max", -np.inf), "reduce_min": _make_reduction_rule("min", np.inf),
    "cumsum": _make_accumulation_rule("add"), "cumprod": _make_accumulation_rule("mul"),
    "cummax": _make_accumulation_rule("max"), "cummin": _make_accumulation_rule("min"),
    "argmax": _make_extreme_index_rule("gt"), "argmin": _make_extreme_index_rule("lt"),
    "dot_general": write_product,
    "cholesky": _for_each_matrix(_cholesky), "triangular_solve": _for_each_matrix(_triangular_solve),
}  # fmt: skip
