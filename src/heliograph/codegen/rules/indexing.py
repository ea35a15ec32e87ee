"""Rules of gather and scatter at known places, or at one of a few places that data select."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.extend.core import JaxprEqn
from jax.lax import GatherScatterMode

from heliograph.codegen.lowering import RULES, Lowering, Rule, known_integers, type_of
from heliograph.codegen.memory import contiguous
from heliograph.codegen.nodes import Unsupported
from heliograph.codegen.rules.elementwise import select
from heliograph.codegen.rules.loops import in_memory
from heliograph.codegen.rules.shapes import FEW, chosen
from heliograph.codegen.rules.views import clamped


def _places(
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
    if not clips:
        base = np.where(inside, base, -1 - int(np.prod(shape, dtype=np.int64)))
    # Offsets of the entries of a window from its corner.
    left = [a for a in range(len(shape)) if a not in removed]
    offsets = np.zeros([sizes[a] for a in left], dtype=np.int64)
    for position, a in enumerate(left):
        offsets += strides[a] * np.arange(sizes[a]).reshape([-1 if p == position else 1 for p in range(len(left))])
    places = np.reshape(base, (*base.shape, *[1] * offsets.ndim)) + offsets
    return np.maximum(places, -1)


def _clips(mode: Any) -> bool:
    return mode in (GatherScatterMode.CLIP, GatherScatterMode.PROMISE_IN_BOUNDS)


def _gather(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    x, indices = inputs
    at = known_integers(indices)
    if at is None:
        return [_by_cases(lowering, equation, x, indices)]
    # Places in the flat array, with the axes of windows where the result has them.
    params, numbers = equation.params, equation.params["dimension_numbers"]
    batching = list(zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True))
    removed = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    places = _places(
        x.shape, params["slice_sizes"], at, numbers.start_index_map, batching, removed, _clips(params["mode"])
    )
    first = at.ndim - 1
    places = np.moveaxis(places, range(first, places.ndim), numbers.offset_dims)
    flat = x.ravel()
    # Places outside read one more entry, the fill value.
    if np.any(places < 0):
        missing, aval = params["fill_value"], equation.outvars[0].aval
        dtype = aval.dtype  # type: ignore[attr-defined]
        missing = (np.nan if dtype.kind == "f" else np.iinfo(dtype).min) if missing is None else missing
        flat = np.append(flat, lowering.known(np.full((), missing, dtype)))
    gathered: np.ndarray = flat[places]
    return [gathered]


def _by_cases(lowering: Lowering, equation: JaxprEqn, x: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Gather at indices (..., axis) that depend on data: one gather for each possible value, then a selection.

    Each entry is selected by the index of its own row alone, so that rows of many nodes need no more cases than one.
    """
    numbers, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
    column = next(j for j in range(indices.shape[-1]) if known_integers(indices[..., j]) is None)
    axis = numbers.start_index_map[column]
    last = x.shape[axis] - sizes[axis]
    if last >= FEW:
        return _from_memory(lowering, equation, x, indices, column)
    cases = [_gather(lowering, equation, [x, _with(lowering, indices, column, n)])[0] for n in range(last + 1)]
    selected = cases[-1].copy()
    for entry in np.ndindex(*selected.shape):
        which = indices[(*_row(entry, numbers), column)]
        if which.op != "constant":
            here = [np.array(case[entry], dtype=object) for case in cases]
            selected[entry] = chosen(lowering.graph, which, here)[()]
    return selected


def _from_memory(lowering: Lowering, equation: JaxprEqn, x: np.ndarray, indices: np.ndarray, column: int) -> np.ndarray:
    """Gather from memory if there are many places: each entry is loaded at an offset by its row's index."""
    numbers, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
    axis = numbers.start_index_map[column]
    begin = _with(lowering, indices, column, 0)
    if known_integers(begin) is None:
        raise Unsupported("gather at two places that data decide")
    starts = _gather(lowering, equation, [np.arange(x.size, dtype=object).reshape(x.shape), begin])[0]
    buffer, stride = in_memory(lowering, x).buffer, contiguous(x.shape)[axis]
    loaded = np.empty(starts.shape, dtype=object)
    for entry in np.ndindex(*loaded.shape):
        first = clamped(lowering, indices[(*_row(entry, numbers), column)], x.shape[axis] - sizes[axis])
        if isinstance(first, int):
            loaded[entry] = x.ravel()[starts[entry]]
        else:
            loaded[entry] = lowering.graph.load(buffer, int(starts[entry]), (stride,), (first,))
    return loaded


def _with(lowering: Lowering, indices: np.ndarray, column: int, number: int) -> np.ndarray:
    """Replace the indices that depend on data by a number."""
    replaced = indices.copy()
    for row in np.ndindex(*indices.shape[:-1]):
        node = indices[(*row, column)]
        if node.op != "constant":
            replaced[(*row, column)] = lowering.graph.constant(number, node.type)
    return replaced


def _row(entry: tuple[int, ...], numbers: Any) -> tuple[int, ...]:
    """Return the row of indices from which an entry of the result is gathered."""
    return tuple(i for axis, i in enumerate(entry) if axis not in numbers.offset_dims)


def _scatter(op: str | None) -> Rule:
    """Make a rule that applies updates one after another; those outside the array are dropped."""

    def rule(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
        x, indices, updates = inputs
        at = known_integers(indices)
        if at is None:
            raise Unsupported(f"{equation.primitive.name} at places that data decide")
        params, numbers = equation.params, equation.params["dimension_numbers"]
        # Places of all updates in the flat array.
        removed = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
        windows = iter(updates.shape[a] for a in numbers.update_window_dims)
        sizes = [1 if a in removed else next(windows) for a in range(x.ndim)]
        batching = list(zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True))
        index_map = numbers.scatter_dims_to_operand_dims
        places = _places(x.shape, sizes, at, index_map, batching, removed, _clips(params["mode"]))
        places = np.moveaxis(places, range(at.ndim - 1, places.ndim), numbers.update_window_dims)
        # Apply the updates in order.
        updated = x.ravel().copy()
        for index, new in zip(places.ravel().tolist(), updates.ravel().tolist(), strict=True):
            if index >= 0:
                updated[index] = new if op is None else lowering.graph.node(op, new.type, updated[index], new)
        return [updated.reshape(x.shape)]

    return rule


SORTED = 20  # integers: those of larger permutations are many comparisons


def _sort(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Sort the integers of a permutation, and what comes with them, by odd-even transposition: without branches."""
    axis, graph = equation.params["dimension"], lowering.graph
    count, kind = inputs[0].shape[axis], type_of(equation.invars[0].aval)
    if equation.params["num_keys"] != 1 or kind[0] not in "iu" or count > SORTED:
        raise Unsupported("sort")
    moved = [np.moveaxis(x, axis, -1).copy() for x in inputs]
    for index in np.ndindex(*moved[0].shape[:-1]):
        rows = [x[index] for x in moved]
        for turn in range(count):
            for i in range(turn % 2, count - 1, 2):
                wrong = graph.node("gt", "bool", rows[0][i], rows[0][i + 1])
                for row in rows:
                    a, b = row[i], row[i + 1]
                    row[i], row[i + 1] = select(graph, wrong, b, a), select(graph, wrong, a, b)
    return [np.moveaxis(x, -1, axis) for x in moved]


RULES |= {
    "gather": _gather, "scatter": _scatter(None), "scatter-add": _scatter("add"), "scatter_add": _scatter("add"),
    "scatter-mul": _scatter("mul"), "scatter_mul": _scatter("mul"), "sort": _sort,
}  # fmt: skip
