"""Rule of gather at known indices, or at indices that data select."""

from functools import lru_cache
from typing import Any

import numpy as np
from jax.extend.core import JaxprEqn
from jax.lax import GatherDimensionNumbers

from straightline.lowering import RULES, Lowering, known_integers
from straightline.nodes import Unsupported
from straightline.rules.elementwise import select
from straightline.rules.index_bounds import (
    clamp_start,
    convert_to_32_bits,
    fills_outside,
    find_window_indices,
    is_inside,
    make_fill_value,
)
from straightline.rules.loops import put_in_memory
from straightline.rules.shapes import select_array
from straightline.size_limits import FEW
from straightline.strided_arrays import contiguous_strides


def _gather(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Lower `gather`: return the windows of x that begin at the rows of `indices`.

    An index is clipped so that its window lies inside x. If the operation's mode is to fill, the entries of a window
    that is not inside are a fill value instead.
    """
    x, indices = inputs
    if not fills_outside(equation):
        return [_gather_clipped(equation, lowering, x, indices)]
    indices = convert_to_32_bits(lowering, indices)
    is_inside_by_row, fill_value = _is_inside(lowering, equation, x.shape, indices), make_fill_value(lowering, equation)
    gathered, numbers = _gather_clipped(equation, lowering, x, indices), equation.params["dimension_numbers"]
    for entry in np.ndindex(*gathered.shape):
        is_entry_inside = is_inside_by_row[_find_index_row(entry, numbers)]
        gathered[entry] = select(lowering.graph, is_entry_inside, gathered[entry], fill_value)
    return [gathered]


def _is_inside(lowering: Lowering, equation: JaxprEqn, shape: tuple[int, ...], indices: np.ndarray) -> np.ndarray:
    """Return for each row of indices the node of a flag: whether its window lies inside an array of this shape.

    A node is an operation of the program, since data may decide an index. A row holds the window's first index along
    each axis of `start_index_map`. `slice_sizes` is the window's shape.
    """
    axes, sizes = equation.params["dimension_numbers"].start_index_map, equation.params["slice_sizes"]
    flags = np.full(indices.shape[:-1], lowering.graph.constant(True, "bool"), dtype=object)
    for row in np.ndindex(*flags.shape):
        for axis, start in zip(axes, indices[row], strict=True):
            is_inside_along_axis = is_inside(lowering.graph, start, last=shape[axis] - sizes[axis])
            so_far: Any = flags[row]
            flags[row] = lowering.graph.node("and", "bool", so_far, is_inside_along_axis)
    return flags


def _gather_clipped(equation: JaxprEqn, lowering: Lowering, x: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Return the windows of x at `indices`, which are clipped so that each window lies inside x.

    If all indices are known, the result consists of nodes of x. Else an index that depends on data is compared with
    all indices.
    """
    known = known_integers(indices)
    if known is None:
        return _gather_by_cases(lowering, equation, x, indices)
    sizes, numbers = tuple(equation.params["slice_sizes"]), equation.params["dimension_numbers"]
    flat_indices = _find_gathered_indices(x.shape, sizes, known.tobytes(), known.shape, numbers)
    gathered: np.ndarray = x.ravel()[flat_indices.ravel()].reshape(flat_indices.shape)
    return gathered


@lru_cache(1000)
def _find_gathered_indices(
    shape: tuple[int, ...], sizes: tuple[int, ...], indices: bytes, of: tuple[int, ...], numbers: GatherDimensionNumbers
) -> np.ndarray:
    """Return which entries of the flat array a gather of JAX takes at known indices, as an array of the result's shape.

    The result has the axes of the indices but the last, with a window's axes (`numbers.offset_dims`) among them. The
    answer is cached, since a filter makes each gather a dozen times; so all arguments have a hash.

    Args:
        shape: of the array, whose entries are in row-major order.
        sizes: of a window, along each axis of the array.
        indices: the bytes of the int64 array of indices, whose last axis has the start of a window.
        of: shape of that array.
        numbers: JAX's description of which axes are which.
    """
    known = np.frombuffer(indices, dtype=np.int64).reshape(of)
    batching = list(zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True))
    removed = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    flat_indices = find_window_indices(shape, sizes, known, numbers.start_index_map, batching, removed, clips=True)
    first = known.ndim - 1
    return np.moveaxis(flat_indices, range(first, flat_indices.ndim), numbers.offset_dims)


