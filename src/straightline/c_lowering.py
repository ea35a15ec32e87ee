"""Lowering for C: written out, with known arrays as tables, and products of zero with finite numbers dropped."""

from collections.abc import Collection, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn

from straightline.constant_folding import is_finite
from straightline.graph import Graph
from straightline.lowering import RULES, Lowering, Value, arrange_nodes, type_of
from straightline.nodes import REAL, Buffer, Node, Type
from straightline.size_limits import LOADED
from straightline.strided_arrays import StridedArray

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
    """A graph that also simplifies products of zero with numbers that depend on `finite_buffers` only.

    Another buffer may have NaN for what is missing: a number that depends on it counts as finite only after a
    selection that replaces NaN.
    """

    def __init__(self) -> None:
        """Make an empty program, in which no input and no number is known to be finite yet."""
        super().__init__()
        # What is finite for certain: 0 times such a number is 0, and needs no operation.
        self.finite_buffers: set[Buffer] = set()  # inputs that hold no NaN
        self.finite: set[Node] = set()  # numbers that are computed from these alone

    def node(self, op: str, type: Type, *args: Node, value: Any = None) -> Node:
        """Return the node of a scalar operation; zero times a number that is always finite is the constant 0.

        `self.finite` holds the nodes that are finite whatever the data. The new node joins them if its arguments are
        finite and its operation keeps finite numbers finite: one of PRESERVING, or a selection.
        """
        if op == "mul" and type in REAL:
            for a, b in (args, args[::-1]):
                if a.op == "constant" and a.value == 0 and self._is_finite(b):
                    return self.constant(0.0, type)
        node = super().node(op, type, *args, value=value)
        numbers = args[1:] if op == "select" else args  # args[0] of a selection is its condition, a flag
        if type in REAL and (op in PRESERVING or op == "select") and all(map(self._is_finite, numbers)):
            self.finite.add(node)
        return node

    def load(self, buffer: Buffer, offset: int, strides: Sequence[int] = (), indices: Sequence[Node] = ()) -> Node:
        """Return the node of buffer[offset + sum strides * indices].

        The node is noted as finite if all numbers of its buffer are known to be finite.
        """
        made = super().load(buffer, offset, strides, indices)
        if buffer in self.finite_buffers:
            self.finite.add(made)
        return made

    def _is_finite(self, node: Node) -> bool:
        """Return whether a number is finite by what it depends on, or whatever the data."""
        return node in self.finite or is_finite(node)


class CLowering(Lowering):
    """Lowering into a `ZeroFoldingGraph`: written out, with known arrays as tables that a step can index."""

    def __init__(self) -> None:
        """Begin a program of scalar operations in which 0 times a number that is known to be finite is 0."""
        super().__init__()
        self.graph: ZeroFoldingGraph = ZeroFoldingGraph()

    def lower_equation(self, equation: JaxprEqn, inputs: list[Value]) -> Sequence[Value]:
        """Return the results of one operation of JAX, with arithmetic written out entry by entry.

        Arithmetic needs nodes, so arrays in memory are loaded first. Not loaded are arrays of more than LOADED numbers,
        and arguments of operations that only view an array (VIEWS).
        """
        if equation.primitive.name in RULES and equation.primitive.name not in VIEWS:
            inputs = [self.nodes(x) if isinstance(x, StridedArray) and x.size <= LOADED else x for x in inputs]
        return super().lower_equation(equation, inputs)

    def make_known_array(self, number: Any) -> Value:
        """Return an array of known numbers as a table in memory.

        An entry of the table at a known index is read as a constant. Single numbers and empty arrays get no table:
        the base class makes them. An array of objects holds nodes already, and is returned as it is.
        """
        if not isinstance(number, np.ndarray | np.generic | jax.Array) or not np.shape(number) or not np.size(number):
            return super().make_known_array(number)
        if isinstance(number, np.ndarray) and number.dtype == object:
            return number
        array = np.asarray(number)
        return StridedArray.of_whole_buffer(Buffer("table", type_of(array), array.shape, self.graph.top, array))


def lower_for_c(
    program: ClosedJaxpr, finite: Collection[int], symmetric: Collection[int], short: bool = False
) -> tuple[ZeroFoldingGraph, list[Buffer], list[np.ndarray]]:
    """Return a traced program's graph, a buffer for each argument and the nodes of each result.

    C code is then written from this graph of single operations on numbers (nodes). A buffer is the memory of one
    argument. What is known of the arguments saves operations: 0 times a finite number is 0.

    Args:
        program: the traced function, as JAX's list of operations (jaxpr).
        finite: positions of the arguments that hold no NaN.
        symmetric: positions of the arguments that are symmetric matrices; only their upper triangles are read.
        short: whether each loop stays a loop; else short ones are written out.
    """
    # The lowering translates JAX's operations to nodes; each argument has a memory (buffer) and a value.
    lowering, buffers, values = CLowering(), list[Buffer](), list[Any]()
    graph = lowering.graph
    if short:
        lowering.written_out = 0  # loops of at most so many operations are written out: none
    # One buffer for each argument, of its type and shape (`aval`).
    for number, variable in enumerate(program.jaxpr.invars):
        aval: Any = variable.aval
        buffer = Buffer("input", type_of(aval), tuple(aval.shape), graph.top)
        buffers.append(buffer)
        if number in finite:
            graph.finite_buffers.add(buffer)
        value: Any = StridedArray.of_whole_buffer(buffer)
        if number in symmetric:  # entries (i, j) and (j, i) are one node, that of the upper triangle
            nodes, n = value.nodes(graph), aval.shape[0]
            value = arrange_nodes([nodes[min(i, j), max(i, j)] for i in range(n) for j in range(n)], aval.shape)
        values.append(value)
    # Translate all operations of the program, in double precision; each result becomes an array of nodes.
    with jax.enable_x64(True):
        outputs = [lowering.nodes(x) for x in lowering.inline_program(program, values)]
    return graph, buffers, outputs
