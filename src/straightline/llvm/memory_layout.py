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
    """Items of a program in order, and what of them differs between runs: `spread`; all else is computed once.

    `lanes` are the inputs that differ: a block of runs has one run's numbers in each lane of its vectors. `alone`:
    there is one run, whose arrays are used in place. A vector has at most `width` runs.
    """

    program: Program
    items: list[Any]
    outputs: list[Buffer]
    lanes: list[Buffer]
    spread: set[Any]
    alone: bool
    width: int
    summed: SummedOutputs | None

    @property
    def tables(self) -> list[Buffer]:
        """Return the tables of constants that the items read."""
        return [x for x in self.items if isinstance(x, Buffer) and x.kind == "table"]

    @property
    def passed_buffers(self) -> list[Buffer]:
        """Return the buffers whose addresses a caller passes."""
        return [*self.program.inputs, *self.tables, *self.outputs]

    @property
    def common(self) -> list[bool]:
        """Return which outputs all runs share."""
        return [b not in self.spread for b in self.outputs]

    @property
    def outputs_summed_in_memory(self) -> list[Buffer]:
        """Return the outputs that are summed over runs in memory.

        An output that all runs share (not in `spread`) is not among them: its sum is its number times the runs.
        """
        if self.summed is None:
            return []
        pairs = zip(self.outputs, self.summed.outputs, strict=True)
        return [b for b, is_sum in pairs if is_sum and b in self.spread]


def split_shared_from_differing(
    program: Program,
    items: list[Any],
    outputs: list[Buffer],
    differing: Iterable[bool],
    width: int | None,
    alone: bool,
    summed: SummedOutputs | None,
) -> ProgramParts:
    """Return the parts of a program for its two functions, of what differs between runs and of what they share.

    Args:
        program: the program of one run.
        items: all that the outputs need, in order.
        outputs: a buffer for each result.
        differing: for each input whether it differs between runs.
        width: the most runs of a vector; as many as suit the program if None.
        alone: whether there is one run, whose arrays are used in place.
        summed: outputs that are summed over runs.
    """
    lanes = [b for b, differs in zip(program.inputs, differing, strict=True) if differs or alone]
    # What differs between runs. One run alone computes all in the function of blocks, so all counts as differing; but
    # tables are constants, which never do.
    spread = {*items, *program.inputs} if alone else find_differing_items(items, lanes)
    spread = {x for x in spread if not (isinstance(x, Buffer) and x.kind == "table")}
    return ProgramParts(
        program=program,
        items=items,
        outputs=outputs,
        lanes=lanes,
        spread=spread,
        alone=alone,
        width=width or choose_vector_width(spread),
        summed=summed,
    )


def choose_vector_width(items: Iterable[Any]) -> int:
    """Return how many runs a vector has, one a lane: WIDEST, or 2 WIDEST if most operations are on 32-bit numbers.

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
    """Offsets of buffers, and their ends, in bytes: of memory that belongs to a thread, and that all runs share.

    `turning` are shared buffers within loops that have a place for each turn.
    """

    scratch: int
    in_scratch: dict[Buffer, int]
    shared: int
    in_shared: dict[Buffer, int]
    turning: set[Buffer]


def lay_out_memory(parts: ProgramParts, mine: Collection[Any]) -> MemoryLayout:
    """Return where buffers lie, as offsets in bytes.

    Buffers that differ between runs lie in a thread's own memory (scratch). Buffers that the program fills for all
    runs lie in shared memory. `mine` holds the items of the function of blocks, which computes what differs between
    runs. If it reads a shared buffer that each turn of a loop fills anew, the buffer has a copy for each turn.
    """
    owners = dict.fromkeys(x.owner[0] for x in parts.items if isinstance(x, Buffer))
    sums = set(parts.outputs_summed_in_memory)
    _check_sums(parts.items, sums)
    used_in_place = {*parts.outputs, *parts.lanes} if parts.alone else set()
    differing = [b for b in owners if b in parts.spread and b not in sums and b not in used_in_place]
    common = [b for b in owners if b not in parts.spread and b.kind in FILLED]
    turning = {b for b in common if b.block.list_loops()}  # filled anew in each turn of a loop
    turning &= _find_read_buffers(mine) if turning else turning  # and read by the function of blocks
    scratch, in_scratch = _place_buffers(differing, parts.width)
    shared, in_shared = _place_buffers(common, width=1, turning=turning)
    return MemoryLayout(scratch=scratch, in_scratch=in_scratch, shared=shared, in_shared=in_shared, turning=turning)


def _check_sums(items: Iterable[Any], outputs: Collection[Buffer]) -> None:
    """Raise Unsupported unless all `outputs`, which are summed over runs, are real and only stored to.

    An output that the program reads again, or that is part of another array, needs each run's own number. A sum does
    not have it.
    """
    read = _find_read_buffers(items) if outputs else set()
    if any(b.inside is not None or b in read or b.type not in REAL for b in outputs):
        raise Unsupported("a sum over runs of numbers that are used again")


def _find_read_buffers(items: Iterable[Any]) -> set[Buffer]:
    """Return the buffers that these items, or what they use directly, load numbers of."""
    nodes = (node for x in items for node in (x, *list_used_nodes(x)) if isinstance(node, Node))
    return {node.value[0].owner[0] for node in nodes if node.op == "load"}


def _place_buffers(
    buffers: Iterable[Buffer], width: int, turning: Collection[Buffer] = ()
) -> tuple[int, dict[Buffer, int]]:
    """Place buffers of `width` runs one after another; return the end and the offset of each buffer, in bytes.

    A buffer in `turning` has a copy for each turn of the loops around it.
    """
    start, places = 0, dict[Buffer, int]()
    for buffer in buffers:
        places[buffer] = start
        copies = buffer.block.count_turns() if buffer in turning else 1
        bits = buffer.size * copies * width * BITS[buffer.type]
        start += divide_rounded_up(bits, 8 * LINE) * LINE  # up to the next cache line
    return start, places
