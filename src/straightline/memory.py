"""Arrays in memory: a view of a buffer with strides, as NumPy's, whose numbers are loaded when they are used."""

import math
from collections.abc import Sequence
from itertools import product

import numpy as np

from straightline.graph import Graph
from straightline.limits import LOADED
from straightline.nodes import Block, Buffer, Node, Type, Unsupported


class InMemory:
    """Array with entry (i, j, ...) at offset + sum strides * (i, j, ...) + sum of moves, pairs (stride, node)."""

    __slots__ = ("buffer", "loaded", "moves", "offset", "shape", "strides")

    def __init__(
        self,
        buffer: Buffer,
        shape: tuple[int, ...],
        strides: tuple[int, ...],
        offset: int = 0,
        moves: tuple[tuple[int, Node], ...] = (),
    ):
        self.buffer, self.shape, self.strides, self.offset, self.moves = buffer, shape, strides, offset, moves
        self.loaded: tuple[Block, np.ndarray] | None = None  # and the block from which it may be used

    @classmethod
    def whole(cls, buffer: Buffer) -> "InMemory":
        """Return the view of a whole buffer."""
        return cls(buffer, buffer.shape, contiguous(buffer.shape))

    @property
    def ndim(self) -> int:
        """Return the number of axes."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """Return the number of entries."""
        return math.prod(self.shape)

    @property
    def type(self) -> Type:
        """Return the type of its numbers."""
        return self.buffer.type

    def view(
        self, shape: Sequence[int], strides: Sequence[int], offset: int = 0, *moves: tuple[int, Node]
    ) -> "InMemory":
        """Return another view of the same memory, at a further offset."""
        return InMemory(self.buffer, tuple(shape), tuple(strides), self.offset + offset, (*self.moves, *moves))

    def row(self, index: Node | int) -> "InMemory":
        """Return entry `index` along the first axis."""
        if isinstance(index, int) or index.op == "constant":
            known = index if isinstance(index, int) else int(index.value)
            return self.view(self.shape[1:], self.strides[1:], self.strides[0] * known)
        return self.view(self.shape[1:], self.strides[1:], 0, (self.strides[0], index))

    def numbers(self) -> np.ndarray:
        """Return the numbers of a known array."""
        assert self.buffer.table is not None
        table = np.ascontiguousarray(self.buffer.table).ravel()[self.offset :]
        return np.lib.stride_tricks.as_strided(table, self.shape, [s * table.itemsize for s in self.strides])

    def nodes(self, graph: Graph) -> np.ndarray:
        """Return a node for each entry, which loads it: once in a block, for the blocks inside it too."""
        if self.loaded is None or self.loaded[0] not in graph.current.inwards():
            if self.size > LOADED:
                raise Unsupported(f"an array of {self.size} numbers at once")
            self.loaded = graph.current, self._load(graph)
        return self.loaded[1]

    def _load(self, graph: Graph) -> np.ndarray:
        """Return a node for each entry, which loads it."""
        strides, indices = [s for s, _ in self.moves], [i for _, i in self.moves]
        nodes = np.empty(self.shape, dtype=object)
        for index in product(*map(range, self.shape)):
            offset = self.offset + sum(s * i for s, i in zip(self.strides, index, strict=True))
            nodes[index] = graph.load(self.buffer, offset, strides, indices)
        return nodes

    def reshaped(self, shape: tuple[int, ...]) -> "InMemory | None":
        """Return the same numbers in another shape, None if no strides describe it."""
        if not self.size:
            return self.view(shape, (0,) * len(shape))
        axes = [(n, s) for n, s in zip(self.shape, self.strides, strict=True) if n != 1]
        strides: list[int] = []
        # New axes are split off old ones, from the last on; old axes that lie contiguously are merged. `axis`: the next
        # old axis to split; `left`, `base`: entries of the present one that are not used yet, and their stride.
        axis, left = len(axes) - 1, 1
        base = 1
        for n in reversed(shape):
            if n == 1:
                strides.append(0)
                continue
            # The next old axis, with those that go on from it.
            if left == 1:
                if axis < 0:
                    return None
                left, base = axes[axis]
                axis -= 1
                while left % n and axis >= 0 and axes[axis][1] == axes[axis + 1][0] * axes[axis + 1][1]:
                    left *= axes[axis][0]
                    axis -= 1
            while left < n and axis >= 0 and axes[axis][1] == base * left:
                left *= axes[axis][0]
                axis -= 1
            # The new axis does not divide what is left.
            if left % n:
                return None
            strides.append(base)
            left, base = left // n, base * n
        return self.view(shape, strides[::-1]) if left == 1 and axis < 0 else None


def contiguous(shape: Sequence[int]) -> tuple[int, ...]:
    """Return the strides of an array whose last axis is innermost."""
    strides = np.cumprod([1, *shape[:0:-1]])[::-1]
    return tuple(int(s) for s in strides[: len(shape)])
