"""Text of LLVM IR that adds a block's results [entry][lane] to sums over runs [entry][batch].

Run r goes to batch r mod BATCHES. A row of sums is W - 1 longer than there are batches, so that the W consecutive runs
of a block never turn back to its beginning; what stands beyond its end is added to its beginning at last (`folded`).
"""

from typing import NamedTuple

import numpy as np


class Summed(NamedTuple):
    """Which outputs are summed, leaf by leaf; into how many batches; which input is the run's number (u32)."""

    outputs: tuple[bool, ...]
    batches: int
    number: int


def row_length(width: int, batches: int) -> int:
    """Numbers of a row of sums."""
    return batches + width - 1


def adder(width: int, batches: int) -> str:
    """`void @add64(ptr sums, ptr lanes, i64 size, i64 batch, i64 count)`: lanes from `count` on are left out."""
    vector, bits = f"<{width} x double>", f"<{width} x i1>"
    numbers = ", ".join(f"i64 {lane}" for lane in range(width))
    arguments = "ptr noalias %sums, ptr noalias %lanes, i64 %size, i64 %batch, i64 %count"
    return f"""define internal void @add64({arguments}) noinline nounwind {{
entry:
  %c0 = insertelement <{width} x i64> poison, i64 %count, i64 0
  %c = shufflevector <{width} x i64> %c0, <{width} x i64> poison, <{width} x i32> zeroinitializer
  %counted = icmp ult <{width} x i64> <{numbers}>, %c
  %start = getelementptr double, ptr %sums, i64 %batch
  br label %loop
loop:
  %i = phi i64 [0, %entry], [%next, %loop]
  %from = getelementptr {vector}, ptr %lanes, i64 %i
  %place = mul i64 %i, {row_length(width, batches)}
  %to = getelementptr double, ptr %start, i64 %place
  %new = load {vector}, ptr %from, align 8
  %old = load {vector}, ptr %to, align 8
  %more = select {bits} %counted, {vector} %new, {vector} zeroinitializer
  %total = fadd {vector} %old, %more
  store {vector} %total, ptr %to, align 8
  %next = add i64 %i, 1
  %again = icmp slt i64 %next, %size
  br i1 %again, label %loop, label %end
end:
  ret void
}}
"""


def folded(sums: np.ndarray, batches: int) -> np.ndarray:
    """Sums (..., batch) of rows (..., `row_length`)."""
    result = sums[..., :batches].copy()
    beyond = sums[..., batches:]
    result[..., : beyond.shape[-1]] += beyond
    return result
