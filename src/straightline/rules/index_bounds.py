"""Indices into an array: clamped to it, or outside, where a gather fills and a scatter drops."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import JaxprEqn
from jax.lax import GatherScatterMode

from straightline.graph import Graph
from straightline.lowering import Lowering, arrange_nodes
from straightline.nodes import Node, Unsupported
from straightline.strided_arrays import contiguous_strides


def clamp_start(lowering: Lowering, start: Node, last: int) -> Node | int:
    """Return the start of a window, moved into the range from 0 to `last`, the last one at which the window fits.

    It is a number if the start is a constant, else a node (an operation of the program) of type i64.
    """
    if last == 0:
        return 0
    if start.op == "constant":
        return min(max(int(start.value), 0), last)
    graph = lowering.graph
    if start.type[0] == "u":  # an unsigned number may be too large for i64
        start = graph.node("min", start.type, start, graph.constant(last, start.type))
    index = graph.node("convert", "i64", start)
    at_least_zero = graph.node("max", "i64", index, graph.constant(0, "i64"))
    return graph.node("min", "i64", at_least_zero, graph.constant(last, "i64"))


def is_inside(graph: Graph, start: Node, last: int) -> Node:
    """Return the node of the flag 0 <= start <= last, computed when the program runs.

    `start` may be of any integer type; an unsigned number needs no test against 0.
    """
    is_at_most_last = graph.node("le", "bool", start, graph.constant(last, start.type))
    if start.type[0] == "u":
        return is_at_most_last
    is_at_least_zero = graph.node("ge", "bool", start, graph.constant(0, start.type))
    return graph.node("and", "bool", is_at_most_last, is_at_least_zero)


def fills_outside(equation: JaxprEqn) -> bool:
    """Return whether a gather fills what is outside of the array with a value, and a scatter drops it."""
    return bool(equation.params["mode"] == GatherScatterMode.FILL_OR_DROP)


def convert_to_32_bits(lowering: Lowering, indices: np.ndarray) -> np.ndarray:
    """Return indices, an array of nodes, converted to 32 bits with a sign, as JAX does where they may be outside."""
    nodes = [lowering.graph.node("convert", "i32", n) for n in indices.ravel().tolist()]
    return arrange_nodes(nodes, indices.shape)


def make_fill_value(lowering: Lowering, equation: JaxprEqn) -> Node:
    """Return the node of the value that a gather takes for entries outside the array.

    Random keys have no such value, and raise Unsupported.
    """
    aval: Any = equation.outvars[0].aval
    if jax.numpy.issubdtype(aval.dtype, jax.dtypes.prng_key):
        raise Unsupported("a key of random numbers in place of one that is not there")
    return lowering.get_only_node(lowering.make_known_array(np.full((), equation.params["fill_value"], aval.dtype)))


def find_window_indices(
    shape: tuple[int, ...],
    sizes: Sequence[int],
    indices: np.ndarray,
    index_map: Sequence[int],
    batching: Sequence[tuple[int, int]],
    removed: Sequence[int],
    clips: bool,
) -> np.ndarray:
    """Return the index of each entry of each window in a flat array, -1 outside.

    Args:
        shape: of the array, whose entries are in row-major order.
        sizes: of a window, along each axis of the array.
        indices: first entry of each window (..., k), a number for each of some axes of the array.
        index_map: for each of these numbers its axis of the array; a window starts at 0 along all other axes.
        batching: pairs of an axis of the array and an axis of `indices`: the windows at index i along the second axis
            start at i along the first one.
        removed: axes of the array, along which windows have the size 1, that the result does not have.
        clips: whether a window that is not inside is moved inside; else all its indices are -1.

    Returns:
        Indices, with the axes of the indices but the last, then those of a window.
    """
    # First entry of each window, axis by axis of the array.
    starts = np.zeros((*indices.shape[:-1], len(shape)), dtype=np.int64)
    for k, axis in enumerate(index_map):
        starts[..., axis] = indices[..., k]
    for axis, along in batching:
        count = np.arange(indices.shape[along])
        starts[..., axis] = count.reshape([-1 if a == along else 1 for a in range(indices.ndim - 1)])
    # Its index in row-major order.
    last_starts = np.array(shape) - np.array(sizes)  # along each axis the last start of a window that is inside
    inside = np.all((starts >= 0) & (starts <= last_starts), axis=-1)
    strides = np.array(contiguous_strides(shape), dtype=np.int64)
    first_indices = np.sum(np.clip(starts, 0, last_starts) * strides, axis=-1)
    if not clips:  # so far below 0 that adding an offset, at most the array's size - 1, leaves it below 0
        first_indices = np.where(inside, first_indices, -1 - int(np.prod(shape, dtype=np.int64)))
    # Offsets of a window's entries from its first one: the sum over its axes of stride times number along the axis.
    window_axes = [a for a in range(len(shape)) if a not in removed]
    offsets = np.zeros([sizes[a] for a in window_axes], dtype=np.int64)
    for position, a in enumerate(window_axes):
        along_axis = [-1 if p == position else 1 for p in range(len(window_axes))]
        offsets += strides[a] * np.arange(sizes[a]).reshape(along_axis)
    # Each window's first index plus each offset: the indices have the axes of the windows, then those within a window.
    flat_indices = np.reshape(first_indices, (*first_indices.shape, *[1] * offsets.ndim)) + offsets
    return np.maximum(flat_indices, -1)
