"""What of a program differs between runs, and where its numbers lie in memory."""

from collections import Counter
from collections.abc import Collection, Iterable
from typing import Any, NamedTuple

from straightline.llvm.operations import BITS
from straightline.nodes import REAL, Buffer, Node, Unsupported
from straightline.program import Program, SummedOutputs, find_differing_items, list_used_nodes
from straightline.size_limits import divide_rounded_up
from straightline.vectors.elementary_functions import FUNCTIONS

LINE = 64  # bytes: where vectors of any width may start
WIDEST = 8  # runs of a vector of doubles: one register of the widest processors, two of others; more only spill
LONG = 60  # operations of an elementary function or of a hash: 30 to 150, and 80
FILLED = ("scratch", "carried")  # kinds of memory that the program fills


class ProgramParts(NamedTuple):
    """What a program's outputs need, and which of it differs between runs; all else is computed once for all runs.

    items: operations, statements and buffers in order. outputs: a buffer for each result. lanes: the inputs that differ
    between runs; in vectors each SIMD lane has the number of one run. per_run: the items and inputs that differ
    between runs. alone: there is one run, whose arrays are used in place. width: the most runs of a vector.
    """

    program: Program
    items: list[Any]
    outputs: list[Buffer]
    lanes: list[Buffer]
    per_run: set[Any]
    alone: bool
    width: int
    summed: SummedOutputs | None

    @property
    def tables(self) -> list[Buffer]:
        """Return the tables of constants that the items read."""
        return [x for x in self.items if isinstance(x, Buffer) and x.kind == "table"]

    @property
    def passed_buffers(self) -> list[Buffer]:
        """Return the arrays in memory whose addresses a caller passes, in order: inputs, tables, outputs."""
        return [*self.program.inputs, *self.tables, *self.outputs]

    @property
    def common(self) -> list[bool]:
        """Return for each output whether all runs share it."""
        return [b not in self.per_run for b in self.outputs]

    @property
    def outputs_summed_in_memory(self) -> list[Buffer]:
        """Return the outputs to whose sums over runs the code adds each run's number.

        An output that is equal in all runs is not among them, since its sum is its number times the number of runs.
        """
        if self.summed is None:
            return []
        pairs = zip(self.outputs, self.summed.outputs, strict=True)
        return [b for b, is_sum in pairs if is_sum and b in self.per_run]


def split_shared_from_differing(
    program: Program,
    items: list[Any],
    outputs: list[Buffer],
    differing: Iterable[bool],
    width: int | None,
    alone: bool,
    summed: SummedOutputs | None,
) -> ProgramParts:
    """Decide which items of a program differ between runs: one function computes these, and another one the others.

    Native code computes many runs of one program. What is the same in all runs is computed once by a function of its
    own; what differs is computed for each block of runs. An item is an operation, a statement or a buffer.

    Args:
        program: the program of one run.
        items: items that the outputs need, in order.
        outputs: a buffer for each result.
        differing: for each input whether it differs between runs.
        width: the most runs of a vector (its SIMD lanes); None for as many as suit the program.
        alone: whether there is one run, whose arrays are used in place.
        summed: outputs that are summed over runs; None if there are none.
    """
    # Inputs that differ between runs.
    lanes = [b for b, differs in zip(program.inputs, differing, strict=True) if differs or alone]
    # Items that differ. With one run alone everything counts as differing, so that one function computes all. Tables
    # never differ: they are constants.
    per_run = {*items, *program.inputs} if alone else find_differing_items(items, lanes)
    per_run = {x for x in per_run if not (isinstance(x, Buffer) and x.kind == "table")}
    return ProgramParts(
        program=program,
        items=items,
        outputs=outputs,
        lanes=lanes,
        per_run=per_run,
        alone=alone,
        width=width or choose_vector_width(per_run),
        summed=summed,
    )


def choose_vector_width(items: Iterable[Any]) -> int:
    """Return how many runs a vector has, one in each SIMD lane: WIDEST, or 2 WIDEST if most operations have 32 bits.

    An elementary function, and a hash (threefry), takes as long as LONG other operations and counts as LONG.

    Measured for a particle filter's step that draws four normal floats from two hashed words: beside 112 operations on
    doubles it takes 12 ns a particle with 16 runs and 19 ns with 8; beside 281 it takes 15 ns and 31 ns.
    """
    operations_of_bits = Counter[int]()
    for x in items:
        if isinstance(x, Node):
            bits = 32 if x.op == "threefry" else BITS[x.type]
            operations_of_bits[bits] += LONG if x.op == "threefry" or x.op in FUNCTIONS else 1
    return 2 * WIDEST if operations_of_bits[32] > operations_of_bits[64] else WIDEST


