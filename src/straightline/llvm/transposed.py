"""Transposition of arrays [run][entry] to [entry][lane] for a block of runs, and back, as text of LLVM IR.

Long numbers are moved in squares, of as many runs and entries as a register has, or as a vector has; others one by one.
"""

from collections.abc import Callable

REGISTER = 512  # bits of the largest one: a row of a square


class Lines:
    """Text with fresh names."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.count = 0

    def add(self, text: str) -> str:
        """Append an operation; return the new name of its result."""
        self.count += 1
        self.lines.append(f"  %x{self.count} = {text}")
        return f"%x{self.count}"

    def loop(self, name: str, begin: str, end: str, step: int, body: Callable[[str], None]) -> None:
        """Write a loop: for (i = begin; i + step <= end; i += step) body."""
        before, head, inside, after = f"{name}.before", f"{name}.head", f"{name}.inside", f"{name}.after"
        self.lines += [f"  br label %{before}", f"{before}:", f"  br label %{head}", f"{head}:"]
        self.lines.append(f"  %{name}.i = phi i64 [{begin}, %{before}], [%{name}.next, %{inside}]")
        self.lines.append(f"  %{name}.next = add i64 %{name}.i, {step}")
        self.lines.append(f"  %{name}.more = icmp sle i64 %{name}.next, {end}")
        self.lines += [f"  br i1 %{name}.more, label %{inside}, label %{after}", f"{inside}:"]
        body(f"%{name}.i")
        self.lines += [f"  br label %{head}", f"{after}:"]


def mover_name(bits: int, inwards: bool, squared: bool) -> str:
    """Return the name of a mover."""
    return f"{'take' if inwards else 'give'}{'f' if squared and bits < 64 else ''}{bits}"


def mover(bits: int, inwards: bool, squared: bool, width: int) -> str:
    """Write `void @take64(ptr runs, ptr lanes, i64 size, i64 first, i64 last)`, or `give64`, which moves back.

    Lane l is run first + l, or the last run if there are fewer: it then repeats the computation of that run.
    """
    text, name = Lines(), mover_name(bits, inwards, squared)
    bytes_ = bits // 8
    side = min(REGISTER // bits if squared else 8, width)
    for group in range(0, width, side):
        # Address of each lane's run.
        rows = []
        for lane in range(group, group + side):
            run = text.add(f"add i64 %first, {lane}")
            run = text.add(f"call i64 @llvm.smin.i64(i64 {run}, i64 %last)")
            start = text.add(f"mul i64 {run}, %size")
            rows.append(text.add(f"getelementptr i{bits}, ptr %runs, i64 {start}"))
        # Squares, then the remaining entries.
        start = "0"
        if squared:
            text.loop(f"g{group}", "0", "%size", side, _write_square(text, rows, width, group, bits, inwards))
            start = text.add(f"and i64 %size, {-side}")
        text.loop(f"h{group}", start, "%size", 1, _write_single(text, rows, width, group, bits, inwards))
    body = "\n".join(text.lines)
    arguments = "ptr noalias %runs, ptr noalias %lanes, i64 %size, i64 %first, i64 %last"
    return f"define internal void @{name}({arguments}) noinline nounwind {{\n{body}\n  ret void\n}} ; {bytes_}\n"


def _write_square(
    text: Lines, rows: list[str], width: int, group: int, bits: int, inwards: bool
) -> Callable[[str], None]:
    """Return what writes the move of entries i, i + 1, ... of as many runs: a square, from rows to lanes or back."""

    def body(i: str) -> None:
        """Write the transposition of one square: load its rows, exchange halves until each is a column, store."""
        vector = f"<{len(rows)} x i{bits}>"
        in_rows = [text.add(f"getelementptr i{bits}, ptr {row}, i64 {i}") for row in rows]
        base = text.add(f"mul i64 {i}, {width}")
        base = text.add(f"getelementptr i{bits}, ptr %lanes, i64 {base}")
        in_lanes = [text.add(f"getelementptr i{bits}, ptr {base}, i64 {k * width + group}") for k in range(len(rows))]
        sources, targets = (in_rows, in_lanes) if inwards else (in_lanes, in_rows)
        moved = [text.add(f"load {vector}, ptr {p}, align {bits // 8}") for p in sources]
        half = len(rows) // 2
        while half:
            moved, half = _exchange_squares(text, moved, half, bits), half // 2
        for p, x in zip(targets, moved, strict=True):
            text.lines.append(f"  store {vector} {x}, ptr {p}, align {bits // 8}")

    return body


def _exchange_squares(text: Lines, rows: list[str], half: int, bits: int) -> list[str]:
    """Return rows with the off-diagonal squares of side `half` exchanged: one step of a transposition."""
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


def _write_single(
    text: Lines, rows: list[str], width: int, group: int, bits: int, inwards: bool
) -> Callable[[str], None]:
    """Return what writes the move of entry i of each run, from its row to its lane or back."""

    def body(i: str) -> None:
        """Write the move of each lane, one after another."""
        base = text.add(f"mul i64 {i}, {width}")
        base = text.add(f"add i64 {base}, {group}")
        base = text.add(f"getelementptr i{bits}, ptr %lanes, i64 {base}")
        for lane, row in enumerate(rows):
            run = text.add(f"getelementptr i{bits}, ptr {row}, i64 {i}")
            here = text.add(f"getelementptr i{bits}, ptr {base}, i64 {lane}")
            source, target = (run, here) if inwards else (here, run)
            x = text.add(f"load i{bits}, ptr {source}, align {bits // 8}")
            text.lines.append(f"  store i{bits} {x}, ptr {target}, align {bits // 8}")

    return body
