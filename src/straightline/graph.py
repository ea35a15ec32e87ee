"""Programs under construction: equal expressions are one node, and each stands in the outermost block that it can.

A node is one number in every run. Constants are folded when a node is made (`folding`), and a node belongs to the
outermost block that has all its arguments: what a loop does not change is computed before it.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from straightline.constant_folding import COMMUTATIVE, DTYPES, fold_node
from straightline.nodes import REAL, Block, Buffer, Node, Number, Store, Type, Unsupported
from straightline.size_limits import LONGEST


class Graph:
    """A program under construction: blocks of nodes (operations); new nodes are added to the block that is open.

    By default it may have twice as many nodes as the longest program: folding makes some that the result does not need.
    """

    def __init__(self, max_nodes: int = 2 * LONGEST) -> None:
        """Begin a program with one empty block, which is open; more than `max_nodes` nodes in all are refused."""
        self.max_nodes = max_nodes
        self.top = Block(None)  # the outermost block, around all loops
        self.current = self.top  # the open block
        self.serial = 0  # number of the last node that was made; nodes are counted from 1
        self.never_nan: set[Node] = set()  # nodes that are known not to be NaN, whatever the data

    def node(self, op: str, type: Type, *args: Node, value: Any = None) -> Node:
        """Return the node of an operation: a constant, a simpler node, an equal node that exists, or a new node.

        Arguments of COMMUTATIVE operations are put in one order, so that a + b and b + a are one node.
        """
        simpler = fold_node(self, op, type, args)
        if simpler is not None:
            return simpler
        if op in COMMUTATIVE and args[0].serial > args[1].serial:
            args = (args[1], args[0])
        return self._find_or_make(op, type, args, value)

    def constant(self, value: Number, type: Type) -> Node:
        """Return the node of a constant number; equal constants of a type share one node.

        A constant of type "f32" is rounded to single precision.
        """
        value = DTYPES[type](value).item() if type == "f32" else value
        key = (type, value if value != 0 or type not in REAL else str(value))  # 0.0 == -0.0, but they differ
        node = self.top.seen.get(key)
        if node is None:
            node = self.top.seen[key] = self.make_fresh_node("constant", type, (), self.top, value)
        return node

    def make_fresh_node(self, op: str, type: Type, args: tuple[Node, ...], block: Block, value: Any) -> Node:
        """Return a new node with the next serial number, even if an equal one exists; no block contains it yet.

        Raises:
            Unsupported: the program has more than `max_nodes` nodes.
        """
        self.serial += 1
        if self.serial > self.max_nodes:
            raise Unsupported(f"a program of more than {self.max_nodes} operations")
        return Node(op, type, args, block, value, self.serial)

    @contextmanager
    def limit_new_nodes(self, count: int) -> Iterator[None]:
        """Allow at most `count` new nodes inside the `with` block, within the whole limit; more raise Unsupported.

        `serial` counts the nodes that exist, and `current` is the block of operations that is open. After the `with`
        block, even after an exception, both the limit and the open block are as before.
        """
        before, block = self.max_nodes, self.current
        self.max_nodes = min(before, self.serial + count)
        try:
            yield
        finally:
            self.max_nodes, self.current = before, block

    def load(self, buffer: Buffer, offset: int, strides: Sequence[int] = (), indices: Sequence[Node] = ()) -> Node:
        """Return the node of the number buffer[offset + sum strides * indices].

        The load must not be moved out of the block that fills the buffer (`buffer.block`), where the memory is not
        filled yet. A buffer may consist of rows in which some entries are always equal, as in symmetric matrices: then
        buffer.first[i] is the first entry of a row that equals entry i. It is empty if no entries are known to be
        equal.
        """
        # Indices that are constants become part of the offset; `varying` are the strides and indices of all others.
        varying = [(s, i) for s, i in zip(strides, indices, strict=True) if i.op != "constant"]
        offset += sum(s * i.value for s, i in zip(strides, indices, strict=True) if i.op == "constant")
        if buffer.table is not None and not varying:
            return self.constant(buffer.table.ravel()[offset].item(), buffer.type)
        # If the other indices only choose a row, it is known which entry of the row is loaded. Load instead the first
        # entry that is equal, so that equal loads are one node.
        row_length = len(buffer.first)
        if row_length and all(s % row_length == 0 for s, _ in varying):
            entry = offset % row_length
            offset += buffer.first[entry] - entry
        indices = tuple(i for _, i in varying)
        value = (buffer, offset, tuple(s for s, _ in varying))
        return self._find_or_make("load", buffer.type, indices, value, buffer.block.depth)

    def store(self, buffer: Buffer, node: Node, offset: int, strides: Sequence[int], indices: Sequence[Node]) -> None:
        """Add to the open block the statement buffer[offset + sum strides * indices] = node.

        The indices are nodes, known when the program runs; with none of them the statement fills buffer[offset].
        """
        statement = Store(self.current, buffer, node, offset, strides, indices)
        buffer.stores.append(statement)
        self.current.items.append(statement)

    def _find_or_make(self, op: str, type: Type, args: tuple[Node, ...], value: Any, depth: int = 0) -> Node:
        """Return an equal node of the open block or of a block around it; if there is none, make one.

        A new node is put in the outermost block in which it can be computed, so that a loop does not compute anew what
        it does not change. All its arguments must be in that block or around it, and the block must be at least `depth`
        blocks deep. A pinned block, the body of a guard, is computed only where a run needs it: a node that is made
        within it is not moved out of it.
        """
        key, block = (op, type, args, value), self.current
        while (equal := block.seen.get(key)) is None and block.parent is not None:
            block = block.parent
        if equal is not None:
            return equal
        block = self.current
        if block.parent is not None:
            least_depth = max(depth, *[a.block.depth for a in args], 0)
            while block.depth > least_depth and not block.pinned and block.parent is not None:
                block = block.parent
        made = block.seen[key] = self.make_fresh_node(op, type, args, block, value)
        block.items.append(made)
        return made
