"""Functions of a compiled program as text of LLVM IR: for blocks of runs, and for what all runs share."""

import math
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np

from straightline.constant_folding import DTYPES
from straightline.llvm.function_writer import FunctionWriter, SharedSlots
from straightline.llvm.memory_layout import (
    FILLED,
    LINE,
    MemoryLayout,
    ProgramParts,
    lay_out_memory,
    split_shared_from_differing,
)
from straightline.llvm.operations import BITS
from straightline.llvm.prefetch import PrefetchedRows, count_cache_lines_per_turn, find_longest_loop
from straightline.llvm.transposition import FEW, MoverOptions, write_mover
from straightline.llvm.vector_types_and_gathers import (
    WIDTH,
    write_gather,
    write_lane_numbers,
    write_subnormal_flush,
    write_vector_types,
)
from straightline.lowering import Lowering, Value, turn_failures_into_refusals
from straightline.nodes import Buffer, Loop, Node, Type, Unsupported
from straightline.program import (
    Program,
    SummedOutputs,
    find_crossing_items,
    find_fusable_products,
    list_needed_items,
    row_length_of_sums,
    sort_items_by_dependence,
)
from straightline.reuse_recurring_loop_values import reuse_recurring_values
from straightline.rules.loops import copy_in_memory
from straightline.rules.random_bits import write_hash_function
from straightline.size_limits import LONGEST, TABLE
from straightline.strided_arrays import StridedArray, contiguous_strides
from straightline.vectors.elementary_functions import write_elementary_functions

SQUARED = ("f64", "i64", "u64", "f32")  # types whose arrays are long enough, or wide, to be moved in squares


class FunctionSource(NamedTuple):
    """Text of a function, from which code is generated once or twice.

    compressed: the text, to a tenth, since it is needed again only if the program turns out to be executed often.
    helpers: write the functions that it calls, for a count of lanes. operations: how many it has; work: how many it
    executes for a block of runs, each in a loop once a turn.
    """

    compressed: bytes
    helpers: Sequence[Callable[[int], str]]
    operations: int
    work: int

    def text(self, width: int) -> str:
        """Return the text for vectors of so many runs."""
        body = zlib.decompress(self.compressed).decode()
        return "\n".join([write_vector_types(width), *(helper(width) for helper in self.helpers), body])


class OutputShape(NamedTuple):
    """Type and shape of a result of one run: its buffer without the program that fills it."""

    type: Type
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """Return the count of numbers of one run."""
        return math.prod(self.shape)


class ModuleText(NamedTuple):
    """Text of a program's two functions, for blocks of runs and once for what all runs share, and their memory.

    `pointers` are to memory of the inputs, the tables, the outputs and last to `shared` bytes that all runs share;
    `scratch` bytes belong to a thread. `common` says which outputs all runs share. `operations` are those in the
    program, `divisions` those of them that divide or take roots. `width`: the most runs of a vector.
    """

    blocks: FunctionSource
    once: FunctionSource | None
    tables: list[np.ndarray]
    outputs: list[OutputShape]
    common: list[bool]
    places: list[int]  # of common outputs in the shared memory
    shared: int
    scratch: int
    operations: int
    divisions: int
    width: int


