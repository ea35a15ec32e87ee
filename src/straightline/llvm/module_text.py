"""Functions of a compiled program as text of LLVM IR: for blocks of runs, and for what all runs share."""

import math
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np

from straightline.constant_folding import DTYPES
from straightline.llvm.function_writer import FunctionWriter
from straightline.llvm.memory_layout import (
    FILLED,
    LINE,
    MemoryLayout,
    ProgramParts,
    lay_out_memory,
    split_shared_from_differing,
)
from straightline.llvm.operations import BITS
from straightline.llvm.output_buffers import choose_output_buffers
from straightline.llvm.prefetch import PrefetchedRows, count_cache_lines_per_iteration, find_longest_loop
from straightline.llvm.shared_slots import SharedSlots
from straightline.llvm.transposition import FEW, MoverOptions, write_mover
from straightline.llvm.vector_types_and_gathers import (
    WIDTH,
    write_gather,
    write_lane_numbers,
    write_subnormal_flush,
    write_vector_types,
)
from straightline.lowering import turn_failures_into_refusals
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
from straightline.rules.random_bits import write_hash_function
from straightline.size_limits import LONGEST
from straightline.vectors.elementary_functions import write_elementary_functions

SQUARED = ("f64", "i64", "u64", "f32")  # types whose arrays are long enough, or wide, to be moved in squares


