"""Simplifications for devices: inputs are finite, so that zero times them is zero; known arrays become tables."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import JaxprEqn

from heliograph.codegen.folding import is_finite
from heliograph.codegen.graph import Buffer, Graph, Node, Type
from heliograph.codegen.lowering import RULES, Lowering, Value, type_of
from heliograph.codegen.memory import LARGE, InMemory

# Finite where the arguments are, but for overflow and divisions by zero, which the finished step is checked for.
PRESERVING = frozenset((
    "add", "sub", "mul", "div", "neg", "abs", "sqrt", "exp", "log", "log1p", "expm1", "sin", "cos", "tan", "tanh",
    "asin", "acos", "atan", "atan2", "floor", "ceil", "sign", "max", "min", "round_even", "pow", "rem",
))  # fmt: skip


# Of an array in memory these make a view; all others take its numbers.
VIEWS = frozenset(
    ("dynamic_slice", "gather", "slice", "squeeze", "expand_dims", "reshape", "transpose", "broadcast_in_dim")
)


class FiniteGraph(Graph):
    """A graph that also simplifies products of zero with numbers that depend on finite `buffers` only.

    A measurement, whose components may be NaN, is no such buffer: a number that depends on it counts as finite only
    after a selection that replaces NaN.
    """

    def __init__(self) -> None:
        super().__init__()
        self.buffers: set[Buffer] = set()
        self.finite: set[Node] = set()

    def node(self, op: str, type: Type, *args: Node, value: Any = None) -> Node:
        """Make a node, with products of zero and a finite number simplified."""
        if op == "mul" and type == "f64":
            for a, b in (args, args[::-1]):
                if a.op == "constant" and a.value == 0 and self._is_finite(b):
                    return self.constant(0.0, "f64")
        made = super().node(op, type, *args, value=value)
        numbers = args[1:] if op == "select" else args
        if type == "f64" and (op in PRESERVING or op == "select") and all(map(self._is_finite, numbers)):
            self.finite.add(made)
        return made

    def load(self, buffer: Buffer, offset: int, strides: Sequence[int] = (), indices: Sequence[Node] = ()) -> Node:
        """Load a number; those of tables are finite too."""
        made = super().load(buffer, offset, strides, indices)
        if buffer in self.buffers:
            self.finite.add(made)
        return made

    def _is_finite(self, node: Node) -> bool:
        return node in self.finite or is_finite(node)


class DeviceLowering(Lowering):
    """Lowering into a `FiniteGraph`: written out, with known arrays as tables that a step can index."""

    def __init__(self) -> None:
        super().__init__()
        self.graph: FiniteGraph = FiniteGraph()

    def equation(self, equation: JaxprEqn, inputs: list[Value]) -> Sequence[Value]:
        """Lower one operation; arithmetic is written out unless its arrays are too long."""
        if equation.primitive.name in RULES and equation.primitive.name not in VIEWS:
            inputs = [self.nodes(x) if isinstance(x, InMemory) and x.size <= LARGE else x for x in inputs]
        return super().equation(equation, inputs)

    def known(self, number: Any) -> Value:
        """Place an array of known numbers in memory; an entry at a known place is a constant."""
        if not isinstance(number, np.ndarray | np.generic | jax.Array) or not np.shape(number) or not np.size(number):
            return super().known(number)
        if isinstance(number, np.ndarray) and number.dtype == object:
            return number
        array = np.asarray(number)
        return InMemory.whole(Buffer("table", type_of(array), array.shape, self.graph.top, array))
