"""Rules of arithmetic on long arrays in memory: a loop over their rows.

What `vmap` made of a step, for all rows of a record at once, becomes that step in a loop again.
"""

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from jax.extend.core import JaxprEqn

from straightline.graph import Graph
from straightline.lowering import (
    IN_MEMORY,
    RULES,
    Lowering,
    Rule,
    Value,
    arrange_nodes,
    make_placeholder,
    result_shape,
    result_type,
)
from straightline.nodes import Node, Type
from straightline.rules.elementwise import ELEMENTWISE
from straightline.rules.loops import LoopBody, make_counted_loop, put_in_memory
from straightline.rules.matrices import combine_nodes, write_product
from straightline.size_limits import LOADED, MANY_TERMS, TABLE, WRITTEN_OUT
from straightline.strided_arrays import StridedArray

OF_ENTRIES = (
    *ELEMENTWISE, "select_n", "integer_pow", "square", "rsqrt", "logistic", "clamp", "convert_element_type",
    "bitcast_convert_type", "round",
)  # fmt: skip


def is_long(inputs: list[Value]) -> bool:
    """Return whether an argument of an operation is too long to have a node (scalar operation) for each of its entries.

    Arrays of nodes are never too long. Of arrays in memory, the longest one counts: more than LOADED numbers are too
    long, and TABLE or fewer are not. In between it is too long unless all arrays in memory are tables of constants, and
    the operation is written out entry by entry anyhow (`_are_written_out`): operations on known zeros then fall away.
    """
    arrays_in_memory = [x for x in inputs if isinstance(x, StridedArray)]
    longest = max((x.size for x in arrays_in_memory), default=0)
    if longest <= TABLE:
        return False
    if longest > LOADED:
        return True
    are_tables = all(map(_is_table, arrays_in_memory))
    return not (are_tables and _are_written_out(inputs, longest))


def _is_table(x: Value) -> bool:
    """Return whether an array is a table of constants, at an index that is known."""
    return isinstance(x, StridedArray) and x.buffer.kind == "table" and not x.moves


def _are_written_out(inputs: list[Value], count: int) -> bool:
    """Return whether a result of `count` entries is written out entry by entry.

    `inputs` are tables (constants in memory) and arrays of nodes. The result is written out in three cases: an array
    has as many nodes already; all nodes are constants; or all arrays are single numbers, and no table has more than
    TABLE entries that are not zero (as in q I).
    """
    arrays = [x for x in inputs if not isinstance(x, StridedArray)]
    tables = [x for x in inputs if isinstance(x, StridedArray)]
    are_known = all(isinstance(n, Node) and n.op == "constant" for x in arrays for n in x.ravel().tolist())
    are_single = all(x.size == 1 for x in arrays)
    are_sparse = all(np.count_nonzero(x.get_known_numbers()) <= TABLE for x in tables)
    return are_known or any(x.size >= count for x in arrays) or (are_single and are_sparse)