class FunctionSource(NamedTuple):
    """Text of a function, from which code is generated once or twice.

    compressed: the text, to a tenth, since it is needed again only if the program turns out to be executed often.
    helpers: write the functions that it calls, for a count of lanes. operations: how many it has; work: how many it
    executes for a block of runs, each in a loop once an iteration.
    """

    compressed: bytes
    helpers: Sequence[Callable[[int], str]]
    operations: int
    work: int

    def text(self, width: int) -> str:
        """Return the LLVM text for vectors of `width` runs, with the vector types and the functions that it calls."""
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
    offsets: list[int]  # of common outputs in the shared memory
    shared: int
    scratch: int
    operations: int
    divisions: int
    width: int


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
    # The items of the block function, which computes what differs between runs, and where the numbers lie.
    block_items = find_crossing_items(items, parts.per_run)
    layout = lay_out_memory(parts, block_items)
    # The block function loads all else from slots, parts of memory that are assigned as it is written.
    slots = SharedSlots(layout.shared)
    products = find_fusable_products(items) if fuse else set()
    writer = FunctionWriter(single=alone, items=block_items, products=products, per_run=parts.per_run, slots=slots)
    writer.per_iteration, writer.flushes = layout.per_iteration, _is_single_precision(items)
    blocks = _write_block_function(writer, parts, layout)
    # The function of shared numbers, written after it, fills just these slots, once for all runs.
    once = _write_shared_function(writer, parts, layout)
    tables = [np.ascontiguousarray(b.table, dtype=DTYPES[b.type]) for b in parts.tables if b.table is not None]
    program.graph.top.free_contents()
    return ModuleText(
        blocks=blocks,
        once=once,
        tables=tables,
        outputs=[OutputShape(b.type, b.shape) for b in outputs],
        common=parts.common,
        offsets=[layout.in_shared.get(b, 0) for b in outputs],
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
    """Return whether a program computes with real numbers, and with none of double precision."""
    number_types = {x.type for x in items if isinstance(x, Node)}
    return "f32" in number_types and "f64" not in number_types


def _finish_source(text: str, writer: FunctionWriter, others: Sequence[Callable[[int], str]]) -> FunctionSource:
    """Return a function's source: its compressed text, its helpers, and how many operations it has and executes.

    An operation in a loop is executed once for each iteration; a loop of unknown length counts as one iteration.

    Args:
        text: LLVM text of the function.
        writer: its writer, which noted the functions that the text calls.
        others: write further functions that it calls, for a number of lanes.
    """
    operations_by_block = Counter([x.block for x in writer.items if isinstance(x, Node)])
    executed = sum(count * block.count_iterations() for block, count in operations_by_block.items())
    helpers: list[Callable[[int], str]] = [*others, *(partial(write_gather, *kind) for kind in sorted(writer.gathered))]
    if writer.flushes:
        helpers.append(write_subnormal_flush)
    called = writer.called - {"threefry"}
    if called:
        helpers.append(partial(write_elementary_functions, called))
    if "threefry" in writer.called:  # its text is the same for each count of lanes, so it is part of the text
        text = f"{write_hash_function()}\n{text}"
    compressed = zlib.compress(text.encode(), 1)
    operations = operations_by_block.total()
    return FunctionSource(compressed=compressed, helpers=helpers, operations=operations, work=executed)


HEAD = "(ptr %pointers, ptr %scratch, i64 %begin, i64 %end, i64 %runs)"


def _write_block_function(writer: FunctionWriter, parts: ProgramParts, layout: MemoryLayout) -> FunctionSource:
    """Return the function for blocks `begin` to `end` of W runs: transpose inputs, compute, transpose outputs back.

    A vector holds one number of W runs, one in each SIMD lane: scratch memory has each number of a block's runs side by
    side. Callers' arrays have a run's numbers one after another, so they are transposed, unless there is one run
    (`parts.alone`). W is a type's size in the text, chosen when code is generated.
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
    """Write a call that transposes a buffer of a block of runs; return which function ("mover") it calls.

    In the caller's array each run has a row of numbers. In scratch memory each number has a row with one lane for each
    run of the block.

    Args:
        writer: writer of the block function.
        names: LLVM names of the addresses of the callers' arrays.
        buffer: what is moved.
        kind: "take" to move the caller's rows to lanes, "give" to move lanes to the caller's rows.
    """
    mover = MoverOptions(
        bits=BITS[buffer.type],
        to_lanes=kind == "take",
        in_squares=buffer.type in SQUARED,
        few_entries=buffer.size if buffer.size < FEW else 0,
    )
    addresses = f"ptr {names[buffer]}, ptr {writer.bases[buffer]}"
    writer.line(f"call void @{mover.name}({addresses}, i64 {buffer.size}, i64 %first, i64 %last)")
    return mover


def _request_rows_ahead(
    writer: FunctionWriter, parts: ProgramParts, names: dict[Buffer, str], inputs: list[Buffer], outputs: list[Buffer]
) -> None:
    """Let the longest loop of the block function, if there is one, prefetch the callers' memory while it computes.

    It prefetches the next block's rows of the inputs, and this block's rows of the outputs, which are written after it.
    `names` maps a buffer to the LLVM name of the address of its memory.
    """
    writer.prefetching_loop = find_longest_loop(x for x in parts.program.graph.top.items if x in writer.items)
    if writer.prefetching_loop is not None:
        writer.prefetched_rows = _locate_rows(writer, names, inputs, outputs, parts.width, writer.prefetching_loop)


def _locate_rows(
    writer: FunctionWriter,
    names: dict[Buffer, str],
    inputs: list[Buffer],
    outputs: list[Buffer],
    width: int,
    loop: Loop,
) -> list[PrefetchedRows]:
    """Write the addresses of the rows that a loop prefetches; return them with their sizes and lines per iteration.

    A block is some runs (evaluations of one program), computed side by side; a buffer's row is its numbers of one run.
    In the LLVM text %first is the block's first run, and WIDTH the runs of a block, chosen when code is generated.

    Args:
        writer: writer of the block function.
        names: LLVM name of the address of each buffer's memory.
        inputs: buffers whose rows for the next block are read.
        outputs: buffers whose rows for this block are written.
        width: the most runs of a block, which gives the number of cache lines.
        loop: each of its iterations prefetches an equal share of the cache lines.
    """
    first_of_next, prefetched = writer.add(f"add i64 %first, {WIDTH}"), list[PrefetchedRows]()
    for buffer in (*inputs, *outputs):
        bytes_of_run, writes = buffer.size * BITS[buffer.type] // 8, buffer in outputs
        offset = writer.add(f"mul i64 {'%first' if writes else first_of_next}, {bytes_of_run}")
        start = writer.add(f"getelementptr i8, ptr {names[buffer]}, i64 {offset}")
        lines = count_cache_lines_per_iteration(bytes_of_run, width, loop)
        prefetched.append(PrefetchedRows(start=start, bytes=bytes_of_run, lines=lines, writes=writes))
    return prefetched


def _add_to_sums(
    writer: FunctionWriter,
    summed: SummedOutputs,
    names: dict[Buffer, str],
    number: Buffer,
    outputs: list[Buffer],
    width: int,
) -> None:
    """Make the writer's stores to these outputs add to sums over runs.

    Run r belongs to batch r mod batches, and a row has batches + width - 1 sums. Runs are taken in groups of `width`:
    the first run of a group adds to the sum of its batch, and the others to those behind it, also beyond the last
    batch. So numbers are added in the same order, and sums have the same bits, however many runs a vector has.

    Args:
        writer: writer of the function that computes a block of runs, one in each lane of a vector; at its beginning.
        summed: how many batches there are.
        names: LLVM name of each buffer's address.
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
    # The index in the row of this vector's first lane: batch + (first run of the block - first of the `width` runs).
    behind = writer.add(f"sub i64 %first, {first_of_width}")
    start = writer.add(f"add i64 {batch}, {behind}")
    # Lanes beyond the last run do not count: those whose number is not below the runs that are left.
    runs_left = writer.write_broadcast(writer.add("sub i64 %runs, %first"), "i64")
    writer.lanes_with_run = writer.add(f"icmp ult %i64 {writer.add('call %i64 @hg_lanes()')}, {runs_left}")
    for buffer in outputs:
        writer.bases[buffer] = writer.add(f"getelementptr double, ptr {names[buffer]}, i64 {start}")
        writer.sums[buffer] = row_length_of_sums(width, summed.batches)


def _write_shared_function(blocks: FunctionWriter, parts: ProgramParts, layout: MemoryLayout) -> FunctionSource | None:
    """Return the function that computes once what all runs share, or None if nothing needs it.

    It computes the shared outputs, and what the block function loads: numbers that have a slot, and shared buffers.

    Args:
        blocks: the writer of the block function, whose text is complete, so that it knows what it loads.
        parts: the program's items and outputs.
        layout: where shared buffers lie.
    """
    shared_outputs = [b for b, is_common in zip(parts.outputs, parts.common, strict=True) if is_common]
    roots: list[Any] = [*blocks.slots.offsets, *(b for b in blocks.read if b.kind in FILLED), *shared_outputs]
    if not roots:
        return None
    needed = list_needed_items(roots)
    writer = FunctionWriter(single=True, items=needed, products=blocks.products, per_run=set(), slots=blocks.slots)
    writer.per_iteration, writer.flushes = blocks.per_iteration, blocks.flushes
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
