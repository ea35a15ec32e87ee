"""Transposition of arrays [run][entry] to [entry][lane] for a block of runs, and back, as text of LLVM IR.

Long numbers are moved in squares, of as many runs and entries as a register has, or as a vector has. A few of each run
are registers one after another, whose numbers are exchanged: two of each take half of the time that they took one by
one. What is left is moved one by one.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

REGISTER = 512  # bits of the largest one: a row of a square
FEW = 8  # entries of a run from which on squares of the largest registers are filled


class TextLines:
    """Text with fresh names."""

    def __init__(self) -> None:
        """Begin a text without lines; `count` is the number of names made so far."""
        self.lines: list[str] = []
        self.count = 0

    def add(self, text: str) -> str:
        """Append an operation in LLVM's text; return the new name of its result."""
        self.count += 1
        self.lines.append(f"  %x{self.count} = {text}")
        return f"%x{self.count}"

    def write_loop(self, name: str, begin: str, end: str, step: int, body: Callable[[str], None]) -> None:
        """Write a loop: for (i = begin; i + step <= end; i += step) body(i), i a name; `name` begins its labels."""
        before, head, inside, after = f"{name}.before", f"{name}.head", f"{name}.inside", f"{name}.after"
        self.lines += [f"  br label %{before}", f"{before}:", f"  br label %{head}", f"{head}:"]
        self.lines.append(f"  %{name}.i = phi i64 [{begin}, %{before}], [%{name}.next, %{inside}]")
        self.lines.append(f"  %{name}.next = add i64 %{name}.i, {step}")
        self.lines.append(f"  %{name}.more = icmp sle i64 %{name}.next, {end}")
        self.lines += [f"  br i1 %{name}.more, label %{inside}, label %{after}", f"{inside}:"]
        body(f"%{name}.i")
        self.lines += [f"  br label %{head}", f"{after}:"]


class MoverOptions(NamedTuple):
    """What a mover moves: numbers of so many bits, to lanes or back, and how.

    `squared`: in squares. `few`: entries of a run where they are fewer than FEW, 0 where they are not.
    """

    bits: int
    inwards: bool
    squared: bool
    few: int

    @property
    def name(self) -> str:
        """Return the name of the mover."""
        kind = f"{'take' if self.inwards else 'give'}{'f' if self.squared and self.bits < 64 else ''}{self.bits}"
        return f"{kind}x{self.few}" if self.few else kind


