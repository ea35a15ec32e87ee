"""Memory asked for before it is needed, as text of LLVM IR: its time passes beside the arithmetic of a loop.

Numbers of runs come from memory and go back to it, and a block of runs is computed sooner than these lines arrive. So
its longest loop asks, a share in each iteration, for the inputs of the next block and for the memory of its own
outputs. A Kalman step with four numbers in and four out: 26.7 ns of one core without, 16.6 with, 14.5 with nothing in
or out.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from straightline.nodes import Loop, Node
from straightline.size_limits import divide_rounded_up

LINE = 64  # bytes
PATIENCE = 8  # operations of vectors, of 0.3 ns, that take as long as a line: at 24 GB/s it is there in 2.7 ns


class PrefetchedRows(NamedTuple):
    """Rows of a block of runs, one after another in memory: what a loop asks for.

    `start` names the address of the first one; a row has `bytes`, an iteration's share of all so many `lines`; `writes`
    says whether the block fills them.
    """

    start: str
    bytes: int
    lines: int
    writes: bool


def find_longest_loop(items: Iterable[Any]) -> Loop | None:
    """Return the loop of known length that has most iterations, None if there is none."""
    loops = [x for x in items if isinstance(x, Loop) and x.length]
    return max(loops, key=lambda loop: loop.length or 0) if loops else None


def count_cache_lines_per_iteration(bytes: int, width: int, loop: Loop) -> int:
    """Return how many cache lines a loop asks for in each iteration, ahead of their use; 0 if that does not pay.

    In all its iterations together the loop fetches the rows of `width` runs; a row is one run's numbers, of `bytes`
    bytes. A line arrives in the time of PATIENCE arithmetic operations. If the lines of an iteration take longer than
    its operations, these cannot hide the wait, and nothing is fetched.
    """
    iterations = loop.length or 1  # no length: the number of iterations is not known
    lines_per_iteration = divide_rounded_up(bytes * width, iterations * LINE)  # LINE: bytes of a cache line
    operations = sum(isinstance(x, Node) and x.op != "load" for x in loop.body.items)
    return lines_per_iteration if lines_per_iteration * PATIENCE <= operations else 0


def write_prefetch_requests(
    rows: PrefetchedRows, iterations: int, counter: str, lanes: str, add: Callable[[str], str]
) -> list[str]:
    """Return the lines of LLVM IR by which one iteration of a loop prefetches its share of the memory of some rows.

    Args:
        rows: where the rows lie, their size in bytes, and how many lines an iteration prefetches.
        iterations: how many iterations the loop has.
        counter: name of the number of this iteration, from 0.
        lanes: LLVM's text of the number of rows.
        add: appends an operation, and returns the name of its result.
    """
    # This iteration's share begins at byte counter * bytes * lanes / iterations.
    product = add(f"mul i64 {counter}, {rows.bytes}")
    product = add(f"mul i64 {product}, {lanes}")
    first_byte = add(f"udiv i64 {product}, {iterations}")
    start = add(f"getelementptr i8, ptr {rows.start}, i64 {first_byte}")
    lines = [add(f"getelementptr i8, ptr {start}, i64 {LINE * k}") for k in range(rows.lines)]
    # The arguments after the address: 0 to read or 1 to write, moderate locality (2), the data cache (1).
    return [f"call void @llvm.prefetch.p0(ptr {line}, i32 {int(rows.writes)}, i32 2, i32 1)" for line in lines]
