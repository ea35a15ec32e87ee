"""Rule of sort: few numbers by odd-even transposition, without branches."""

import numpy as np
from jax.extend.core import JaxprEqn

from straightline.graph import Graph
from straightline.lowering import RULES, Lowering, type_of
from straightline.nodes import REAL, Node, Unsupported
from straightline.rules.elementwise import select
from straightline.size_limits import FEW


def _sort(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return arrays sorted along an axis by the first one (JAX's `sort`); equal numbers keep their order, NaN is last.

    Data decide the order, so that nothing can be moved when the program is written. It is written as exchanges of
    neighbours at fixed places instead, by selections: as many passes as there are entries, at most FEW.
    """
    axis, graph = equation.params["dimension"], lowering.graph
    count, kind = inputs[0].shape[axis], type_of(equation.invars[0].aval)
    if equation.params["num_keys"] != 1 or kind == "bool" or count > FEW:
        raise Unsupported("sort")
    arrays = [np.moveaxis(x, axis, -1).copy() for x in inputs]
    for index in np.ndindex(*arrays[0].shape[:-1]):
        rows = [x[index] for x in arrays]  # views, which are sorted in place
        keys = rows[0]
        # Odd-even transposition: neighbours at even positions are exchanged if in the wrong order, then those at odd
        # ones.
        for pass_number in range(count):
            for i in range(pass_number % 2, count - 1, 2):
                is_wrong = _is_behind(graph, keys[i], keys[i + 1])
                for row in rows:
                    a, b = row[i], row[i + 1]
                    row[i], row[i + 1] = select(graph, is_wrong, b, a), select(graph, is_wrong, a, b)
    return [np.moveaxis(x, -1, axis) for x in arrays]


def _is_behind(graph: Graph, a: Node, b: Node) -> Node:
    """Return the node of a flag: whether a comes after b in ascending order, where NaN comes last.

    That is if a > b, or if a is NaN and b is not.
    """
    is_larger = graph.node("gt", "bool", a, b)
    if a.type not in REAL:
        return is_larger
    a_is_nan, b_is_number = graph.node("ne", "bool", a, a), graph.node("eq", "bool", b, b)
    return graph.node("or", "bool", is_larger, graph.node("and", "bool", a_is_nan, b_is_number))


RULES |= {"sort": _sort}
