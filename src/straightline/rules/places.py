"""Places in an array that indices select: clamped to it, or outside, where a gather fills and a scatter drops."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import JaxprEqn
from jax.lax import GatherScatterMode

from straightline.graph import Graph
from straightline.lowering import Lowering, array_of
from straightline.memory import contiguous
from straightline.nodes import Node, Unsupported


def clamp_place(lowering: Lowering, start: Node, last: int) -> Node | int:
    """Clamp a place between 0 and the last one."""
    if last == 0:
        return 0
    if start.op == "constant":
        return min(max(int(start.value), 0), last)
    graph = lowering.graph
    if start.type[0] == "u":  # above all that is signed there may be more
        start = graph.node("min", start.type, start, graph.constant(last, start.type))
    wide = graph.node("convert", "i64", start)
    return graph.node(
        "min", "i64", graph.node("max", "i64", wide, graph.constant(0, "i64")), graph.constant(last, "i64")
    )


def inside(graph: Graph, start: Node, last: int) -> Node:
    """Return whether a place is one of 0 ... last."""
    below = graph.node("le", "bool", start, graph.constant(last, start.type))
    if start.type[0] == "u":
        return below
    return graph.node("and", "bool", below, graph.node("ge", "bool", start, graph.constant(0, start.type)))


def fills(equation: JaxprEqn) -> bool:
    """Return whether a gather fills what is outside of the array with a value, and a scatter drops it."""
    return bool(equation.params["mode"] == GatherScatterMode.FILL_OR_DROP)


def narrowed(lowering: Lowering, indices: np.ndarray) -> np.ndarray:
    """Convert indices that may be outside to 32 bits with a sign, as JAX does."""
    nodes = [lowering.graph.node("convert", "i32", n) for n in indices.ravel().tolist()]
    return array_of(nodes, indices.shape)


def fill_of(lowering: Lowering, equation: JaxprEqn) -> Node:
    """Return the value in place of what is outside."""
    aval: Any = equation.outvars[0].aval
    if jax.numpy.issubdtype(aval.dtype, jax.dtypes.prng_key):
        raise Unsupported("a key of random numbers in place of one that is not there")
    return lowering.scalar(lowering.known(np.full((), equation.params["fill_value"], aval.dtype)))


def find_window_places(
    shape: tuple[int, ...],
    sizes: Sequence[int],
    indices: np.ndarray,
    index_map: Sequence[int],
    batching: Sequence[tuple[int, int]],
    removed: Sequence[int],
    clips: bool,
) -> np.ndarray:
    """Return for each index (...) and entry of its window (...) the place in an array of this shape; -1 outside.

    `index_map`: the array's axis for each number of an index; `batching`: pairs of an axis of the array and one of the
    indices that correspond; `removed`: axes that a window does not have.
    """
    # First corner of each window, axis by axis.
    starts = np.zeros((*indices.shape[:-1], len(shape)), dtype=np.int64)
    for k, axis in enumerate(index_map):
        starts[..., axis] = indices[..., k]
    for axis, along in batching:
        count = np.arange(indices.shape[along])
        starts[..., axis] = count.reshape([-1 if a == along else 1 for a in range(indices.ndim - 1)])
    # Place of the corner in row-major order; corners are clipped or marked as outside.
    last = np.array(shape) - np.array(sizes)
    inside = np.all((starts >= 0) & (starts <= last), axis=-1)
    strides = np.array(contiguous(shape), dtype=np.int64)
    base = np.sum(np.clip(starts, 0, last) * strides, axis=-1)
    if not clips:  # so far below 0 that all of the window is
        base = np.where(inside, base, -1 - int(np.prod(shape, dtype=np.int64)))
    # Offsets of the entries of a window from its corner.
    axes = [a for a in range(len(shape)) if a not in removed]
    offsets = np.zeros([sizes[a] for a in axes], dtype=np.int64)
    for position, a in enumerate(axes):
        offsets += strides[a] * np.arange(sizes[a]).reshape([-1 if p == position else 1 for p in range(len(axes))])
    places = np.reshape(base, (*base.shape, *[1] * offsets.ndim)) + offsets
    return np.maximum(places, -1)
