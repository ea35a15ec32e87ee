"""Rules of operations on arrays in memory that return another view of the same memory."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from jax.extend.core import JaxprEqn

from straightline.lowering import IN_MEMORY, RULES, Lowering, Rule, Value, arrange_nodes, result_shape
from straightline.nodes import Buffer, Node, RandomKey
from straightline.rules.elementwise import PASSED_ON, select
from straightline.rules.index_bounds import clamp_start, convert_to_32_bits, fills_outside, is_inside, make_fill_value
from straightline.rules.loops import copy_in_memory, make_counted_loop, put_in_memory
from straightline.rules.shapes import select_array
from straightline.size_limits import FEW, LOADED, TABLE
from straightline.strided_arrays import StridedArray, contiguous_strides

View = Callable[[StridedArray, Any, tuple[int, ...]], StridedArray | None]


def _make_view_rule(name: str, view: View) -> Rule:
    """Return the rule of an operation on an array in memory, whose result is view(array, parameters, shape).

    A view copies nothing. If no strides describe the result, `view` returns None. The nodes are then loaded, and the
    operation's rule for nodes (RULES[name]) rearranges them.
    """

    def rule(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
        """Return the view of an array in memory; if there is none, its numbers, loaded as nodes and rearranged."""
        array_view = view(inputs[0], equation.params, result_shape(equation))
        if array_view is not None:
            return [array_view]
        return list(RULES[name](lowering, equation, [lowering.nodes(inputs[0])]))

    return rule


def _slice(x: StridedArray, params: Any, shape: tuple[int, ...]) -> StridedArray:
    """Return the view that `slice` takes of an array in memory: from its start by its steps, along each axis."""
    steps = params["strides"] or (1,) * x.ndim
    offset = sum(s * first for s, first in zip(x.strides, params["start_indices"], strict=True))
    return x.view(shape, [s * step for s, step in zip(x.strides, steps, strict=True)], offset)


def _reverse(x: StridedArray, params: Any, shape: tuple[int, ...]) -> StridedArray:
    """Return the view of an array in memory that goes backwards along the operation's axes; nothing is copied."""
    # Begin at the last entry of each such axis, and go by negative strides.
    axes = params["dimensions"]
    offset = sum(x.strides[a] * (x.shape[a] - 1) for a in axes)
    return x.view(shape, [-s if a in axes else s for a, s in enumerate(x.strides)], offset)


def _transpose(x: StridedArray, params: Any, shape: tuple[int, ...]) -> StridedArray:
    """Return the view of an array in memory with its axes in the order of the operation's `permutation`."""
    return x.view(shape, [x.strides[a] for a in params["permutation"]])


def _reshape(x: StridedArray, params: Any, shape: tuple[int, ...]) -> StridedArray | None:
    """Return the view of an array in memory in another shape; None if no strides describe it."""
    return x.view_in_shape(shape)


def _broadcast_view(x: StridedArray, params: Any, shape: tuple[int, ...]) -> StridedArray:
    """Return the view that broadcasts an array in memory: new axes, and axes of length 1, have strides of zero."""
    strides = [0] * len(shape)
    for size, stride, axis in zip(x.shape, x.strides, params["broadcast_dimensions"], strict=True):
        strides[axis] = 0 if size == 1 else stride
    return x.view(shape, strides)


