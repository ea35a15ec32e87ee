"""Buffers of a program's results: memory that the program fills anyhow, or new memory that results are stored in."""

from collections.abc import Collection

from straightline.lowering import Lowering, Value
from straightline.nodes import Buffer, Node, Type
from straightline.program import Program
from straightline.rules.loops import copy_in_memory
from straightline.size_limits import TABLE
from straightline.strided_arrays import StridedArray, contiguous_strides


def choose_output_buffers(program: Program, last: Collection[int] = ()) -> list[Buffer]:
    """Return a buffer for each result, no buffer twice.

    A result that the program fills in memory stays where it is. A result of nodes (single numbers that the program
    computes) is stored number by number. So are the results whose numbers are in `last`: they may overwrite arguments,
    and must be stored after all others.
    """
    lowering = Lowering()
    lowering.graph = program.graph
    results: list[Buffer] = []
    for number, value in enumerate(program.outputs):
        if number in last or not isinstance(value, StridedArray):
            array = _store_in_memory(lowering, value)
        else:
            array = _find_whole_buffer_or_copy(lowering, value, results)
        results.append(array.buffer)
    return results


def _find_whole_buffer_or_copy(lowering: Lowering, value: StridedArray, taken: list[Buffer]) -> StridedArray:
    """Return an array as it is if it is all of a scratch buffer that no other result has taken; else a copy of it.

    A scratch buffer is memory that the program fills. The strides of the whole of it, with the last axis innermost, are
    those of `contiguous_strides`; `moves` would be offsets that data decide.
    """
    buffer = value.buffer
    is_contiguous = not value.moves and value.offset == 0 and value.strides == contiguous_strides(value.shape)
    is_free = buffer.kind == "scratch" and buffer.inside is None and buffer not in taken
    if is_contiguous and is_free and value.size == buffer.size:
        buffer.shape = value.shape
        return value
    return _store_in_memory(lowering, value) if value.size <= TABLE else copy_in_memory(lowering, value)


def _store_in_memory(lowering: Lowering, value: Value) -> StridedArray:
    """Return a copy of an array that is stored entry by entry in a new buffer (memory that the program fills).

    `value` is a NumPy array of nodes, each a number that the program computes, or an array in memory, whose entries are
    loaded first. The stores are added to `graph.current`, the block of the program that is open: here the outermost.
    """
    graph = lowering.graph
    nodes: list[Node] = lowering.nodes(value).ravel().tolist()
    number_type: Type = value.type if isinstance(value, StridedArray) else nodes[0].type
    buffer = Buffer("scratch", number_type, value.shape, graph.current)
    for index, node in enumerate(nodes):
        graph.store(buffer, node, offset=index, strides=(), indices=())  # buffer[index] = node
    return StridedArray.of_whole_buffer(buffer)
