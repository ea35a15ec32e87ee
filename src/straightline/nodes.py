"""Nodes of a program: scalar operations in blocks, loops and guarded blocks between them, and arrays in memory."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np

from straightline.size_limits import ANY_LENGTH

Type = Literal["f64", "f32", "bool", "i32", "i64", "u32", "u64"]
TYPES: dict[str, Type] = {
    "float64": "f64",
    "float32": "f32",
    "bool": "bool",
    "int32": "i32",
    "int64": "i64",
    "uint32": "u32",
    "uint64": "u64",
}
REAL = frozenset(("f64", "f32"))  # types of floating-point numbers
Number = float | int | bool


class Unsupported(Exception):  # noqa: N818
    """Error of a program that is not supported: the operation, and its place in the program."""

    def __init__(self, operation: str, where: str = ""):
        """Make the error of an operation that cannot be compiled; `where`: its place in the program, if known."""
        super().__init__(f"{operation}{f' at {where}' if where else ''}")
        self.operation, self.where = operation, where


class Node:
    """One scalar operation on some nodes.

    `value` has what is known at compile time: a constant's number, a parameter's or result's (loop, index), a load's
    (buffer, offset, strides). `serial` counts nodes in the order in which they were made.
    """

    __slots__ = ("args", "block", "op", "serial", "type", "value")

    def __init__(self, op: str, type: Type, args: tuple["Node", ...], block: "Block", value: Any, serial: int):
        """Hold one scalar operation: its name, the type of its result, its arguments, and the block that computes it.

        `value` is what is known of it at compile time, and `serial` the number of nodes that were made up to this
        one.
        """
        self.op, self.type, self.args, self.block, self.value, self.serial = op, type, args, block, value, serial

    def __repr__(self) -> str:
        """Return a constant's value, or for any other node its serial, operation and arguments: %7=add(%3, %5)."""
        if self.op == "constant":
            return str(self.value)
        return f"%{self.serial}={self.op}({', '.join(f'%{a.serial}' for a in self.args)})"


class RandomKey:
    """A key of random numbers: its two words, of type u32."""

    __slots__ = ("first", "second")

    def __init__(self, first: Node, second: Node):
        """Hold the first and the second 32-bit word of a key of random numbers, each a node."""
        self.first, self.second = first, second


class Block:
    """Operations and statements in order; they may use nodes of the enclosing blocks.

    `owner`: the loop or guard of the block. `pinned`: nodes made here stay here, since they are computed only where a
    run needs them.
    """

    __slots__ = ("depth", "items", "owner", "parent", "pinned", "seen")

    def __init__(self, parent: "Block | None", pinned: bool = False):
        """Make an empty block inside the block `parent`; None makes the outermost block.

        `pinned`: nodes that are made in the block stay there, and are not moved to a block around it.
        """
        self.parent, self.pinned = parent, pinned
        self.owner: Loop | Guard | None = None  # the statement whose body this block is
        self.depth: int = 0 if parent is None else parent.depth + 1
        self.items: list[Node | Loop | Guard | Store | LoopExit] = []
        self.seen: dict[Any, Node] = {}  # nodes made here, by operation and arguments, which equal ones reuse

    def free_contents(self) -> None:
        """Empty this block and the blocks inside it.

        This breaks the cycles of references, so that Python frees the nodes at once and need not search for cycles.
        """
        for statement in self.items:
            if isinstance(statement, Node):
                statement.value = None
            elif isinstance(statement, Store):
                statement.buffer.stores, statement.buffer.parts = [], []
            elif isinstance(statement, Loop | Guard):
                statement.body.free_contents()
                statement.results = []
                if isinstance(statement, Loop):
                    statement.parameters, statement.following = [], []
                    statement.condition = statement.counter = None
        self.items, self.seen, self.owner = [], {}, None

    def list_enclosing_blocks(self) -> Iterator["Block"]:
        """Yield this block and the blocks around it, the outermost last."""
        block: Block | None = self
        while block is not None:
            yield block
            block = block.parent

    def list_loops(self) -> list["Loop"]:
        """Return the loops around the block's nodes, innermost first."""
        return [b.owner for b in self.list_enclosing_blocks() if isinstance(b.owner, Loop)]

    def count_iterations(self) -> int:
        """Return how many times the block is executed: the product of the lengths of the loops around it.

        A loop counts once if its length is not known when the program is compiled.
        """
        lengths = [loop.length for loop in self.list_loops()]
        return math.prod(1 if length is None or length == ANY_LENGTH else length for length in lengths)