def _split(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Return views of an array in memory, which is split along one axis into parts of the operation's sizes."""
    x, axis, parts, start = inputs[0], equation.params["axis"], [], 0
    for size in equation.params["sizes"]:
        shape = [size if a == axis else n for a, n in enumerate(x.shape)]
        parts.append(x.view(shape, x.strides, x.strides[axis] * start))
        start += size
    return parts


def _lower_dynamic_slice(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Lower `dynamic_slice` of an array in memory to a view, which copies nothing.

    A start that is known is added to the view's offset. A start that depends on data is a move: (stride, its node).
    """
    sizes = equation.params["slice_sizes"]
    x = make_indexable(lowering, inputs[0], inputs[1:])
    if not isinstance(x, StridedArray):
        return list(RULES["dynamic_slice"](lowering, equation, [lowering.nodes(i) for i in inputs]))
    offset, moves = 0, []
    for axis, start in enumerate(inputs[1:]):
        first = clamp_start(lowering, lowering.get_only_node(start), x.shape[axis] - sizes[axis])
        if isinstance(first, int):
            offset += x.strides[axis] * first
        else:
            moves.append((x.strides[axis], first))
    return [x.view(sizes, x.strides, offset, *moves)]


def _dynamic_slice_of_nodes(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[Value]:
    """Return `dynamic_slice` of an array of nodes: slice one axis after another.

    Each start is clamped so that the slice lies inside. If data decide among more than FEW starts, the array is put
    in memory and sliced there.
    """
    x, sizes, starts = inputs[0], equation.params["slice_sizes"], [lowering.get_only_node(x) for x in inputs[1:]]
    for axis, (start, size) in enumerate(zip(starts, sizes, strict=True)):
        last_start = x.shape[axis] - size
        if start.op != "constant" and last_start >= FEW:
            return _lower_dynamic_slice(lowering, equation, [put_in_memory(lowering, inputs[0]), *inputs[1:]])
        x = _slice_window(lowering, x, axis, start, size) if last_start else x  # a slice of all the axis has one start
    return [x]


def _slice_window(lowering: Lowering, x: np.ndarray, axis: int, start: Node, size: int) -> np.ndarray:
    """Return `size` entries of an array of nodes along an axis, from `start` on.

    The start is clamped so that all entries are inside the array. If it depends on data, the entries are selected among
    those of all possible starts.
    """
    last_start: int = x.shape[axis] - size
    along_axis = [(slice(None),) * axis + (slice(first, first + size),) for first in range(last_start + 1)]
    cases: list[np.ndarray] = [x[window] for window in along_axis]
    if start.op == "constant":
        return cases[min(max(int(start.value), 0), last_start)]
    return select_array(lowering.graph, start, cases)


def make_indexable(lowering: Lowering, x: Value, indices: list[Value]) -> Value:
    """Return x in memory if that serves to read it at `indices`, else x as it is.

    It is put in memory if data decide the indices, and x is a table of constants or longer than FEW. Arrays of random
    keys are never put in memory.
    """
    nodes = [n for p in indices for n in lowering.nodes(p).ravel().tolist()]
    indices_are_known = all(n.op == "constant" for n in nodes)
    if isinstance(x, StridedArray) or indices_are_known:
        return x
    flat = x.ravel().tolist()
    has_keys, is_table = any(isinstance(n, RandomKey) for n in flat), all(n.op == "constant" for n in flat)
    if has_keys or not (is_table or len(flat) > FEW):
        return x
    return put_in_memory(lowering, x)


def _gather(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Lower a gather of one window x[i, j, ...] of an array in memory as a view; other gathers use nodes.

    The inputs are the array and the indices (..., k) of the windows' starts.
    """
    numbers, indices = equation.params["dimension_numbers"], lowering.nodes(inputs[1])
    indices = convert_to_32_bits(lowering, indices) if fills_outside(equation) else indices
    x = make_indexable(lowering, inputs[0], [indices])
    is_one_window = indices.size == len(numbers.start_index_map) and not numbers.operand_batching_dims
    if not isinstance(x, StridedArray) or not is_one_window:
        return list(RULES["gather"](lowering, equation, [lowering.nodes(i) for i in inputs]))
    window, fits = _view_window(lowering, equation, x, indices.ravel().tolist())
    is_known_inside = fits.op == "constant" and fits.value
    if not fills_outside(equation) or is_known_inside:
        return [window]
    # A window that is not inside is filled with a value.
    filling, nodes = make_fill_value(lowering, equation), lowering.nodes(window)
    return [arrange_nodes([select(lowering.graph, fits, n, filling) for n in nodes.ravel().tolist()], nodes.shape)]


def _view_window(
    lowering: Lowering, equation: JaxprEqn, x: StridedArray, starts: list[Node]
) -> tuple[StridedArray, Node]:
    """Return the window of a gather as a view in the result's shape, and the node of whether it is inside the array.

    starts: its first index along each axis of the operation's `start_index_map`; it is clamped to the array.
    """
    graph, numbers, sizes = lowering.graph, equation.params["dimension_numbers"], equation.params["slice_sizes"]
    # Known starts add to the offset; those that data decide move the view.
    offset, moves, fits = 0, [], graph.constant(True, "bool")
    for axis, start in zip(numbers.start_index_map, starts, strict=True):
        last = x.shape[axis] - sizes[axis]
        first = clamp_start(lowering, start, last)
        fits = graph.node("and", "bool", fits, is_inside(graph, start, last))
        if isinstance(first, int):
            offset += x.strides[axis] * first
        else:
            moves.append((x.strides[axis], first))
    window_axes = [a for a in range(x.ndim) if a not in numbers.collapsed_slice_dims]
    view = x.view([sizes[a] for a in window_axes], [x.strides[a] for a in window_axes], offset, *moves)
    return view.view(result_shape(equation), _match_strides(view, result_shape(equation))), fits


def _match_strides(view: StridedArray, shape: tuple[int, ...]) -> list[int]:
    """Return the strides of a view in another shape, which differs only in axes of length 1; their strides are 0."""
    strides = iter([stride for length, stride in zip(view.shape, view.strides, strict=True) if length != 1])
    return [next(strides) if length != 1 else 0 for length in shape]


def _concatenate(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Return the concatenation of arrays along the operation's axis, in new memory.

    Along the first axis the arrays are put one behind another; along another axis a loop joins them row by row. Short
    results, and arrays of known numbers, are concatenated as nodes (scalar operations), without memory.
    """
    shape, axis = result_shape(equation), equation.params["dimension"]
    # As nodes if the result is short, or if all that is in memory is known numbers, which stay known then.
    arrays_in_memory = [x for x in inputs if isinstance(x, StridedArray)]
    are_known = all(x.buffer.kind == "table" and not x.moves and x.size <= LOADED for x in arrays_in_memory)
    if math.prod(shape) <= TABLE or are_known:
        return list(RULES["concatenate"](lowering, equation, [lowering.nodes(x) for x in inputs]))
    if axis != 0:
        parts = [put_in_memory(lowering, x) for x in inputs]

        def join_row(row: Node, carry: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
            """Return no carry, and one row of all arrays concatenated; a row lacks the first axis."""
            return [], [np.concatenate([lowering.nodes(x.row(row)) for x in parts], axis=axis - 1)]

        _carry, stacked = make_counted_loop(lowering, shape[0], [], join_row)
        return list(stacked)
    return [join_arrays(lowering, inputs, shape)]


def join_arrays(lowering: Lowering, parts: list[Value], shape: tuple[int, ...]) -> StridedArray:
    """Return the concatenation of arrays along the first axis, in one memory (buffer) of this `shape`.

    An array that is all of a buffer of its own is computed into its place directly: its buffer becomes a part of the
    new one. All others are copied. At least one of the `parts` is in memory, and tells the type of the numbers.
    """
    graph = lowering.graph
    number_type = next(x for x in parts if isinstance(x, StridedArray)).type
    buffer, start = Buffer("scratch", number_type, shape, graph.current), 0
    for x in parts:
        if isinstance(x, StridedArray) and _is_whole_buffer(x, graph.current):
            buffer.place_buffer_inside(x.buffer, start)
        else:
            _copy_into(lowering, x, buffer, start)
        start += x.size
    return StridedArray.of_whole_buffer(buffer)


def _is_whole_buffer(x: StridedArray, block: Any) -> bool:
    """Return whether an array is all of a memory (buffer) that this block fills and that is no part of another."""
    buffer = x.buffer
    is_contiguous = not x.moves and x.offset == 0 and x.strides == contiguous_strides(x.shape)
    is_whole = is_contiguous and x.size == buffer.size
    return is_whole and buffer.kind == "scratch" and buffer.inside is None and buffer.block is block


def _copy_into(lowering: Lowering, x: Value, buffer: Buffer, start: int) -> None:
    """Store an array into a buffer, from index `start` on.

    Up to TABLE entries, and arrays of nodes (scalar operations), are stored entry by entry. A longer array in memory is
    copied by a loop.
    """
    graph = lowering.graph
    if x.size <= TABLE or not isinstance(x, StridedArray):
        for index, node in enumerate(lowering.nodes(x).ravel().tolist()):
            graph.store(buffer, node, offset=start + index, strides=(), indices=())
    else:
        buffer.place_buffer_inside(copy_in_memory(lowering, x).buffer, start)


VIEWS: dict[str, View] = {
    "slice": _slice, "rev": _reverse, "transpose": _transpose, "reshape": _reshape, "squeeze": _reshape,
    "expand_dims": _reshape, "broadcast_in_dim": _broadcast_view,
}  # fmt: skip
IN_MEMORY |= {name: _make_view_rule(name, view) for name, view in VIEWS.items()}
RULES |= {"dynamic_slice": _dynamic_slice_of_nodes}
IN_MEMORY |= {"split": _split, "dynamic_slice": _lower_dynamic_slice, "gather": _gather, "concatenate": _concatenate}
IN_MEMORY |= {name: RULES[name] for name in PASSED_ON}