def write_mover(move: MoverOptions, width: int) -> str:
    """Return the LLVM text of `void @take64(ptr runs, ptr lanes, i64 size, i64 first, i64 last)`, or of `give64`.

    `take` moves arrays [run][entry], of `size` entries a run, to [entry][lane]; `give` moves them back. Lane l is run
    first + l, or the last run if there are fewer: it then repeats the computation of that run.
    """
    text, bits = TextLines(), move.bits
    side = min(REGISTER // bits if move.squared or move.few else FEW, width)  # runs that are moved together: a group
    if move.few and width > 1:
        _write_register_mover(text, move, side, width)
    for group in range(0, width, side):
        rows = _write_row_addresses(text, bits, range(group, group + side))
        first_entry = "0"
        # Squares of `side` runs and as many entries, then the remaining entries one by one.
        if move.squared and not move.few:
            write_square = _make_square_transposer(text, rows, width, group, bits, move.inwards)
            text.write_loop(f"g{group}", "0", "%size", side, write_square)
            first_entry = text.add(f"and i64 %size, {-side}")  # size rounded down to a multiple of side
        write_entry = _make_entry_mover(text, rows, width, group, bits, move.inwards)
        text.write_loop(f"h{group}", first_entry, "%size", 1, write_entry)
    body = "\n".join(text.lines)
    arguments = "ptr noalias %runs, ptr noalias %lanes, i64 %size, i64 %first, i64 %last"
    return f"define internal void @{move.name}({arguments}) noinline nounwind {{\n{body}\n  ret void\n}}\n"


def _write_row_addresses(text: TextLines, bits: int, lanes: range) -> list[str]:
    """Write the address of the first entry of each lane's run; return their names. Lanes beyond it have the last run's.

    Runs lie one after another, `%size` numbers of so many bits each; lane 0 has run `%first`.
    """
    rows = []
    for lane in lanes:
        run = text.add(f"add i64 %first, {lane}")
        run = text.add(f"call i64 @llvm.smin.i64(i64 {run}, i64 %last)")
        start = text.add(f"mul i64 {run}, %size")
        rows.append(text.add(f"getelementptr i{bits}, ptr %runs, i64 {start}"))
    return rows


def _write_register_mover(text: TextLines, move: MoverOptions, side: int, width: int) -> None:
    """Write the move of few entries of a block in which each lane has a run of its own, and the return after it.

    The runs of a group, `side` of them, have all their entries one after another in memory. These are loaded as whole
    registers of `side` numbers; each register of the result gathers its numbers from the loaded ones. Where lanes
    repeat the last run, the text goes on at "singles", which moves entries one by one.
    """
    text.lines.append(f"  %end = add i64 %first, {width - 1}")
    text.lines.append("  %whole = icmp sle i64 %end, %last")
    text.lines += ["  br i1 %whole, label %registers, label %singles", "registers:"]
    start = text.add(f"mul i64 %first, {move.few}")
    start = text.add(f"getelementptr i{move.bits}, ptr %runs, i64 {start}")
    for group in range(0, width, side):
        runs = [text.add(_write_address(move.bits, start, group * move.few + i * side)) for i in range(move.few)]
        lanes = [text.add(_write_address(move.bits, "%lanes", i * width + group)) for i in range(move.few)]
        sources, targets = (runs, lanes) if move.inwards else (lanes, runs)
        # For each number of the targets, in order, its place among all numbers of the sources: the transpose of a table
        # with a row for each run (its entries) or for each entry (its lanes).
        numbers = np.arange(move.few * side)
        in_sources = numbers.reshape(side, move.few).T if move.inwards else numbers.reshape(move.few, side).T
        vector = f"<{side} x i{move.bits}>"
        loaded = [text.add(f"load {vector}, ptr {p}, align {move.bits // 8}") for p in sources]
        for target, places in zip(targets, in_sources.reshape(move.few, side).tolist(), strict=True):
            chosen = _write_choice(text, loaded, [divmod(place, side) for place in places], vector)
            text.lines.append(f"  store {vector} {chosen}, ptr {target}, align {move.bits // 8}")
    text.lines += ["  ret void", "singles:"]


def _write_address(bits: int, start: str, number: int) -> str:
    """Return the operation that makes the address of a number behind a start."""
    return f"getelementptr i{bits}, ptr {start}, i64 {number}"


def _write_choice(text: TextLines, registers: list[str], places: list[tuple[int, int]], vector: str) -> str:
    """Write the choice of numbers out of registers; return the name of the register that has them, lane by lane.

    By one shuffle for each register: of what was chosen so far and its own numbers, which a mask counts from `side` on.

    places: for each lane the number of the register that has its number, and the place there.
    """
    chosen, side = "poison", len(places)
    for number in sorted({register for register, _ in places}):
        order = [side + place if register == number else lane for lane, (register, place) in enumerate(places)]
        mask = ", ".join(f"i32 {place}" for place in order)
        pair = f"{vector} {chosen}, {vector} {registers[number]}"
        chosen = text.add(f"shufflevector {pair}, <{side} x i32> <{mask}>")
    return chosen


def _make_square_transposer(
    text: TextLines, rows: list[str], width: int, group: int, bits: int, inwards: bool
) -> Callable[[str], None]:
    """Return a function that writes the move of one square: entries i to i + n - 1 of n runs, to lanes or back.

    A square is n x n numbers, whose rows are runs in a caller's array and entries in lanes.

    Args:
        text: where it is written.
        rows: names of the addresses of the n runs' first entries, n a power of two.
        width: lanes of a vector.
        group: the lane of the first of these runs.
        bits: of a number.
        inwards: whether from runs to lanes.

    Returns:
        The function of the name of i.
    """

    def write_square(i: str) -> None:
        """Write the transposition of one square: load its rows, exchange halves until each is a column, store."""
        vector = f"<{len(rows)} x i{bits}>"
        # Entry i of each run; and in lanes, lane `group` of each entry: number (i + k) width + group for entry i + k.
        in_rows = [text.add(f"getelementptr i{bits}, ptr {row}, i64 {i}") for row in rows]
        base = text.add(f"mul i64 {i}, {width}")
        base = text.add(f"getelementptr i{bits}, ptr %lanes, i64 {base}")
        in_lanes = [text.add(f"getelementptr i{bits}, ptr {base}, i64 {k * width + group}") for k in range(len(rows))]
        sources, targets = (in_rows, in_lanes) if inwards else (in_lanes, in_rows)
        moved = [text.add(f"load {vector}, ptr {address}, align {bits // 8}") for address in sources]
        # Transposed by halves: exchange the off-diagonal quarters, then those of each quarter, down to single numbers.
        half = len(rows) // 2
        while half:
            moved, half = _exchange_squares(text, moved, half, bits), half // 2
        for address, column in zip(targets, moved, strict=True):
            text.lines.append(f"  store {vector} {column}, ptr {address}, align {bits // 8}")

    return write_square


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


def _make_entry_mover(
    text: TextLines, rows: list[str], width: int, group: int, bits: int, inwards: bool
) -> Callable[[str], None]:
    """Return a function that writes the move of entry i of each run, to its lane or back; arguments as above."""

    def write_entry(i: str) -> None:
        """Write the move of entry i of each lane, one after another: from its run to the lanes, or back.

        Entry i of `width` lanes is a row of them, of which these, `group` and on, are moved.
        """
        base = text.add(f"mul i64 {i}, {width}")
        base = text.add(f"add i64 {base}, {group}")
        base = text.add(f"getelementptr i{bits}, ptr %lanes, i64 {base}")
        for lane, row in enumerate(rows):
            run = text.add(f"getelementptr i{bits}, ptr {row}, i64 {i}")
            here = text.add(f"getelementptr i{bits}, ptr {base}, i64 {lane}")
            source, target = (run, here) if inwards else (here, run)
            number = text.add(f"load i{bits}, ptr {source}, align {bits // 8}")
            text.lines.append(f"  store i{bits} {number}, ptr {target}, align {bits // 8}")

    return write_entry