def _make_row_by_row_rule(name: str) -> Rule:
    """Return the rule of JAX's elementwise operation `name`, for arrays that may be in memory.

    The numbers of short arrays are loaded, and each entry of the result is a scalar operation of its own. Of long
    arrays the result is computed row by row, in a loop of the program.
    """

    def lower_row_by_row(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
        """Lower an operation of entries (`name`): of long arrays one row of the result after another, in a loop.

        Arrays have the result's shape, or fewer axes, or one row.
        """
        shape, ndim = result_shape(equation), max(len(x.shape) for x in inputs)
        if not is_long(inputs):
            return list(RULES[name](lowering, equation, [lowering.nodes(x) for x in inputs]))
        # Arguments with rows are read from memory; those that all rows share stay as they are.
        items = [x if len(x.shape) < ndim or x.shape[0] == 1 else put_in_memory(lowering, x) for x in inputs]
        row_equation = make_row_equation(equation)

        def body(row: Node, carry: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
            """Return no carry, and the operation's result for the row with the number `row`, a node."""
            rows = [take_row_of_argument(lowering, x, row, ndim) for x in items]
            return [], list(lowering.lower_equation(row_equation, rows))

        return list(make_counted_loop(lowering, shape[0], [], lambda p, c: load_as_nodes(lowering, body(p, c)))[1])

    return lower_row_by_row


def load_as_nodes(
    lowering: Lowering, results: tuple[list[Value], list[Value]]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return the carried and the stacked arrays of a loop's iteration as nodes; arrays in memory are loaded."""
    carried, stacked = results
    return [lowering.nodes(x) for x in carried], [lowering.nodes(x) for x in stacked]


def take_row_of_argument(lowering: Lowering, x: Value, row: Node, ndim: int) -> Value:
    """Return the part of an argument that one row of the result needs; the result has `ndim` axes.

    That is all of an argument with fewer axes, which every row shares. Else it is the argument's only row if it has
    just one, or its row with the number `row`, a node (the counter of a loop).
    """
    if x.ndim < ndim:
        return x
    if isinstance(x, StridedArray):
        return x.row(0 if x.shape[0] == 1 else row)
    return x[:1].reshape(x.shape[1:])


def make_row_equation(equation: JaxprEqn, **params: Any) -> Any:
    """Return an operation of JAX as it is for one row of its results, so that the loop over rows can lower it.

    The loop's body passes it to the operation's rule, in the place of the whole operation (`equation`). It has the same
    attributes, but its results lack the first axis. Of the arguments rules read the types alone, so that they stay as
    they are. `params` replace parameters of the operation, such as axes, which have other numbers in a row.
    """
    avals: list[Any] = [v.aval for v in equation.outvars]  # shapes and types of the results
    rows = [SimpleNamespace(aval=make_placeholder(a.shape[1:], a.dtype)) for a in avals]
    return SimpleNamespace(
        primitive=equation.primitive, params=equation.params | params, outvars=rows, invars=equation.invars,
        source_info=equation.source_info,
    )  # fmt: skip


def _dot_general(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Lower a product of arrays (JAX's `dot_general`), written out or row by row in a loop.

    Written out are three kinds: products of short arrays; results of a single number from arrays of at most LOADED
    numbers; and products by a known matrix whose zeros leave few terms.
    """
    is_short_scalar_product = not result_shape(equation) and all(x.size <= LOADED for x in inputs)
    if is_short_scalar_product or not is_long(inputs):
        return list(RULES["dot_general"](lowering, equation, [lowering.nodes(x) for x in inputs]))
    arrays = [x if _is_table(x) or x.size > LOADED else lowering.nodes(x) for x in inputs]
    if (factors := _find_sparse_product(equation, arrays)) is not None:
        return list(_write_out_product(lowering, equation, factors))
    a, b = (put_in_memory(lowering, x) for x in inputs)
    return _multiply_by_row(lowering, equation, a, b)


def _multiply_by_row(lowering: Lowering, equation: JaxprEqn, a: StridedArray, b: StridedArray) -> list[Value]:
    """Lower a product of arrays in memory as a loop.

    The product (JAX's `dot_general`) becomes a loop in the graph of operations, since written out it would be too long.
    As JAX calls them, batch axes are common to both arguments and the result, contracted axes are summed over, and free
    axes belong to one argument and the result. The loop is over the first batch axis, else over the first free axis of
    a, else of b: each iteration computes a row of the result. Where there is no such axis, the loop is over the first
    contracted one, and iterations are summed.

    Args:
        lowering: translates JAX's operations to nodes of a graph.
        equation: the operation, with its axes in `params`.
        a: the first argument, in memory.
        b: the second.
    """
    (a_contracted, b_contracted), (a_batch, b_batch) = equation.params["dimension_numbers"]
    # The axis of each argument that is looped over, None where an argument is used whole in every iteration.
    if a_batch:
        a_axis, b_axis = a_batch[0], b_batch[0]
    else:
        a_axis = _find_free_axis(a, a_contracted)
        b_axis = _find_free_axis(b, b_contracted) if a_axis is None else None
    is_summed = a_axis is None and b_axis is None
    if is_summed:
        (a_axis, *a_contracted), (b_axis, *b_contracted) = a_contracted, b_contracted
    # The operation on one row: dimension numbers without the axis of the loop.
    contracted = _renumber_axes(a_contracted, a_axis), _renumber_axes(b_contracted, b_axis)
    batch = _renumber_axes(a_batch[1:], a_axis), _renumber_axes(b_batch[1:], b_axis)
    row_equation = make_row_equation(equation, dimension_numbers=(contracted, batch))
    by_row = [(x if axis is None else _move_to_front(x, axis), axis) for x, axis in ((a, a_axis), (b, b_axis))]

    def multiply_row(row: Node, carry: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return no carry, and the product for one row; `row` is the node of the loop's counter."""
        rows: list[Value] = [x if axis is None else x.row(row) for x, axis in by_row]
        return load_as_nodes(lowering, ([], list(lowering.lower_equation(row_equation, rows))))

    # As many iterations as the axis of the loop is long; the iterations' rows are stacked, or summed.
    count = next(x.shape[0] for x, axis in by_row if axis is not None)
    if is_summed:
        return _sum_iterations(lowering, equation, count, multiply_row)
    _carry, stacked = make_counted_loop(lowering, count, [], multiply_row)
    return list(stacked)


def _find_free_axis(x: StridedArray, contracted: Sequence[int]) -> int | None:
    """Return the first axis of x that is not among the axes that are summed over (`contracted`); None if all are."""
    return next((d for d in range(x.ndim) if d not in contracted), None)


def _multiply_nodes(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> Sequence[Value]:
    """Return the product of two arrays (JAX's `dot_general`) whose entries are nodes, the program's scalar operations.

    It is written out term by term, or if a product of two matrices has more than MANY_TERMS terms, made a loop over the
    rows of arrays in memory. A batch of matrices, and a sum over several axes, is always written out.
    """
    a, b = inputs
    # Axes of a and of b that are summed over, and axes that both share with the result.
    (a_summed, b_summed), (batch_axes, _) = equation.params["dimension_numbers"]
    is_matrix_product = not batch_axes and len(a_summed) == 1
    if is_matrix_product and _count_terms(a, a_summed[0], b, b_summed[0]) > MANY_TERMS:
        return _dot_general(lowering, equation, [put_in_memory(lowering, x) for x in inputs])
    return write_product(lowering, equation, inputs)


def _count_terms(a: np.ndarray, left: int, b: np.ndarray, right: int) -> int:
    """Return how many terms a_k b_k the product of a and b has, without terms that have a known zero as a factor.

    The product sums over axis `left` of a and axis `right` of b. The answer is 0 if the terms are at most MANY_TERMS
    even with zeros: they are then not counted.
    """
    if a.size * b.size <= MANY_TERMS * a.shape[left]:
        return 0
    # At each index along the summed axis, each entry of a that is no known zero meets each such entry of b.
    return int(_count_nonzero_entries(a, left) @ _count_nonzero_entries(b, right))


def _count_nonzero_entries(x: np.ndarray, axis: int) -> np.ndarray:
    """Return for each index along an axis how many of the entries there are not known to be zero.

    x is an array of nodes, the program's scalar operations; a constant node of 0 is a known zero.
    """
    is_data = np.array([n.op != "constant" or bool(n.value) for n in x.ravel().tolist()]).reshape(x.shape)
    counts: np.ndarray = np.moveaxis(is_data, axis, -1).reshape(-1, x.shape[axis]).sum(0)
    return counts


def _sum_iterations(lowering: Lowering, equation: JaxprEqn, count: int, body: LoopBody) -> list[Value]:
    """Return the sum of the numbers that `body` returns to be stacked, over the `count` iterations of a loop.

    The loop is one of the program that is being written. Its carry is the sum so far, an array of one node.
    """
    sum_along_first: Any = SimpleNamespace(params={"axes": (0,)}, outvars=equation.outvars)

    def add_number(row: Node, carry: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return the sum so far plus the number that `body` would stack, as the carry; nothing is stacked."""
        _no_carry, stacked = body(row, [])
        pair = np.stack([carry[0], *stacked])
        return [np.asarray(RULES["reduce_sum"](lowering, sum_along_first, [pair])[0])], []

    zero = RULES["reduce_sum"](lowering, sum_along_first, [np.empty(0, dtype=object)])[0]  # the sum of no numbers
    total, _stacked = make_counted_loop(lowering, count, [zero], add_number)
    return list(total)


def _find_sparse_product(equation: JaxprEqn, inputs: list[Value]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the factors A and B of a product A B' as matrices, if a known factor's zeros leave few terms; else None.

    A product of arrays sums over their contracted axes. All these axes are the columns of A and B, and the other, free
    axes their rows. A factor that is known, as a table of constants, is a matrix of numbers; the other one is a matrix
    of nodes. Few are at most WRITTEN_OUT products of two entries that are not known to be zero.
    """
    dimensions, (batch, _) = equation.params["dimension_numbers"]
    are_tables = [_is_table(x) for x in inputs]
    arrays = [x.get_known_numbers() if is_table else x for x, is_table in zip(inputs, are_tables, strict=True)]
    if batch or not any(are_tables) or any(isinstance(x, StridedArray) for x in arrays):
        return None
    # Column k gives (nonzero entries of A in it) (nonzero entries of B in it) products.
    factors, products_by_column = [], np.ones(1, dtype=np.int64)
    for x, is_table, contracted in zip(arrays, are_tables, dimensions, strict=True):
        free = [d for d in range(x.ndim) if d not in contracted]
        matrix = np.transpose(x, [*free, *contracted]).reshape(-1, math.prod(x.shape[d] for d in contracted))
        nonzero = np.count_nonzero(matrix, axis=0) if is_table else _count_nonzero_entries(matrix, 1)
        products_by_column = products_by_column * nonzero
        factors.append(matrix)
    return (factors[0], factors[1]) if products_by_column.sum() <= WRITTEN_OUT else None


def _write_out_product(
    lowering: Lowering, equation: JaxprEqn, factors: tuple[np.ndarray, np.ndarray]
) -> list[np.ndarray]:
    """Write out A B' entry by entry: the entry of rows a of A and b of B is the sum over k of a_k b_k, k ascending.

    Terms with a known zero are left out. `factors` are A and B, each (rows, contracted axis).
    """
    graph, type = lowering.graph, result_type(equation)
    left, right = ([_find_nonzero_entries(graph, type, row) for row in factor] for factor in factors)
    entries = []
    for a in left:
        for b in right:
            terms = [graph.node("mul", type, a[k], b[k]) for k in a if k in b]
            entries.append(combine_nodes(graph, "add", type, terms, 0.0))
    return [arrange_nodes(entries, result_shape(equation))]


def _find_nonzero_entries(graph: Graph, type: Type, row: np.ndarray) -> dict[int, Node]:
    """Return the nodes of a row's entries that are not known to be zero, by their indices.

    A row of numbers, rather than of nodes, is made constants.
    """
    if row.dtype != object:
        return {int(k): graph.constant(row[k].item(), type) for k in np.flatnonzero(row)}
    return {k: n for k, n in enumerate(row.tolist()) if n.op != "constant" or n.value}


def _move_to_front(x: StridedArray, axis: int) -> StridedArray:
    """Return a view of the same memory with this axis first, and the other axes in their order."""
    order = [axis, *(a for a in range(x.ndim) if a != axis)]
    return x.view([x.shape[a] for a in order], [x.strides[a] for a in order])


def _renumber_axes(axes: Sequence[int], removed: int | None) -> tuple[int, ...]:
    """Return the numbers that these axes have in an array without the axis `removed`; None removes none."""
    return tuple(axes) if removed is None else tuple(a - (a > removed) for a in axes)


def _make_reduction_rule(name: str) -> Rule:
    """Return the rule of JAX's reduction `name`, such as `reduce_sum`, for arrays that may be in memory.

    Short arrays are loaded and reduced number by number; long ones are reduced in a loop over their rows.
    """

    def lower_reduction(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
        """Lower the reduction `name` of an array along the operation's axes; a long array is reduced row by row."""
        if not is_long(inputs):
            return list(RULES[name](lowering, equation, [lowering.nodes(inputs[0])]))
        return _reduce_long(lowering, equation, name, inputs[0])

    return lower_reduction


def _reduce_long(lowering: Lowering, equation: JaxprEqn, name: str, x: Value) -> list[Value]:
    """Lower the reduction of a long array in a loop: each iteration reduces one row along its own axes.

    Lowering translates an operation of JAX (`equation`, such as reduce_sum, of this `name`) to nodes, one for each
    number of its result. A long array would need too many nodes, so a loop over its rows (axis 0) computes it: row by
    row. The reduced rows are stacked, or reduced further one after another where the operation's axes include axis 0.
    """
    axes = equation.params["axes"]
    # The same operation within a row, and on two rows to one; both have a result of the shape of a reduced row. A row
    # lacks axis 0, so its other axes have numbers that are lower by one.
    row_axes = tuple(axis - 1 for axis in axes if axis != 0)
    shape = tuple(n for axis, n in enumerate(x.shape[1:]) if axis not in row_axes)
    result = SimpleNamespace(aval=make_placeholder(shape, equation.outvars[0].aval.dtype))  # type: ignore[attr-defined]
    within_row: Any = SimpleNamespace(params=equation.params | {"axes": row_axes}, outvars=[result])
    of_two_rows: Any = SimpleNamespace(params=equation.params | {"axes": (0,)}, outvars=[result])

    def reduce_row(index: Node) -> np.ndarray:
        """Return a row reduced along its own axes."""
        return np.asarray(RULES[name](lowering, within_row, [lowering.nodes(x.row(index))])[0])

    def stack_row(index: Node, carry: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return no carry, and the reduced row to stack."""
        return [], [reduce_row(index)]

    def accumulate_row(index: Node, carry: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return the reduction of the rows so far and of row `index` as the carry, and nothing to stack."""
        pair = np.stack([carry[0], reduce_row(index)])
        return [np.asarray(RULES[name](lowering, of_two_rows, [pair])[0])], []

    if 0 not in axes:
        _carry, stacked = make_counted_loop(lowering, x.shape[0], [], stack_row)
        return list(stacked)
    # Accumulate from the neutral element on, which is the reduction of no rows.
    start = RULES[name](lowering, of_two_rows, [np.empty((0, *shape), dtype=object)])[0]
    total_of_rows, _stacked = make_counted_loop(lowering, x.shape[0], [start], accumulate_row)
    return list(total_of_rows)


REDUCTIONS = ("reduce_sum", "reduce_prod", "reduce_or", "reduce_and", "reduce_max", "reduce_min")
IN_MEMORY |= {name: _make_row_by_row_rule(name) for name in OF_ENTRIES}
IN_MEMORY |= {name: _make_reduction_rule(name) for name in REDUCTIONS}
IN_MEMORY |= {"dot_general": _dot_general}
RULES |= {"dot_general": _multiply_nodes}