def choose_output_buffers(program: Program, last: Collection[int] = ()) -> list[Buffer]:
    """Return a buffer for each result, no buffer twice.

    A result that the program fills in memory stays where it is. A result of nodes is stored number by number. So are
    the results whose numbers are in `last`: they may overwrite arguments, and must be stored after all others.
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
    """Return an array as it is if it is all of a scratch buffer that no other result has taken; else a copy of it."""
    buffer = value.buffer
    is_contiguous = not value.moves and value.offset == 0 and value.strides == contiguous_strides(value.shape)
    is_free = buffer.kind == "scratch" and buffer.inside is None and buffer not in taken
    if is_contiguous and is_free and value.size == buffer.size:
        buffer.shape = value.shape
        return value
    return _store_in_memory(lowering, value) if value.size <= TABLE else copy_in_memory(lowering, value)


def _store_in_memory(lowering: Lowering, value: Value) -> StridedArray:
    """Return a copy of an array, of nodes or in memory, that is stored entry by entry in a new buffer."""
    nodes: list[Node] = lowering.nodes(value).ravel().tolist()
    type: Type = value.type if isinstance(value, StridedArray) else nodes[0].type
    buffer = Buffer("scratch", type, value.shape, lowering.graph.current)
    for index, node in enumerate(nodes):
        lowering.graph.store(buffer, node, offset=index, strides=(), indices=())
    return StridedArray.of_whole_buffer(buffer)


@turn_failures_into_refusals("the text of a program")
def write_module(
    program: Program,
    differing: Iterable[bool],
    width: int | None,
    fuse: bool,
    alone: bool = False,
    last: Collection[int] = (),
    summed: SummedOutputs | None = None,
) -> ModuleText:
    """Return the LLVM text of a program: a function for blocks of runs, and one that computes once what runs share.

    A block is as many runs as a vector has, one in each lane. The program's graph is freed.

    Args:
        program: the program of one run.
        differing: for each input whether it differs between runs.
        width: the most runs of a vector; as many as suit the program if None.
        fuse: whether products and sums are fused operations.
        alone: whether there is one run, whose arrays are used in place.
        last: numbers of results that may overwrite arguments.
        summed: outputs that are summed over runs.

    Raises:
        Unsupported: an operation that LLVM's text does not have here, or a program that is too long.
    """
    outputs = choose_output_buffers(program, last)
    items = sort_items_by_dependence(
        reuse_recurring_values(program.graph, outputs) if alone else list_needed_items(outputs)
    )
    counts = _count_operations(items)
    parts = split_shared_from_differing(program, items, outputs, differing, width, alone, summed)
    # The items of the function of blocks, and where the numbers lie.
    of_blocks = find_crossing_items(items, parts.spread)
    layout = lay_out_memory(parts, of_blocks)
    # The function of blocks computes what differs between runs. All else it reads from slots, places in memory that are
    # assigned as it is written.
    slots = SharedSlots(layout.shared)
    products = find_fusable_products(items) if fuse else set()
    writer = FunctionWriter(single=alone, mine=of_blocks, products=products, spread=parts.spread, slots=slots)
    writer.turning, writer.flushes = layout.turning, _is_single_precision(items)
    blocks = _write_block_function(writer, parts, layout)
    # The other function, written after it, fills just these slots, once for all runs.
    once = _write_shared_function(writer, parts, layout)
    tables = [np.ascontiguousarray(b.table, dtype=DTYPES[b.type]) for b in parts.tables if b.table is not None]
    program.graph.top.free_contents()
    return ModuleText(
        blocks=blocks,
        once=once,
        tables=tables,
        outputs=[OutputShape(b.type, b.shape) for b in outputs],
        common=parts.common,
        places=[layout.in_shared.get(b, 0) for b in outputs],
        shared=slots.size,
        scratch=layout.scratch + LINE,
        operations=counts.total(),
        divisions=counts["div"] + counts["sqrt"],
        width=parts.width,
    )


def _count_operations(items: Iterable[Any]) -> Counter[str]:
    """Return how often each operation occurs, without constants; raise Unsupported if all are more than LONGEST."""
    counts = Counter([x.op for x in items if isinstance(x, Node)])
    del counts["constant"]
    if counts.total() > LONGEST:
        raise Unsupported(f"a program of {counts.total()} operations, above {LONGEST}")
    return counts


def _is_single_precision(items: Iterable[Any]) -> bool:
    """Return whether real numbers are all of single precision."""
    types_ = {x.type for x in items if isinstance(x, Node)}
    return "f32" in types_ and "f64" not in types_


def _finish_source(text: str, writer: FunctionWriter, others: Sequence[Callable[[int], str]]) -> FunctionSource:
    """Return the source of a written text, with its helpers and counts; a loop of unknown length counts as one turn.

    Helpers write the functions that the text calls: `others`, and those that the writer noted.
    """
    counts = Counter([x.block for x in writer.mine if isinstance(x, Node)])
    turns = {block: block.count_turns() for block in counts}
    work = sum(count * turns[block] for block, count in counts.items())
    helpers: list[Callable[[int], str]] = [*others, *(partial(write_gather, *kind) for kind in sorted(writer.gathered))]
    if writer.flushes:
        helpers.append(write_subnormal_flush)
    called = writer.called - {"threefry"}
    if called:
        helpers.append(partial(write_elementary_functions, called))
    if "threefry" in writer.called:  # its text is the same for each count of lanes, so it is part of the text
        text = f"{write_hash_function()}\n{text}"
    compressed = zlib.compress(text.encode(), 1)
    return FunctionSource(compressed=compressed, helpers=helpers, operations=counts.total(), work=work)


HEAD = "(ptr %pointers, ptr %scratch, i64 %begin, i64 %end, i64 %runs)"


def _write_block_function(writer: FunctionWriter, parts: ProgramParts, layout: MemoryLayout) -> FunctionSource:
    """Return the function for blocks `begin` to `end` of W runs: transpose inputs, compute, transpose outputs back.

    Callers' arrays have the numbers of a run one after another; a thread's scratch memory has each number of a block's
    runs side by side, as lanes of a vector. W, the runs of a vector, is a type's size in the text: it is chosen when
    code is generated. Where there is one run (`parts.alone`), nothing is transposed.
    """
    names = _write_pointers(writer, parts.passed_buffers, layout.in_shared)
    for buffer, offset in layout.in_scratch.items():
        writer.bases[buffer] = writer.add(f"getelementptr i8, ptr %scratch, i64 {offset}")
    # Loop over blocks; the block `number` has runs from `first` on.
    writer.line("%last = sub i64 %runs, 1")
    writer.line("br label %block")
    writer.start_basic_block("block")
    writer.line("%number = phi i64 [%begin, %entry], [%next, %done]")
    writer.line(f"%first = mul i64 %number, {WIDTH}")
    # Inputs to lanes, the operations, lanes to outputs. A mover is the function that transposes arrays of one kind; it
    # is called here, and written below among the helpers.
    transposed = set() if parts.alone else {b for b in layout.in_scratch if b.size}
    moved_inputs = [b for b in parts.lanes if b in transposed]
    moved_outputs = [b for b in parts.outputs if b in transposed]
    movers = {_write_mover_call(writer, names, buffer, "take") for buffer in moved_inputs}
    _request_rows_ahead(writer, parts, names, moved_inputs, moved_outputs)
    if parts.summed is not None:
        number = parts.program.inputs[parts.summed.number]
        _add_to_sums(writer, parts.summed, names, number, parts.outputs_summed_in_memory, parts.width)
    writer.write_block(parts.program.graph.top)
    movers |= {
        _write_mover_call(writer, names, buffer, "give") for buffer in moved_outputs if buffer not in writer.sums
    }
    # Next block.
    writer.line("br label %done")
    writer.start_basic_block("done")
    writer.line("%next = add i64 %number, 1")
    writer.line("%more = icmp slt i64 %next, %end")
    writer.line("br i1 %more, label %block, label %exit")
    writer.start_basic_block("exit")
    helpers: list[Callable[[int], str]] = [] if parts.summed is None else [write_lane_numbers]
    helpers += [partial(write_mover, move) for move in sorted(movers)]
    return _finish_source(_write_run_function("\n".join(writer.lines), writer), writer, helpers)


def _write_mover_call(
    writer: FunctionWriter, names: dict[Buffer, str], buffer: Buffer, kind: Literal["take", "give"]
) -> MoverOptions:
    """Write a call that moves a buffer's rows, one a run, into lanes ("take") or back; return the mover it calls."""
    few = buffer.size if buffer.size < FEW else 0
    called = MoverOptions(bits=BITS[buffer.type], inwards=kind == "take", squared=buffer.type in SQUARED, few=few)
    pair = f"ptr {names[buffer]}, ptr {writer.bases[buffer]}"
    writer.line(f"call void @{called.name}({pair}, i64 {buffer.size}, i64 %first, i64 %last)")
    return called


