"""Programs under construction: equal expressions are one node, and each stands in the outermost block that it can.

A node is one number in every run. Constants are folded when a node is made (`folding`), and a node belongs to the
outermost block that has all its arguments: what a loop does not change is computed before it.
"""

from collections.abc import Sequence
from typing import Any

from heliograph.codegen.folding import COMMUTATIVE, folded
from heliograph.codegen.nodes import Block, Buffer, Node, Number, Store, Type, Unsupported

MOST = 400_000  # nodes made, constants and what is dropped again among them


class Graph:
    """A program under construction, of `most` nodes. Nodes are made in `current`, the innermost open block."""

    def __init__(self, most: int = MOST) -> None:
        self.most = most
        self.top = Block(None)
        self.current = self.top
        self.serial = 0
        self.numbers: set[Node] = set()  # known not to be NaN

    def node(self, op: str, type: Type, *args: Node, value: Any = None) -> Node:
        """Return a node of an operation: a constant, an existing equal node, or a new one."""
        simpler = folded(self, op, type, args)
        if simpler is not None:
            return simpler
        if op in COMMUTATIVE and args[0].serial > args[1].serial:
            args = (args[1], args[0])
        return self.unfolded(op, type, args, value)

    def unfolded(self, op: str, type: Type, args: tuple[Node, ...], value: Any = None) -> Node:
        """Make a node without simplification."""
        return self._once(op, type, args, value, max([a.block.depth for a in args], default=0))

    def constant(self, value: Number, type: Type) -> Node:
        """Make a constant."""
        key = (type, value if value != 0 or type != "f64" else str(value))  # two zeros
        known = self.top.seen.get(key)
        if known is None:
            known = self.top.seen[key] = self.fresh("constant", type, (), self.top, value)
        return known

    def fresh(self, op: str, type: Type, args: tuple[Node, ...], block: Block, value: Any) -> Node:
        """Make a node that equals no other, and that no block contains yet."""
        self.serial += 1
        if self.serial > self.most:
            raise Unsupported(f"a program of more than {self.most} operations")
        return Node(op, type, args, block, value, self.serial)

    def load(self, buffer: Buffer, offset: int, strides: Sequence[int] = (), indices: Sequence[Node] = ()) -> Node:
        """Load buffer[offset + sum strides * indices], after the buffer is filled."""
        pairs = [(s, i) for s, i in zip(strides, indices, strict=True) if i.op != "constant"]
        offset += sum(s * i.value for s, i in zip(strides, indices, strict=True) if i.op == "constant")
        if buffer.table is not None and not pairs:
            return self.constant(buffer.table.ravel()[offset].item(), buffer.type)
        indices = tuple(i for _, i in pairs)
        value = (buffer, offset, tuple(s for s, _ in pairs))
        depth = max([i.block.depth for i in indices], default=0)
        return self._once("load", buffer.type, indices, value, max(depth, buffer.block.depth))

    def store(self, buffer: Buffer, node: Node, offset: int, strides: Sequence[int], indices: Sequence[Node]) -> None:
        """Store a number, in the open block."""
        written = Store(self.current, buffer, node, offset, strides, indices)
        buffer.stores.append(written)
        self.current.items.append(written)

    def _once(self, op: str, type: Type, args: tuple[Node, ...], value: Any, depth: int) -> Node:
        """Return the equal node of an open block, or make one: in the outermost block of this depth that may have it.

        A pinned block holds what is made within it.
        """
        key = (op, type, args, value)
        target, block = None, self.current
        while True:
            equal = block.seen.get(key)
            if equal is not None:
                return equal
            if target is None and (block.depth <= depth or block.pinned or block.parent is None):
                target = block
            if block.parent is None:
                break
            block = block.parent
        assert target is not None
        made = target.seen[key] = self.fresh(op, type, args, target, value)
        target.items.append(made)
        return made
