"""Rules of scatter: updates of an array at known places, or at places that data select."""

import math
from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from jax.extend.core import JaxprEqn
from jax.lax import GatherScatterMode

from straightline.graph import Graph
from straightline.limits import WRITTEN_OUT
from straightline.lowering import RULES, Lowering, Rule, known_integers
from straightline.nodes import Node, Unsupported
from straightline.rules.elementwise import select
from straightline.rules.places import fills, narrowed, places_of


def _scatter(op: str | None) -> Rule:
    """Make a rule that applies updates one after another; those outside the array are dropped."""

    def rule(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
        """Combine each update with the entry at its place, in order; places beyond the array are dropped or clipped."""
        x, indices, updates = inputs
        numbers = equation.params["dimension_numbers"]
        indices = narrowed(lowering, indices) if fills(equation) else indices
        # Axes that a window does not have, and its size along all others.
        removed = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
        windows = iter(updates.shape[a] for a in numbers.update_window_dims)
        sizes = [1 if a in removed else next(windows) for a in range(x.ndim)]
        at = known_integers(indices)
        if at is None:
            return [_scatter_by_cases(lowering, equation, op, inputs, indices, sizes)]
        # Places of all updates in the flat array, which are applied in order.
        batching = list(zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True))
        index_map = numbers.scatter_dims_to_operand_dims
        places = places_of(x.shape, sizes, at, index_map, batching, removed, _clips(equation))
        places = np.moveaxis(places, range(at.ndim - 1, places.ndim), numbers.update_window_dims)
        updated = x.ravel().copy()
        for index, new in zip(places.ravel().tolist(), updates.ravel().tolist(), strict=True):
            if index >= 0:
                updated[index] = _combined(lowering.graph, op, updated[index], new)
        return [updated.reshape(x.shape)]

    return rule


def _clips(equation: JaxprEqn) -> bool:
    return bool(equation.params["mode"] == GatherScatterMode.CLIP)


def _combined(graph: Graph, op: str | None, old: Any, new: Any) -> Any:
    return new if op is None else graph.node(op, new.type, old, new)


def _scatter_by_cases(
    lowering: Lowering,
    equation: JaxprEqn,
    op: str | None,
    inputs: list[np.ndarray],
    indices: np.ndarray,
    sizes: list[int],
) -> np.ndarray:
    """Apply each update at every place that it may have, where its index is that of the place."""
    (x, _, updates), numbers, graph = inputs, equation.params["dimension_numbers"], lowering.graph
    removed = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
    left = [a for a in range(x.ndim) if a not in removed]
    # Updates as rows of windows: (index, window).
    along = numbers.update_window_dims
    windows = np.moveaxis(updates, along, range(updates.ndim - len(along), updates.ndim))
    updated, count = x.copy(), 0
    for row in np.ndindex(*indices.shape[:-1]):
        for start, here in _yield_starts(graph, equation, x.shape, sizes, row, indices[row]):
            count += math.prod(sizes)
            if count > WRITTEN_OUT:
                raise Unsupported(f"{equation.primitive.name} at one of many places that data decide")
            for entry in np.ndindex(*windows.shape[len(row) :]):
                place = list(start)
                for axis, offset in zip(left, entry, strict=True):
                    place[axis] += offset
                old = updated[tuple(place)]
                updated[tuple(place)] = select(graph, here, _combined(graph, op, old, windows[row + entry]), old)
    return updated


def _yield_starts(
    graph: Graph, equation: JaxprEqn, shape: tuple[int, ...], sizes: list[int], row: tuple[int, ...], index: np.ndarray
) -> Iterator[tuple[tuple[int, ...], Node]]:
    """Yield each place where a window may start, and whether it starts there."""
    numbers, clips = equation.params["dimension_numbers"], _clips(equation)
    nodes = dict(zip(numbers.scatter_dims_to_operand_dims, index.tolist(), strict=True))
    fixed = dict(zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True))
    ranges = []
    for axis, size in enumerate(sizes):
        last = shape[axis] - size
        ranges.append(range(last + 1) if axis in nodes else [row[fixed[axis]] if axis in fixed else 0])
    for start in product(*ranges):
        here = graph.constant(True, "bool")
        for axis, node in nodes.items():
            last = shape[axis] - sizes[axis]
            if clips and not last:
                continue
            op = "eq" if not clips or 0 < start[axis] < last else "ge" if start[axis] else "le"
            is_there = graph.node(op, "bool", node, graph.constant(start[axis], node.type))
            here = graph.node("and", "bool", here, is_there)
        if here.op != "constant" or here.value:
            yield start, here


RULES |= {
    "scatter": _scatter(None), "scatter-add": _scatter("add"), "scatter_add": _scatter("add"),
    "scatter-mul": _scatter("mul"), "scatter_mul": _scatter("mul"), "scatter-sub": _scatter("sub"),
    "scatter-min": _scatter("min"), "scatter-max": _scatter("max"),
}  # fmt: skip
