"""Rules of scatter: updates of an array at known indices, or at indices that data select."""

import math
from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from jax.extend.core import JaxprEqn
from jax.lax import GatherScatterMode

from straightline.graph import Graph
from straightline.lowering import RULES, Lowering, Rule, known_integers
from straightline.nodes import Node, Unsupported
from straightline.rules.elementwise import select
from straightline.rules.index_bounds import convert_to_32_bits, fills_outside, find_window_indices
from straightline.size_limits import WRITTEN_OUT


def _make_scatter_rule(op: str | None) -> Rule:
    """Return the rule of a scatter: updates are combined with an array's entries by `op`, or replace them if None.

    A rule lowers one primitive of JAX: arrays of graph nodes (one node for each number) go in, and such arrays come
    out. A scatter writes windows (blocks) of updates into an array at given indices.
    """

    def scatter_updates(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
        """Return the array after all updates, in order; indices beyond it are dropped or clipped.

        The inputs are the array, the indices (..., k) of the windows' starts, and the updates, one window each.
        """
        x, indices, updates = inputs
        numbers = equation.params["dimension_numbers"]
        indices = convert_to_32_bits(lowering, indices) if fills_outside(equation) else indices
        # `removed`: axes of the array that a window lacks; it has size 1 along them. `sizes`: its size along each axis.
        removed = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
        window_lengths = iter(updates.shape[axis] for axis in numbers.update_window_dims)
        sizes = [1 if axis in removed else next(window_lengths) for axis in range(x.ndim)]
        known = known_integers(indices)
        if known is None:  # data decide where the updates land
            return [_scatter_by_cases(lowering, equation, op, inputs, indices, sizes)]
        # Places of all updates in the flat array, -1 outside. They have the windows' own axes last; these are moved to
        # where the updates have them, so that both are in the same order.
        batching = list(zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True))
        index_map = numbers.scatter_dims_to_operand_dims
        flat_indices = find_window_indices(
            x.shape, sizes, known, index_map, batching, removed, _clips_indices(equation)
        )
        flat_indices = np.moveaxis(flat_indices, range(known.ndim - 1, flat_indices.ndim), numbers.update_window_dims)
        updated = x.ravel().copy()
        for target, new in zip(flat_indices.ravel().tolist(), updates.ravel().tolist(), strict=True):
            if target >= 0:
                updated[target] = _combine_entry(lowering.graph, op, updated[target], new)
        return [updated.reshape(x.shape)]

    return scatter_updates


def _clips_indices(equation: JaxprEqn) -> bool:
    """Return whether a scatter moves windows that reach beyond the array into it; in other modes it drops them."""
    return bool(equation.params["mode"] == GatherScatterMode.CLIP)


def _combine_entry(graph: Graph, op: str | None, old: Any, new: Any) -> Any:
    """Return the node of `old op new`, such as a sum; where `op` is None, `new` replaces the old number."""
    return new if op is None else graph.node(op, new.type, old, new)


def _scatter_by_cases(
    lowering: Lowering,
    equation: JaxprEqn,
    op: str | None,
    inputs: list[np.ndarray],
    indices: np.ndarray,
    sizes: list[int],
) -> np.ndarray:
    """Scatter at indices that data decide: each entry that an update may change becomes a choice of new and old number.

    A scatter writes windows (blocks of numbers) of `updates` into an array. Native code has no address that depends on
    data here, so every index at which a window may start is tried: an entry gets the new number if the window does
    start where that puts it there.

    Args:
        lowering: the program that is being written, a graph with a node for each number.
        equation: JAX's scatter, whose parameters say which axes are a window's.
        op: combines an old and a new number; None where the new one replaces the old.
        inputs: the array, the indices as JAX has them (not used), and the updates.
        indices: nodes (..., k) of the windows' starts.
        sizes: size of a window along each axis of the array.

    Returns:
        The array after all updates.
    """
    (x, _indices, updates), numbers, graph = inputs, equation.params["dimension_numbers"], lowering.graph
    removed = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
    window_axes = [a for a in range(x.ndim) if a not in removed]
    # The updates with the axes of the indices first, then those of a window: windows[row] is the window of one index.
    along = numbers.update_window_dims
    windows = np.moveaxis(updates, along, range(updates.ndim - len(along), updates.ndim))
    updated, count = x.copy(), 0  # count: number of choices of new or old; above WRITTEN_OUT is refused
    for row in np.ndindex(*indices.shape[:-1]):
        for start, is_here in _yield_starts(graph, equation, x.shape, sizes, row, indices[row]):
            count += math.prod(sizes)
            if count > WRITTEN_OUT:
                raise Unsupported(f"{equation.primitive.name} at one of many places that data decide")
            for entry in np.ndindex(*windows.shape[len(row) :]):
                target = list(start)
                for axis, offset in zip(window_axes, entry, strict=True):
                    target[axis] += offset
                old = updated[tuple(target)]
                new = _combine_entry(graph, op, old, windows[row + entry])
                updated[tuple(target)] = select(graph, is_here, new, old)
    return updated


def _yield_starts(
    graph: Graph, equation: JaxprEqn, shape: tuple[int, ...], sizes: list[int], row: tuple[int, ...], index: np.ndarray
) -> Iterator[tuple[tuple[int, ...], Node]]:
    """Yield each index where the window of an index may start, and the node of whether it starts there.

    A scatter writes windows of updates into an array, each at an index that is known only when the program runs. So for
    every start where the window fits, a node (a number of the program) says whether the index means that start.

    Args:
        graph: the program.
        equation: the scatter, an operation of JAX.
        shape: shape of the array.
        sizes: length of a window along each axis of the array.
        row: number of the index among all indices, along their leading axes.
        index: nodes of the index, one for each axis of the array that an index selects.
    """
    numbers, clips = equation.params["dimension_numbers"], _clips_indices(equation)
    nodes = dict(zip(numbers.scatter_dims_to_operand_dims, index.tolist(), strict=True))
    batch_axes = dict(zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True))
    # Possible starts along each axis: all that the window fits into, the row's own of a batch, else 0.
    ranges: list[Any] = []
    for axis, size in enumerate(sizes):
        if axis in nodes:
            ranges.append(range(shape[axis] - size + 1))
        else:
            ranges.append([row[batch_axes[axis]] if axis in batch_axes else 0])
    for start in product(*ranges):
        is_here = graph.constant(True, "bool")
        for axis, node in nodes.items():
            last = shape[axis] - sizes[axis]
            if clips and last == 0:  # clipped to the one start there is, so that it starts here in any case
                continue
            # Clipped indices: all up to the first start mean the first, and all from the last one on mean the last.
            comparison = "eq"
            if clips and start[axis] == 0:
                comparison = "le"
            elif clips and start[axis] == last:
                comparison = "ge"
            along_axis = graph.node(comparison, "bool", node, graph.constant(start[axis], node.type))
            is_here = graph.node("and", "bool", is_here, along_axis)
        is_known_to_be_elsewhere = is_here.op == "constant" and not is_here.value
        if not is_known_to_be_elsewhere:
            yield start, is_here


RULES |= {
    "scatter": _make_scatter_rule(op=None), "scatter-sub": _make_scatter_rule("sub"),
    "scatter-add": _make_scatter_rule("add"), "scatter_add": _make_scatter_rule("add"),
    "scatter-mul": _make_scatter_rule("mul"), "scatter_mul": _make_scatter_rule("mul"),
    "scatter-min": _make_scatter_rule("min"), "scatter-max": _make_scatter_rule("max"),
}  # fmt: skip