class MemoryLayout(NamedTuple):
    """Offsets of buffers in two memories, and the sizes of these, in bytes.

    scratch, in_scratch: size of the memory that each thread has, and offsets in it. shared, in_shared: the same of the
    memory that all runs share. per_iteration: shared buffers with a copy for each iteration of the loops around them.
    """

    scratch: int
    in_scratch: dict[Buffer, int]
    shared: int
    in_shared: dict[Buffer, int]
    per_iteration: set[Buffer]


def lay_out_memory(parts: ProgramParts, block_items: Collection[Any]) -> MemoryLayout:
    """Return where a program's buffers lie, as offsets in bytes in each thread's scratch memory and in shared memory.

    Buffers that differ between runs lie in scratch memory, with a number for each of the `width` runs of a vector.
    Buffers that the program fills for all runs lie in shared memory. The function of shared numbers fills them before
    the block function begins. So if the block function reads a shared buffer that each iteration of a loop fills anew,
    the buffer has a copy for each iteration.

    Args:
        parts: the program's items, and which of them differ between runs (`per_run`).
        block_items: the items of the block function, which computes what differs between runs.
    """
    # Buffers (arrays in memory) by their owners: a part of a buffer lies in its owner.
    whole_buffers = dict.fromkeys(x.owner[0] for x in parts.items if isinstance(x, Buffer))
    sums = set(parts.outputs_summed_in_memory)
    _check_sums(parts.items, sums)
    caller_arrays = {*parts.outputs, *parts.lanes} if parts.alone else set()  # one run alone uses its arrays in place
    # Sums over runs and arrays of the caller have memory elsewhere.
    differing = [b for b in whole_buffers if b in parts.per_run and b not in sums and b not in caller_arrays]
    common = [b for b in whole_buffers if b not in parts.per_run and b.kind in FILLED]
    filled_in_loops = {b for b in common if b.block.list_loops()}
    per_iteration = filled_in_loops and filled_in_loops & _find_read_buffers(block_items)
    scratch, in_scratch = _place_buffers(differing, parts.width)
    shared, in_shared = _place_buffers(common, width=1, per_iteration=per_iteration)
    return MemoryLayout(
        scratch=scratch, in_scratch=in_scratch, shared=shared, in_shared=in_shared, per_iteration=per_iteration
    )


def _check_sums(items: Iterable[Any], outputs: Collection[Buffer]) -> None:
    """Raise Unsupported unless the sums over runs of all `outputs` can be made in the place of the outputs themselves.

    The memory of such an output holds only the sum, and no run's own number. So it must be of real numbers, must not be
    a part of another array, and none of the program's `items` (its operations and statements) may read it again.
    """
    if not outputs:
        return
    read_again = _find_read_buffers(items)
    for output in outputs:
        is_part = output.inside is not None
        if is_part or output in read_again or output.type not in REAL:
            raise Unsupported("a sum over runs of numbers that are used again")


def _find_read_buffers(items: Iterable[Any]) -> set[Buffer]:
    """Return the buffers (arrays in memory) that these items, or what they use directly, load numbers of.

    A part of a larger buffer counts as the larger one.
    """
    nodes = (node for x in items for node in (x, *list_used_nodes(x)) if isinstance(node, Node))
    loaded_buffers = [node.value[0] for node in nodes if node.op == "load"]  # value: (buffer, offset, strides)
    return {whole for whole, _offset in (buffer.owner for buffer in loaded_buffers)}


def _place_buffers(
    buffers: Iterable[Buffer], width: int, per_iteration: Collection[Buffer] = ()
) -> tuple[int, dict[Buffer, int]]:
    """Place buffers of `width` runs one after another; return their size together and the offset of each, in bytes.

    Each begins at a multiple of LINE bytes, a cache line. A buffer in `per_iteration` has a copy for each iteration of
    the loops around it.
    """
    start, offsets = 0, dict[Buffer, int]()
    for buffer in buffers:
        offsets[buffer] = start
        copies = buffer.block.count_iterations() if buffer in per_iteration else 1
        bits = buffer.size * copies * width * BITS[buffer.type]
        start += divide_rounded_up(bits, 8 * LINE) * LINE  # up to the next cache line
    return start, offsets
