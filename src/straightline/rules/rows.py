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
from straightline.limits import LOADED, MANY_TERMS, TABLE, WRITTEN_OUT
from straightline.lowering import IN_MEMORY, RULES, Lowering, Rule, Value, array_of, like, result_shape, result_type
from straightline.memory import InMemory
from straightline.nodes import Node, Type
from straightline.rules.elementwise import ELEMENTWISE
from straightline.rules.loops import Turn, in_memory, repeat_turns
from straightline.rules.matrices import total, write_product

OF_ENTRIES = (
    *ELEMENTWISE, "select_n", "integer_pow", "square", "rsqrt", "logistic", "clamp", "convert_element_type",
    "bitcast_convert_type", "round",
)  # fmt: skip


def is_long(inputs: list[Value]) -> bool:
    """Return whether nodes for all entries of an argument would be too many.

    Those of tables are constants: they are no more where the other arguments are known too, or are as many nodes.
    """
    longest = max((x.size for x in inputs if isinstance(x, InMemory)), default=0)
    known = all(map(_is_table, (x for x in inputs if isinstance(x, InMemory))))
    return longest > LOADED or (longest > TABLE and not (known and _are_written_out(inputs, longest)))


def _is_table(x: Value) -> bool:
    return isinstance(x, InMemory) and x.buffer.kind == "table" and not x.moves


def _are_written_out(inputs: list[Value], count: int) -> bool:
    """Return whether arrays are nodes already, or constants, so that a result is written out as nodes too."""
    arrays = [x for x in inputs if not isinstance(x, InMemory)]
    return any(x.size >= count for x in arrays) or all(
        isinstance(n, Node) and n.op == "constant" for x in arrays for n in x.ravel().tolist()
    )