def _request_rows_ahead(
    writer: FunctionWriter, parts: ProgramParts, names: dict[Buffer, str], taken: list[Buffer], given: list[Buffer]
) -> None:
    """Let the longest loop, if there is one, prefetch the next block's inputs (`taken`) and its own outputs (`given`).

    `names` maps a buffer to the name of the pointer to its memory in LLVM's text.
    """
    writer.asking_loop = find_longest_loop(x for x in parts.program.graph.top.items if x in writer.mine)
    if writer.asking_loop is not None:
        writer.asked_rows = _locate_rows(writer, names, taken, given, parts.width, writer.asking_loop)


def _locate_rows(
    writer: FunctionWriter, names: dict[Buffer, str], taken: list[Buffer], given: list[Buffer], width: int, loop: Loop
) -> list[PrefetchedRows]:
    """Return the rows that a loop prefetches: the next block's inputs (`taken`) and this block's outputs (`given`)."""
    first_of_next, results = writer.add(f"add i64 %first, {WIDTH}"), list[PrefetchedRows]()
    for buffer in (*taken, *given):
        bytes_of_run, writes = buffer.size * BITS[buffer.type] // 8, buffer in given
        place = writer.add(f"mul i64 {'%first' if writes else first_of_next}, {bytes_of_run}")
        start = writer.add(f"getelementptr i8, ptr {names[buffer]}, i64 {place}")
        results.append(
            PrefetchedRows(start, bytes_of_run, count_cache_lines_per_turn(bytes_of_run, width, loop), writes)
        )
    return results


