"""Transposition of arrays [run][entry] to [entry][lane] for a block of runs, and back, as text of LLVM IR.

Arrays of long numbers are moved in squares, of as many runs and entries as a register, or a vector, has lanes. If each
run has only a few entries, all entries of some runs are loaded as whole registers, whose numbers are exchanged: two
entries a run take half of the time that they took one by one. All other entries are moved one by one.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

REGISTER = 512  # bits of the largest one: a row of a square
FEW = 8  # entries of a run from which on squares of the largest registers are filled


class TextLines:
    """Lines of LLVM's text of a function, in which each result has a new name."""

    def __init__(self) -> None:
        """Begin a text without lines; `count` is the number of names made so far."""
        self.lines: list[str] = []
        self.count = 0

    def add(self, text: str) -> str:
        """Append an instruction, given without its result as in "add i64 %a, 1"; return the new name of its result."""
        self.count += 1
        self.lines.append(f"  %x{self.count} = {text}")
        return f"%x{self.count}"

    def write_loop(self, name: str, begin: str, step: int, body: Callable[[str], None]) -> None:
        """Write the loop for (i = begin; i + step <= size; i += step) body(i).

        `body` gets the LLVM name of i. `name` begins the loop's labels.
        """
        before, head, inside, after = f"{name}.before", f"{name}.head", f"{name}.inside", f"{name}.after"
        self.lines += [f"  br label %{before}", f"{before}:", f"  br label %{head}", f"{head}:"]
        self.lines.append(f"  %{name}.i = phi i64 [{begin}, %{before}], [%{name}.next, %{inside}]")
        self.lines.append(f"  %{name}.next = add i64 %{name}.i, {step}")
        self.lines.append(f"  %{name}.more = icmp sle i64 %{name}.next, %size")
        self.lines += [f"  br i1 %{name}.more, label %{inside}, label %{after}", f"{inside}:"]
        body(f"%{name}.i")
        self.lines += [f"  br label %{head}", f"{after}:"]


class MoverOptions(NamedTuple):
    """What a mover, a function that transposes an array of runs, moves, and how.

    bits: of a number. to_lanes: True to move rows of runs to SIMD lanes, False to move lanes to rows. in_squares: move
    squares of as many runs as entries. few_entries: entries of a run if they are fewer than FEW, else 0.
    """

    bits: int
    to_lanes: bool
    in_squares: bool
    few_entries: int

    @property
    def name(self) -> str:
        """Return the name of the mover in LLVM's text, such as take64 (rows to lanes) or give64 (lanes to rows)."""
        kind = f"{'take' if self.to_lanes else 'give'}{'f' if self.in_squares and self.bits < 64 else ''}{self.bits}"
        return f"{kind}x{self.few_entries}" if self.few_entries else kind


