"""Lowering for C: written out, with known arrays as tables, and products of zero with finite numbers dropped."""

from collections.abc import Collection, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn

from straightline.folding import is_finite
from straightline.graph import Graph
from straightline.limits import LOADED
from straightline.lowering import RULES, Lowering, Value, array_of, type_of
from straightline.memory import InMemory
from straightline.nodes import REAL, Buffer, Node, Type

# Finite where the arguments are, but for overflow and divisions by zero.
PRESERVING = frozenset((
    "add", "sub", "mul", "div", "neg", "abs", "sqrt", "exp", "log", "log1p", "expm1", "sin", "cos", "tan", "tanh",
    "asin", "acos", "atan", "atan2", "floor", "ceil", "sign", "max", "min", "round_even", "pow", "rem",
))  # fmt: skip
# Of an array in memory these make a view; all others take its numbers.
VIEWS = frozenset(
    ("dynamic_slice", "gather", "slice", "squeeze", "expand_dims", "reshape", "transpose", "broadcast_in_dim")
)


class ZeroFoldingGraph(Graph):
    """A graph that also simplifies products of zero with numbers that depend on finite `buffers` only.

    Another buffer may have NaN for what is missing: a number that depends on it counts as finite only after a
    selection that replaces NaN.
    """

    def __init__(self) -> None:
        super().__init__()
        self.buffers: set[Buffer] = set()
        self.finite: set[Node] = set()

    def node(self, op: str, type: Type, *args: Node, value: Any = None) -> Node:
        """Make a node, with products of zero and a finite number simplified."""
        if op == "mul" and type in REAL:
            for a, b in (args, args[::-1]):
                if a.op == "constant" and a.value == 0 and self._is_finite(b):
                    return self.constant(0.0, type)
        made = super().node(op, type, *args, value=value)
        numbers = args[1:] if op == "select" else args
        if type in REAL and (op in PRESERVING or op == "select") and all(map(self._is_finite, numbers)):
            self.finite.add(made)
        return made

    def load(self, buffer: Buffer, offset: int, strides: Sequence[int] = (), indices: Sequence[Node] = ()) -> Node:
        """Load a number; note that it is finite if all of its buffer are."""
        made = super().load(buffer, offset, strides, indices)
        if buffer in self.buffers:
            self.finite.add(made)
        return made

    def _is_finite(self, node: Node) -> bool:
        """Return whether a number is finite by what it depends on, or whatever the data."""
        return node in self.finite or is_finite(node)


class CLowering(Lowering):
    """Lowering into a `ZeroFoldingGraph`: written out, with known arrays as tables that a step can index."""

    def __init__(self) -> None:
        super().__init__()
        self.graph: ZeroFoldingGraph = ZeroFoldingGraph()

    def equation(self, equation: JaxprEqn, inputs: list[Value]) -> Sequence[Value]:
        """Lower one operation; arithmetic is written out unless its arrays are too long."""
        if equation.primitive.name in RULES and equation.primitive.name not in VIEWS:
            inputs = [self.nodes(x) if isinstance(x, InMemory) and x.size <= LOADED else x for x in inputs]
        return super().equation(equation, inputs)

    def known(self, number: Any) -> Value:
        """Place an array of known numbers in memory; an entry at a known place is a constant."""
        if not isinstance(number, np.ndarray | np.generic | jax.Array) or not np.shape(number) or not np.size(number):
            return super().known(number)
        if isinstance(number, np.ndarray) and number.dtype == object:
            return number
        array = np.asarray(number)
        return InMemory.whole(Buffer("table", type_of(array), array.shape, self.graph.top, array))


def lower_for_c(
    program: ClosedJaxpr, finite: Collection[int], symmetric: Collection[int], short: bool = False
) -> tuple[ZeroFoldingGraph, list[Buffer], list[np.ndarray]]:
    """Return a traced program's graph, a buffer for each argument and the nodes of each result.

    `finite` arguments have no NaN; of `symmetric` ones the upper triangle alone is read. `short`: each loop stays one.
    """
    lowering, buffers, values = CLowering(), list[Buffer](), list[Any]()
    graph = lowering.graph
    lowering.written_out = 0 if short else lowering.written_out
    for number, variable in enumerate(program.jaxpr.invars):
        aval: Any = variable.aval
        buffer = Buffer("input", type_of(aval), tuple(aval.shape), graph.top)
        buffers.append(buffer)
        if number in finite:
            graph.buffers.add(buffer)
        value: Any = InMemory.whole(buffer)
        if number in symmetric:
            nodes, n = value.nodes(graph), aval.shape[0]
            value = array_of([nodes[min(i, j), max(i, j)] for i in range(n) for j in range(n)], aval.shape)
        values.append(value)
    with jax.enable_x64(True):
        outputs = [lowering.nodes(x) for x in lowering.inline(program, values)]
    return graph, buffers, outputs