def _add_to_sums(
    writer: FunctionWriter,
    summed: SummedOutputs,
    names: dict[Buffer, str],
    number: Buffer,
    outputs: list[Buffer],
    width: int,
) -> None:
    """Make the writer's stores to these outputs add to sums over runs.

    A row of sums has a place for each batch and some more (`row_length_of_sums`). Of each `width` consecutive runs, the
    most that a vector has, the first adds to the place of its batch, run number mod batches, and the others to the
    places behind it: so sums have the same bits however many runs a vector has.

    Args:
        writer: of the function of blocks, at the beginning of a block.
        summed: how many batches there are.
        names: of the buffers' addresses.
        number: the input with each run's number.
        outputs: the buffers with rows of sums.
        width: the most runs of a vector, a power of two.
    """
    # The first of the `width` runs, and its batch: the block's first run rounded down to a multiple of width. That is a
    # power of two, so that "and" with -width clears the lower bits.
    first_of_width = writer.add(f"and i64 %first, {-width}")
    address = writer.add(f"getelementptr i32, ptr {names[number]}, i64 {first_of_width}")
    run = writer.add(f"load i32, ptr {address}, align 4")
    batch = writer.add(f"zext i32 {writer.add(f'urem i32 {run}, {summed.batches}')} to i64")
    # The place of this vector's first lane.
    behind = writer.add(f"sub i64 %first, {first_of_width}")
    place = writer.add(f"add i64 {batch}, {behind}")
    # Lanes beyond the last run repeat it, and do not count: those whose number is not below the runs that are left.
    runs_left = writer.write_broadcast(writer.add("sub i64 %runs, %first"), "i64")
    writer.counted_lanes = writer.add(f"icmp ult %i64 {writer.add('call %i64 @hg_lanes()')}, {runs_left}")
    for buffer in outputs:
        writer.bases[buffer] = writer.add(f"getelementptr double, ptr {names[buffer]}, i64 {place}")
        writer.sums[buffer] = row_length_of_sums(width, summed.batches)


def _write_shared_function(blocks: FunctionWriter, parts: ProgramParts, layout: MemoryLayout) -> FunctionSource | None:
    """Return the function that computes what all runs share, or None if nothing needs it.

    `blocks`: the writer of the function of blocks, which loads the numbers `slots.places` and the buffers `read`.
    """
    shared_outputs = [b for b, is_common in zip(parts.outputs, parts.common, strict=True) if is_common]
    roots: list[Any] = [*blocks.slots.places, *(b for b in blocks.read if b.kind in FILLED), *shared_outputs]
    if not roots:
        return None
    needed = list_needed_items(roots)
    writer = FunctionWriter(single=True, mine=needed, products=blocks.products, spread=set(), slots=blocks.slots)
    writer.turning, writer.flushes = blocks.turning, blocks.flushes
    _write_pointers(writer, parts.passed_buffers, layout.in_shared)
    writer.write_block(parts.program.graph.top)
    return _finish_source(_write_run_function("\n".join(writer.lines), writer), writer, [])


def _write_run_function(body: str, writer: FunctionWriter) -> str:
    """Return the text of the function `run` with this body; if the writer `flushes`, it takes subnormals as zeros."""
    before = after = ""
    if writer.flushes:
        before, after = "  %control = call i32 @hg_flush()\n", "  call void @hg_restore(i32 %control)\n"
    return f"define void @run{HEAD} {{\nentry:\n{before}{body}\n{after}  ret void\n}}\n"


def _write_pointers(writer: FunctionWriter, pointers: list[Buffer], in_shared: dict[Buffer, int]) -> dict[Buffer, str]:
    """Write the loads of the addresses in `%pointers`, the last that of shared memory; return their names by buffer."""
    names: dict[Buffer, str] = {}
    for number, buffer in enumerate([*pointers, None]):
        address = writer.add(f"getelementptr ptr, ptr %pointers, i64 {number}")
        name = writer.add(f"load ptr, ptr {address}, align 8")
        if buffer is None:
            writer.slots.base = name
        else:
            names[buffer] = writer.bases[buffer] = name
    for buffer, start in in_shared.items():
        writer.bases[buffer] = writer.add(f"getelementptr i8, ptr {writer.slots.base}, i64 {start}")
    return names