def _gather_by_cases(lowering: Lowering, equation: JaxprEqn, x: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Return the windows of x at indices (..., k) that data decide: gathered for each possible index, then selected.

    Entry (..., j) is the first index of a window along the array's axis start_index_map[j]. One column j that depends
    on data is replaced by each of its possible values in turn; other such columns are met in these gathers. Each entry
    of the result is selected by the index of its own window alone.
    """
    numbers, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
    column = next(j for j in range(indices.shape[-1]) if known_integers(indices[..., j]) is None)
    axis = numbers.start_index_map[column]
    last_start = x.shape[axis] - sizes[axis]  # at which a window is still inside x
    if last_start >= FEW:
        return _gather_from_memory(lowering, equation, x, indices, column)
    known_cases = [_replace_indices(lowering, indices, column, start) for start in range(last_start + 1)]
    cases = [_gather_clipped(equation, lowering, x, known) for known in known_cases]
    selected = cases[-1].copy()
    for entry in np.ndindex(*selected.shape):
        index = indices[(*_find_index_row(entry, numbers), column)]
        if index.op != "constant":  # where it is known, all cases are the same
            entry_of_cases = [np.array(case[entry], dtype=object) for case in cases]
            selected[entry] = select_array(lowering.graph, index, entry_of_cases)[()]
    return selected


def _gather_from_memory(
    lowering: Lowering, equation: JaxprEqn, x: np.ndarray, indices: np.ndarray, column: int
) -> np.ndarray:
    """Gather from an array put in memory, where one index of each window depends on data and has many values.

    JAX's gather copies windows of an array, each from its own start. The compiler works with single numbers (nodes). If
    an index depends on data, comparing it with all possible values would be long; a load from memory is short.

    Args:
        lowering: the program that is being compiled.
        equation: the gather, with its dimension numbers and window sizes.
        x: nodes of the array's entries.
        indices: nodes of the windows' starts, (..., indexed axes).
        column: the one entry of `indices`' last axis that depends on data; all others are known.

    Returns:
        The gathered nodes.
    """
    numbers, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
    # The array's axis of that index, and the last start at which the window is still inside.
    axis = numbers.start_index_map[column]
    last_start = x.shape[axis] - sizes[axis]
    # Where each gathered number would lie in the flat array if the index that depends on data were 0: take the same
    # gather from an array of the indices 0, 1, 2, ...
    with_zero = _replace_indices(lowering, indices, column, 0)
    if known_integers(with_zero) is None:
        raise Unsupported("gather at two places that data decide")
    flat_indices = np.arange(x.size, dtype=object).reshape(x.shape)
    offsets = _gather_clipped(equation, lowering, flat_indices, with_zero)
    # The number lies behind that one by index times stride of the axis; the index is clamped so that the window stays
    # inside.
    buffer, stride = put_in_memory(lowering, x).buffer, contiguous_strides(x.shape)[axis]
    loaded = np.empty(offsets.shape, dtype=object)
    for entry in np.ndindex(*loaded.shape):
        index = indices[(*_find_index_row(entry, numbers), column)]
        if index.op == "constant":  # its offset is right already, since `_replace_indices` keeps what is known
            loaded[entry] = x.ravel()[offsets[entry]]
        else:
            clamped: Any = clamp_start(lowering, index, last_start)
            loaded[entry] = lowering.graph.load(buffer, int(offsets[entry]), (stride,), (clamped,))
    return loaded


def _replace_indices(lowering: Lowering, indices: np.ndarray, column: int, number: int) -> np.ndarray:
    """Return a copy of the indices in which `number` replaces those of one column that depend on data.

    The column holds the indices along one axis of the array.
    """
    replaced = indices.copy()
    for row in np.ndindex(*indices.shape[:-1]):
        node = indices[(*row, column)]
        if node.op != "constant":
            replaced[(*row, column)] = lowering.graph.constant(number, node.type)
    return replaced


def _find_index_row(entry: tuple[int, ...], numbers: Any) -> tuple[int, ...]:
    """Return the index of the window that an entry of a gather's result comes from.

    The result's axes are those of the windows, with the axes within a window (`numbers.offset_dims`) among them.
    """
    return tuple(i for axis, i in enumerate(entry) if axis not in numbers.offset_dims)


RULES |= {"gather": _gather}