def write_mover(move: MoverOptions, width: int) -> str:
    """Return the LLVM text of a function that transposes an array of a block of runs, from rows to lanes or back.

    Runs of a compiled function are computed side by side, one in each SIMD lane. Their arrays are stored run by run,
    but the lanes need entry by entry, so arrays are transposed before and after a block of runs. `@take64` (for numbers
    of 64 bits) moves the array [run][entry], of `size` entries a run, to [entry][lane]; `@give64` moves it back. Its
    parameters are (ptr runs, ptr lanes, i64 size, i64 first, i64 last). Lane l is run first + l, or the last run if
    there are fewer: it then repeats the computation of that run.

    Args:
        move: bits of a number, the direction (`to_lanes`), and how numbers are moved: one by one, in squares of g x g
            numbers (`in_squares`), or by whole registers if a run has a small fixed number of entries (`few_entries`).
        width: number of lanes.
    """
    text, bits = TextLines(), move.bits
    # Runs are moved in groups: as many runs as a register has lanes if registers are used, else FEW.
    uses_registers = move.in_squares or bool(move.few_entries)
    group_size = min(REGISTER // bits if uses_registers else FEW, width)
    # If each lane has a run of its own, this code moves all entries and returns. Else the loops below move them.
    if move.few_entries and width > 1:
        _write_register_mover(text, move, group_size, width)
    for first_lane in range(0, width, group_size):
        # Addresses of the group's runs in memory.
        rows = _write_row_addresses(text, bits, range(first_lane, first_lane + group_size))
        group = _RunsInLanes(text, rows, width, first_lane, bits, move.to_lanes)
        first_entry = "0"
        # Squares of as many entries as the group has runs, then the remaining entries one by one.
        if move.in_squares and not move.few_entries:
            text.write_loop(f"g{first_lane}", "0", group_size, group.write_square)
            first_entry = text.add(f"and i64 %size, {-group_size}")  # size rounded down to a multiple of group_size
        text.write_loop(f"h{first_lane}", first_entry, 1, group.write_entry)
    body = "\n".join(text.lines)
    arguments = "ptr noalias %runs, ptr noalias %lanes, i64 %size, i64 %first, i64 %last"
    return f"define internal void @{move.name}({arguments}) noinline nounwind {{\n{body}\n  ret void\n}}\n"


def _write_row_addresses(text: TextLines, bits: int, lanes: range) -> list[str]:
    """Write the address of the first number of each lane's run, and return the names of the addresses.

    Runs lie one after another, each of `%size` numbers of `bits` bits. Lane 0 has run `%first`. A lane beyond the last
    run gets the address of the last run.
    """
    rows = []
    for lane in lanes:
        run = text.add(f"add i64 %first, {lane}")
        run = text.add(f"call i64 @llvm.smin.i64(i64 {run}, i64 %last)")
        start = text.add(f"mul i64 {run}, %size")
        rows.append(text.add(f"getelementptr i{bits}, ptr %runs, i64 {start}"))
    return rows


def _write_register_mover(text: TextLines, move: MoverOptions, group_size: int, width: int) -> None:
    """Write the transposition of n = `few_entries` entries of each run by whole registers, and the return after it.

    Runs are computed side by side in SIMD lanes; memory has them as [run][entry], the lanes need [entry][lane]. A group
    of g = `group_size` runs has n g numbers, one after another in memory, which fill n registers of g lanes. In the
    lanes' memory they also are n registers, one for each entry. So each register of the result picks its numbers from
    loaded ones. Of n = 2 entries a, b and g = 4 runs, the registers (a0 b0 a1 b1), (a2 b2 a3 b3) become (a0 a1 a2 a3),
    (b0 b1 b2 b3).

    This works if each lane has a run of its own. If some lanes repeat the last run, the program jumps to the label
    "singles", behind which entries are moved one by one. `text`: the lines of LLVM written so far; `width`: lanes of a
    vector.
    """
    n, g = move.few_entries, group_size
    # Branch: does the last lane, run first + width - 1, still have a run?
    text.lines.append(f"  %end = add i64 %first, {width - 1}")
    text.lines.append("  %whole = icmp sle i64 %end, %last")
    text.lines += ["  br i1 %whole, label %registers, label %singles", "registers:"]
    # Address of the first run, which is number first n of the array.
    start = text.add(f"mul i64 %first, {n}")
    start = text.add(f"getelementptr i{move.bits}, ptr %runs, i64 {start}")
    for first_lane in range(0, width, g):
        # Addresses of the group's registers: in rows of runs, and in lanes, where entry i has `width` numbers.
        in_rows = [text.add(_write_address(move.bits, start, first_lane * n + i * g)) for i in range(n)]
        in_lanes = [text.add(_write_address(move.bits, "%lanes", i * width + first_lane)) for i in range(n)]
        sources, targets = (in_rows, in_lanes) if move.to_lanes else (in_lanes, in_rows)
        # Number k of the targets is number positions[k] of the sources: a transposed table (g, n) or (n, g).
        shape = (g, n) if move.to_lanes else (n, g)
        positions = np.arange(n * g).reshape(shape).T
        # Load all registers. Position p is lane p mod g of register p div g.
        vector = f"<{g} x i{move.bits}>"
        loaded = [text.add(f"load {vector}, ptr {address}, align {move.bits // 8}") for address in sources]
        for target, positions_of_target in zip(targets, positions.reshape(n, g).tolist(), strict=True):
            registers_and_lanes = [divmod(position, g) for position in positions_of_target]
            chosen = _write_choice(text, loaded, registers_and_lanes, vector)
            text.lines.append(f"  store {vector} {chosen}, ptr {target}, align {move.bits // 8}")
    text.lines += ["  ret void", "singles:"]


def _write_address(bits: int, start: str, number: int) -> str:
    """Return LLVM's operation for the address of number `number`, each of `bits` bits, counted from address `start`."""
    return f"getelementptr i{bits}, ptr {start}, i64 {number}"


def _write_choice(text: TextLines, registers: list[str], sources: list[tuple[int, int]], vector: str) -> str:
    """Write the choice of a number for each lane out of several registers; return the name of the chosen vector.

    `sources` holds for each lane the pair (register, lane there) of its number. One shuffle is written for each
    register: a lane takes its number from that register, or keeps what was chosen before. A shuffle's mask numbers the
    lanes of its second vector from `side` on.
    """
    chosen, side = "poison", len(sources)  # a register of which no number is set
    for second in sorted({register for register, _ in sources}):
        order = [side + source if register == second else lane for lane, (register, source) in enumerate(sources)]
        mask = ", ".join(f"i32 {number}" for number in order)
        pair = f"{vector} {chosen}, {vector} {registers[second]}"
        chosen = text.add(f"shufflevector {pair}, <{side} x i32> <{mask}>")
    return chosen


class _RunsInLanes(NamedTuple):
    """Some runs that are moved together, from their rows to neighbouring lanes or back.

    text: gets the lines. rows: names of the addresses of the runs' first entries. width: lanes of a vector; the runs
    have the lanes from `first_lane` on. bits: of a number. to_lanes: move from rows to lanes, else from lanes to rows.
    """

    text: TextLines
    rows: list[str]
    width: int
    first_lane: int
    bits: int
    to_lanes: bool

    def write_square(self, i: str) -> None:
        """Write the transposition of a square, entries i to i + n - 1 of the n runs, n a power of two.

        Its rows (runs in memory, or entries in lanes) are loaded; halves are exchanged until each is a column, stored.
        """
        text, bits, side = self.text, self.bits, len(self.rows)
        vector, alignment = f"<{side} x i{bits}>", f"align {bits // 8}"
        # Addresses of entry i of each run; and in lanes, of the first lane of entry i + k: number (i + k) width + lane.
        in_rows = [text.add(f"getelementptr i{bits}, ptr {row}, i64 {i}") for row in self.rows]
        base = text.add(f"mul i64 {i}, {self.width}")
        base = text.add(f"getelementptr i{bits}, ptr %lanes, i64 {base}")
        offsets = [k * self.width + self.first_lane for k in range(side)]
        in_lanes = [text.add(f"getelementptr i{bits}, ptr {base}, i64 {offset}") for offset in offsets]
        sources, targets = (in_rows, in_lanes) if self.to_lanes else (in_lanes, in_rows)
        registers = [text.add(f"load {vector}, ptr {address}, {alignment}") for address in sources]
        # Transposed by halves: exchange the off-diagonal quarters, then those of each quarter, down to single numbers.
        half = side // 2
        while half:
            registers, half = _exchange_squares(text, registers, half, bits), half // 2
        for address, column in zip(targets, registers, strict=True):
            text.lines.append(f"  store {vector} {column}, ptr {address}, {alignment}")

    def write_entry(self, i: str) -> None:
        """Write the moves of entry i of each run, one number at a time: from its run into its lane, or back.

        `rows` holds the names of the runs' addresses. `to_lanes`: from runs into lanes.
        """
        text, bits = self.text, self.bits
        # Entry i of all lanes is a row of `width` numbers; the first of these runs has the lane `first_lane`.
        base = text.add(f"mul i64 {i}, {self.width}")
        base = text.add(f"add i64 {base}, {self.first_lane}")
        base = text.add(f"getelementptr i{bits}, ptr %lanes, i64 {base}")
        for lane, row in enumerate(self.rows):
            in_row = text.add(f"getelementptr i{bits}, ptr {row}, i64 {i}")
            in_lane = text.add(f"getelementptr i{bits}, ptr {base}, i64 {lane}")
            source, target = (in_row, in_lane) if self.to_lanes else (in_lane, in_row)
            number = text.add(f"load i{bits}, ptr {source}, align {bits // 8}")
            text.lines.append(f"  store i{bits} {number}, ptr {target}, align {bits // 8}")


def _exchange_squares(text: TextLines, rows: list[str], half: int, bits: int) -> list[str]:
    """Return rows (names of registers) with their off-diagonal squares of side `half` exchanged.

    That is one step of a transposition; the others have squares of half the side, and so on.
    """
    exchanged, side = rows[:], len(rows)
    for i in range(side):
        if i & half:
            continue
        # Row i keeps its left part and takes row j's left part for its right one; row j the right parts of both.
        j = i | half
        low = [k if not k & half else k - half + side for k in range(side)]
        high = [k + half if not k & half else k + side for k in range(side)]
        for row, order in ((i, low), (j, high)):
            mask = ", ".join(f"i32 {k}" for k in order)
            pair = f"<{side} x i{bits}> {rows[i]}, <{side} x i{bits}> {rows[j]}"
            exchanged[row] = text.add(f"shufflevector {pair}, <{side} x i32> <{mask}>")
    return exchanged