def _apply_by_row(name: str) -> Rule:
    """Return the rule of an elementwise operation that computes long arrays row by row, in a loop."""

    def rule(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
        shape, ndim = result_shape(equation), max(len(x.shape) for x in inputs)
        if not is_long(inputs):
            return list(RULES[name](lowering, equation, [lowering.nodes(x) for x in inputs]))
        items = [x if len(x.shape) < ndim or x.shape[0] == 1 else in_memory(lowering, x) for x in inputs]
        row_equation = like_row(equation)

        def turn(row: Node, carry: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
            rows = [row_of(lowering, x, row, ndim) for x in items]
            return [], list(lowering.equation(row_equation, rows))

        return list(repeat_turns(lowering, shape[0], [], lambda p, c: as_nodes(lowering, turn(p, c)))[1])

    return rule


def as_nodes(lowering: Lowering, results: tuple[list[Value], list[Value]]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Load carried and stacked arrays."""
    carried, stacked = results
    return [lowering.nodes(x) for x in carried], [lowering.nodes(x) for x in stacked]


def row_of(lowering: Lowering, x: Value, row: Node, ndim: int) -> Value:
    """Return the part of an argument that a row of the result needs: its only row, or all where it has fewer axes."""
    if x.ndim < ndim:
        return x
    if isinstance(x, InMemory):
        return x.row(0 if x.shape[0] == 1 else row)
    return x[:1].reshape(x.shape[1:])


def like_row(equation: JaxprEqn, **params: Any) -> Any:
    """Return the same operation for one row."""
    avals: list[Any] = [v.aval for v in equation.outvars]
    rows = [SimpleNamespace(aval=like(a.shape[1:], a.dtype)) for a in avals]
    return SimpleNamespace(
        primitive=equation.primitive, params=equation.params | params, outvars=rows, invars=equation.invars,
        source_info=equation.source_info,
    )  # fmt: skip


def _dot_general(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Loop over the first batch axis, else the first free axis of the left argument, else that of the right one.

    A sum over all axes is accumulated over the first of them.
    """
    (left, right), (left_batch, right_batch) = equation.params["dimension_numbers"]
    to_number = not result_shape(equation) and all(x.size <= LOADED for x in inputs)
    if to_number or not is_long(inputs):
        return list(RULES["dot_general"](lowering, equation, [lowering.nodes(x) for x in inputs]))
    short = [x if _is_table(x) or x.size > LOADED else lowering.nodes(x) for x in inputs]
    if (factors := _find_few_terms(equation, short)) is not None:
        return list(_write_out_product(lowering, equation, factors))
    a, b = (in_memory(lowering, x) for x in inputs)
    free_left, free_right = (
        next((d for d in range(x.ndim) if d not in axes), None) for x, axes in ((a, left), (b, right))
    )
    in_left, in_right = (left_batch[0], right_batch[0]) if left_batch else (free_left, None)
    if in_left is None:
        in_right = free_right
    summed = in_left is None and in_right is None
    if summed:
        (in_left, *left), (in_right, *right) = left, right
    # Dimension numbers of one row: without the axis that is looped over.
    numbers = tuple(
        tuple(
            axes if gone is None else _without(axes, gone) for axes, gone in zip(pair, (in_left, in_right), strict=True)
        )
        for pair in ((left, right), (left_batch[1:], right_batch[1:]))
    )
    a, b = (x if axis is None else _first(x, axis) for x, axis in ((a, in_left), (b, in_right)))
    # The operation on one row, in a loop.
    row_equation = like_row(equation, dimension_numbers=numbers)

    def turn(row: Node, carry: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        rows: list[Value] = [x if axis is None else x.row(row) for x, axis in ((a, in_left), (b, in_right))]
        return as_nodes(lowering, ([], list(lowering.equation(row_equation, rows))))

    count = (b if in_left is None else a).shape[0]
    return (
        _accumulate_turns(lowering, equation, count, turn)
        if summed
        else list(repeat_turns(lowering, count, [], turn)[1])
    )


def _of_nodes(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> Sequence[Value]:
    """Write a product of matrices out, but for one of many terms: a loop over rows in memory."""
    (left, right), (batch, _) = equation.params["dimension_numbers"]
    if batch or len(left) != 1 or _count_terms(inputs[0], left[0], inputs[1], right[0]) <= MANY_TERMS:
        return write_product(lowering, equation, inputs)
    return _dot_general(lowering, equation, [in_memory(lowering, x) for x in inputs])


def _count_terms(a: np.ndarray, left: int, b: np.ndarray, right: int) -> int:
    """Count the terms of all sums over an axis of a and one of b, without those that a known zero leaves out."""
    if a.size * b.size <= MANY_TERMS * a.shape[left]:
        return 0
    # Of each place along the axis, how many entries of a and of b are no known zero: each of these meets each.
    met = [_count_data(x, axis) for x, axis in ((a, left), (b, right))]
    return int(met[0] @ met[1])


def _count_data(x: np.ndarray, axis: int) -> np.ndarray:
    """Count the entries that are no known zero, for each place along an axis."""
    is_data = np.array([n.op != "constant" or bool(n.value) for n in x.ravel().tolist()]).reshape(x.shape)
    counts: np.ndarray = np.moveaxis(is_data, axis, -1).reshape(-1, x.shape[axis]).sum(0)
    return counts


def _accumulate_turns(lowering: Lowering, equation: JaxprEqn, count: int, turn: Turn) -> list[Value]:
    """Sum a number that each turn of a loop gives."""
    pair: Any = SimpleNamespace(params={"axes": (0,)}, outvars=equation.outvars)

    def add(row: Node, carry: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        return [np.asarray(RULES["reduce_sum"](lowering, pair, [np.stack([carry[0], *turn(row, [])[1]])])[0])], []

    start = RULES["reduce_sum"](lowering, pair, [np.empty(0, dtype=object)])[0]
    return list(repeat_turns(lowering, count, [start], add)[0])


def _find_few_terms(equation: JaxprEqn, inputs: list[Value]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the factors of a product by a known matrix as (free, contracted) if its zeros leave few terms, else None.

    A known factor is an array of numbers, the other one of nodes.
    """
    dimensions, (batch, _) = equation.params["dimension_numbers"]
    tables = [_is_table(x) for x in inputs]
    loaded = [x.numbers() if t else x for x, t in zip(inputs, tables, strict=True)]
    if batch or not any(tables) or any(isinstance(x, InMemory) for x in loaded):
        return None
    factors, count = [], np.ones(1, dtype=np.int64)
    for x, table, contracted in zip(loaded, tables, dimensions, strict=True):
        free = [d for d in range(x.ndim) if d not in contracted]
        rows = np.transpose(x, [*free, *contracted]).reshape(-1, math.prod(x.shape[d] for d in contracted))
        count = count * (np.count_nonzero(rows, axis=0) if table else _count_data(rows, 1))
        factors.append(rows)
    return (factors[0], factors[1]) if count.sum() <= WRITTEN_OUT else None


def _write_out_product(
    lowering: Lowering, equation: JaxprEqn, factors: tuple[np.ndarray, np.ndarray]
) -> list[np.ndarray]:
    """Sum the terms of a product that known zeros leave, of each entry in the order of the contracted axis."""
    graph, type = lowering.graph, result_type(equation)
    left, right = ([_terms_of(graph, type, row) for row in factor] for factor in factors)
    entries = []
    for a in left:
        for b in right:
            terms = [graph.node("mul", type, a[k], b[k]) for k in a if k in b]
            entries.append(total(graph, "add", type, terms, 0.0))
    return [array_of(entries, result_shape(equation))]


def _terms_of(graph: Graph, type: Type, row: np.ndarray) -> dict[int, Node]:
    """Return the entries of a row that are no known zeros, by their places."""
    if row.dtype != object:
        return {int(k): graph.constant(row[k].item(), type) for k in np.flatnonzero(row)}
    return {k: n for k, n in enumerate(row.tolist()) if n.op != "constant" or n.value}


def _first(x: InMemory, axis: int) -> InMemory:
    """Move an axis to the front."""
    order = [axis, *(a for a in range(x.ndim) if a != axis)]
    return x.view([x.shape[a] for a in order], [x.strides[a] for a in order])


def _without(axes: tuple[int, ...], removed: int) -> tuple[int, ...]:
    return tuple(a - (a > removed) for a in axes)


def _reduction(name: str) -> Rule:
    """Make a rule that reduces the first axis row after row, and other axes within each row."""

    def rule(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
        """Reduce short arrays at once, long ones row by row in a loop, which accumulates over rows if need be."""
        x, axes = inputs[0], equation.params["axes"]
        if not is_long(inputs):
            return list(RULES[name](lowering, equation, [lowering.nodes(x)]))
        # The reduction within a row, and that of two rows.
        inner = tuple(a - 1 for a in axes if a)
        shape = tuple(n for a, n in enumerate(x.shape[1:]) if a not in inner)
        dtype = equation.outvars[0].aval.dtype  # type: ignore[attr-defined]
        row = SimpleNamespace(aval=like(shape, dtype))
        params = equation.params | {"axes": inner}
        within: Any = SimpleNamespace(params=params, outvars=[row])
        pair: Any = SimpleNamespace(params=equation.params | {"axes": (0,)}, outvars=[row])

        def reduced(row_index: Node) -> np.ndarray:
            return np.asarray(RULES[name](lowering, within, [lowering.nodes(x.row(row_index))])[0])

        # Rows stay apart, or are accumulated from the neutral element.
        if 0 not in axes:
            return list(repeat_turns(lowering, x.shape[0], [], lambda row_index, _: ([], [reduced(row_index)]))[1])
        nothing = np.empty((0, *shape), dtype=object)
        start = RULES[name](lowering, pair, [nothing])[0]

        def turn(row_index: Node, carry: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
            return [np.asarray(RULES[name](lowering, pair, [np.stack([carry[0], reduced(row_index)])])[0])], []

        return list(repeat_turns(lowering, x.shape[0], [start], turn)[0])

    return rule


REDUCTIONS = ("reduce_sum", "reduce_prod", "reduce_or", "reduce_and", "reduce_max", "reduce_min")
IN_MEMORY |= {name: _apply_by_row(name) for name in OF_ENTRIES}
IN_MEMORY |= {name: _reduction(name) for name in REDUCTIONS}
IN_MEMORY |= {"dot_general": _dot_general}
RULES |= {"dot_general": _of_nodes}
