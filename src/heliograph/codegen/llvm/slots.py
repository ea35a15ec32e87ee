"""Memory of numbers that all runs share, between the function that computes them and the one that uses them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from heliograph.codegen.graph import Loop, Node
from heliograph.codegen.llvm.operations import BITS, vector

if TYPE_CHECKING:
    from heliograph.codegen.llvm.text import Writer


class Slots:
    """Layout of numbers that all runs share: one function computes them, the other reads them.

    A number in a loop has a place for each turn.
    """

    def __init__(self, size: int):
        self.size = size  # bytes
        self.places: dict[Node, int] = {}
        self.base = ""

    def offset_of(self, node: Node) -> int:
        """Return the offset of a number, assigned at its first use."""
        if node not in self.places:
            self.places[node] = self.size
            turns = 1
            for loop in loops_of(node):
                turns *= loop.length or 1
            self.size += 8 * turns
        return self.places[node]

    def load(self, writer: Writer, node: Node) -> str:
        """Load a shared number, a scalar."""
        address = self._address(writer, node)
        loaded = writer.add(f"load i{BITS[node.type]}, ptr {address}, align 8")
        if node.type == "bool":
            return writer.add(f"trunc i8 {loaded} to i1")
        return writer.add(f"bitcast i64 {loaded} to double") if node.type == "f64" else loaded

    def store(self, writer: Writer, node: Node, name: str) -> None:
        """Store a number if the other function uses it."""
        if node not in self.places or writer.width != 1:
            return
        kind = vector(node.type, 1)
        address = self._address(writer, node)
        if node.type == "bool":
            name, kind = writer.add(f"zext {kind} {name} to <1 x i8>"), "<1 x i8>"
        writer.line(f"store {kind} {name}, ptr {address}, align 1")

    def _address(self, writer: Writer, node: Node) -> str:
        offset, stride, index = self.offset_of(node), 8, ""
        for loop in loops_of(node):
            assert loop.counter is not None
            step = writer.add(f"mul i64 {writer.scalar(loop.counter)}, {stride}")
            index = writer.add(f"add i64 {index}, {step}") if index else step
            stride *= loop.length or 1
        start = writer.add(f"getelementptr i8, ptr {self.base}, i64 {offset}")
        return writer.add(f"getelementptr i8, ptr {start}, i64 {index}") if index else start


def loops_of(node: Node) -> list[Loop]:
    """Return the loops around a node, innermost first."""
    return [b.owner for b in node.block.inwards() if isinstance(b.owner, Loop)]
