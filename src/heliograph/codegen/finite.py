"""What a device's program may rely on: finite numbers, so that zero times them is zero, and tables however short."""

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
    """A graph that also drops products of zero with what comes of `buffers` of finite numbers alone.

    What may be missing (NaN) is no such buffer: a number made of it counts as finite only behind a choice that puts
    another in its place.
    """

    def __init__(self) -> None:
        super().__init__()
        self.buffers: set[Buffer] = set()
        self.finite: set[Node] = set()

    def node(self, op: str, type: Type, *args: Node, value: Any = None) -> Node:
        """As any graph's, but for those products."""
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
        """Numbers of tables are finite too."""
        made = super().load(buffer, offset, strides, indices)
        if buffer in self.buffers:
            self.finite.add(made)
        return made

    def _is_finite(self, node: Node) -> bool:
        return node in self.finite or is_finite(node)


class DeviceLowering(Lowering):
    """Lowers into a `FiniteGraph`: written out, with known arrays as tables of which the step may choose a row."""

    def __init__(self) -> None:
        super().__init__()
        self.graph: FiniteGraph = FiniteGraph()

    def equation(self, equation: JaxprEqn, inputs: list[Value]) -> Sequence[Value]:
        """Arithmetic is written out where the arrays that a loop would go through are not too long for that."""
        if equation.primitive.name in RULES and equation.primitive.name not in VIEWS:
            inputs = [self.nodes(x) if isinstance(x, InMemory) and x.size <= LARGE else x for x in inputs]
        return super().equation(equation, inputs)

    def known(self, number: Any) -> Value:
        """An array of known numbers in memory; what is read of it at a known place is a constant."""
        if not isinstance(number, np.ndarray | np.generic | jax.Array) or not np.shape(number) or not np.size(number):
            return super().known(number)
        if isinstance(number, np.ndarray) and number.dtype == object:
            return number
        array = np.asarray(number)
        return InMemory.whole(Buffer("table", type_of(array), array.shape, self.graph.top, array))