class Buffer:
    """Numbers in memory, `size` of each run; a table has the same numbers in all runs.

    `kind`: "input", "scratch", "table", or "carried" by a loop, of which each iteration fills it anew. A buffer that
    the program fills is read after the statement of `block` that fills it. A buffer `inside` another starts at an entry
    of it. `first`: for each entry of a row the first entry of the row that has the same number, as across the diagonal
    of a symmetric matrix; empty where all entries differ.
    """

    __slots__ = ("block", "first", "inside", "kind", "parts", "shape", "stores", "table", "type")

    def __init__(self, kind: str, type: Type, shape: tuple[int, ...], block: Block, table: np.ndarray | None = None):
        """Describe an array in memory that no statement of the program fills yet and no other buffer contains.

        Args:
            kind: what fills the array: "input", "scratch", "table" or "carried".
            type: the type of its numbers.
            shape: the shape of one run's array.
            block: the block of the program that fills the array.
            table: the numbers of a "table", which all runs share; None for other kinds.
        """
        self.kind, self.type, self.shape, self.block, self.table = kind, type, shape, block, table
        self.stores: list[Store] = []  # statements that fill it
        self.inside: tuple[Buffer, int] | None = None  # the buffer that it is a part of, and from which entry on
        self.parts: list[Buffer] = []  # buffers inside it
        self.first: list[int] = []  # for each entry of a row the first entry with the same number; empty if all differ

    def place_buffer_inside(self, inner: "Buffer", start: int) -> None:
        """Let another buffer be the part of this one from entry `start` on, so that filling it fills this one."""
        inner.inside = self, start
        self.parts.append(inner)

    @property
    def owner(self) -> "tuple[Buffer, int]":
        """Return the outermost buffer that this one lies in, and this one's offset in it.

        `inside` is the pair of the buffer that directly contains this one, and the offset there. It is None if this
        buffer has memory of its own, and the answer is then the buffer itself and 0.
        """
        if self.inside is None:
            return self, 0
        whole, start = self.inside[0].owner
        return whole, start + self.inside[1]

    @property
    def size(self) -> int:
        """Return the count of numbers of one run."""
        return math.prod(self.shape)


class Store:
    """buffer[offset + sum strides * indices] = node."""

    __slots__ = ("block", "buffer", "indices", "node", "offset", "strides")

    def __init__(
        self, block: Block, buffer: Buffer, node: Node, offset: int, strides: Sequence[int], indices: Sequence[Node]
    ):
        """Make the statement buffer[offset + sum strides * indices] = node, which stands in `block`."""
        self.block, self.buffer, self.node, self.offset = block, buffer, node, offset
        self.strides, self.indices = tuple(strides), tuple(indices)


class Loop:
    """A body that is repeated: `length` times, or while any run's condition holds (then `length` is None).

    Of ANY_LENGTH are the loops of a scan over rows, whose code reads the number of iterations when it is called.
    `parameters` stand for the carry in the body, `initial` and `following` for the carry before and after an iteration,
    `results` for the carry after the last one. `counter` counts the iterations from 0. `block` is the enclosing block.
    """

    __slots__ = ("block", "body", "condition", "counter", "following", "initial", "length", "parameters", "results")

    def __init__(self, body: Block, length: int | None, initial: Sequence[Node]):
        """Make a loop whose body is the block `body`.

        `length` is the number of iterations, None if a condition ends the loop. `initial` holds the carried numbers
        before the first iteration. The other lists have an entry for each carried number, and are filled later.
        """
        self.body, self.length, self.initial = body, length, list(initial)
        self.block: Block = body.parent  # type: ignore[assignment]
        body.owner = self
        self.parameters: list[Node] = []  # carried numbers at the beginning of an iteration
        self.following: list[Node] = []  # carried numbers at the end of an iteration
        self.results: list[Node] = []  # carried numbers after the last iteration
        self.condition: Node | None = None  # the loop goes on while it holds; None if `length` is known
        self.counter: Node | None = None  # the number of the iteration; None if nothing uses it


class LoopExit:
    """Exit of a loop that ends by a condition, at this place of its body: taken if the condition holds in no run."""

    __slots__ = ("loop",)

    def __init__(self, loop: Loop):
        """Hold the loop that is left here once its condition holds in no run."""
        self.loop = loop


class Guard:
    """A block that is computed only if `condition` holds for some run, like an "if" without an "else".

    `values` are the block's numbers that are used outside, and `results` stand for them there: zeros if it is skipped.
    """

    __slots__ = ("block", "body", "condition", "results", "values")

    def __init__(self, body: Block, condition: Node):
        """Make the statement that computes the block `body` if `condition`, a flag, holds in some run."""
        self.body, self.condition = body, condition
        self.block: Block = body.parent  # type: ignore[assignment]
        body.owner = self
        self.values: list[Node] = []  # nodes of the body whose values are used outside
        self.results: list[Node] = []  # for each of them the node that stands for it outside: 0 if the body is skipped
