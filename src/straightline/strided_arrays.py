"""Arrays in memory as views of a buffer with strides, as NumPy's; numbers are loaded when they are used."""

import math
from collections.abc import Sequence
from itertools import product

import numpy as np

from straightline.graph import Graph
from straightline.nodes import Block, Buffer, Node, Type, Unsupported
from straightline.size_limits import LOADED


class StridedArray:
    """Array with entry (i, j, ...) at offset + sum strides * (i, j, ...) + sum of moves, pairs (stride, node).

    It lies in a buffer, an array in memory of the program that is being written. A node is a number that the program
    computes, and so is known only when it runs.
    """

    __slots__ = ("buffer", "loaded", "moves", "offset", "shape", "strides")

    def __init__(
        self,
        buffer: Buffer,
        shape: tuple[int, ...],
        strides: tuple[int, ...],
        offset: int = 0,
        moves: tuple[tuple[int, Node], ...] = (),
    ):
        """Make the view whose entry (i, j, ...) is buffer[offset + strides . (i, j, ...) + sum_k s_k n_k].

        `moves` holds the pairs (s_k, n_k) of a stride and a node. Data decide a node's value.
        """
        self.buffer, self.shape, self.strides, self.offset, self.moves = buffer, shape, strides, offset, moves
        # The block in which the nodes that load the entries were made, and these nodes; None before they are made.
        self.loaded: tuple[Block, np.ndarray] | None = None

    @classmethod
    def of_whole_buffer(cls, buffer: Buffer) -> "StridedArray":
        """Return the view of a whole buffer."""
        return cls(buffer, buffer.shape, contiguous_strides(buffer.shape))

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
    ) -> "StridedArray":
        """Return another view of the same memory; `offset` and `moves`, pairs (stride, node), add to this view's."""
        return StridedArray(self.buffer, tuple(shape), tuple(strides), self.offset + offset, (*self.moves, *moves))

    def row(self, index: Node | int) -> "StridedArray":
        """Return the view of entry `index` along the first axis.

        A known index is added to the offset. An index that depends on data, a node, becomes a move.
        """
        shape, strides, stride_of_row = self.shape[1:], self.strides[1:], self.strides[0]
        if isinstance(index, int):
            return self.view(shape, strides, offset=stride_of_row * index)
        if index.op == "constant":
            return self.view(shape, strides, offset=stride_of_row * int(index.value))
        return self.view(shape, strides, 0, (stride_of_row, index))

    def get_known_numbers(self) -> np.ndarray:
        """Return the numbers of an array whose buffer is a table, as a NumPy view of the table."""
        assert self.buffer.table is not None
        table = np.ascontiguousarray(self.buffer.table).ravel()[self.offset :]
        # NumPy counts strides in bytes.
        return np.lib.stride_tricks.as_strided(table, self.shape, [s * table.itemsize for s in self.strides])

    def nodes(self, graph: Graph) -> np.ndarray:
        """Return a node for each entry, which loads it; nodes of the open block or one around it are used again.

        Raises:
            Unsupported: the array has more than LOADED numbers.
        """
        if self.loaded is None or self.loaded[0] not in graph.current.list_enclosing_blocks():
            if self.size > LOADED:
                raise Unsupported(f"an array of {self.size} numbers at once")
            self.loaded = graph.current, self._load_entries(graph)
        return self.loaded[1]

    def _load_entries(self, graph: Graph) -> np.ndarray:
        """Return a NumPy array of nodes (operations of the program), each of which loads its entry from memory."""
        strides, indices = [s for s, _ in self.moves], [i for _, i in self.moves]
        nodes = np.empty(self.shape, dtype=object)
        for index in product(*map(range, self.shape)):
            offset = self.offset + sum(s * i for s, i in zip(self.strides, index, strict=True))
            nodes[index] = graph.load(self.buffer, offset, strides, indices)
        return nodes

    def view_in_shape(self, shape: tuple[int, ...]) -> "StridedArray | None":
        """Return a view of the same numbers in another shape, or None if no strides describe it."""
        # Axes that are contiguous in memory are merged, and then split into the axes of the new shape.
        if not self.size:
            return self.view(shape, (0,) * len(shape))
        axes = [(n, s) for n, s in zip(self.shape, self.strides, strict=True) if n != 1]
        strides = _split_axes(_merge_axes(axes), shape)
        return None if strides is None else self.view(shape, strides)


def _merge_axes(axes: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return axes, pairs (length, stride), after merging each axis with the next one where memory allows.

    Two neighbouring axes (n_a, s_a) and (n_b, s_b) with s_a = n_b s_b are the same as one axis (n_a n_b, s_b).
    """
    merged: list[tuple[int, int]] = []  # the last axis first
    for length, stride in reversed(axes):
        if merged:
            next_length, next_stride = merged[-1]
            if stride == next_length * next_stride:
                merged[-1] = length * next_length, next_stride
                continue
        merged.append((length, stride))
    return merged[::-1]


def _split_axes(axes: Sequence[tuple[int, int]], shape: Sequence[int]) -> list[int] | None:
    """Return the strides of an array of this shape whose axes are parts of these ones, in order; None if none are.

    An old axis (6, 1), a pair of length and stride, becomes for the shape (2, 3) the axes (2, 3), (3, 1), whose strides
    are [3, 1]. The new axes are split off the old ones from the last one on. The old ones have as many entries together
    as the shape, and no two of them are contiguous in memory (`_merge_axes`).
    """
    remaining_axes = list(axes)
    left, stride = 1, 0  # entries of the present old axis that are not split off yet, and the stride between them
    strides: list[int] = []  # of the new axes, the last one first
    for length in reversed(shape):
        if length == 1:  # there is no step along it, whatever its stride
            strides.append(0)
            continue
        if left == 1:  # the present old axis is used up: take the one before it, which exists since the sizes agree
            left, stride = remaining_axes.pop()
        if left % length:  # the new axis would reach across two old ones
            return None
        strides.append(stride)
        left, stride = left // length, stride * length
    return strides[::-1]


def contiguous_strides(shape: Sequence[int]) -> tuple[int, ...]:
    """Return the strides of an array of this shape in row-major order: the last axis is innermost."""
    strides = np.cumprod([1, *shape[:0:-1]])[::-1]
    return tuple(int(s) for s in strides[: len(shape)])
