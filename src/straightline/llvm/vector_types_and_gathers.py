"""Text of LLVM IR that depends on the number of lanes W, or on the machine: types <W x T>, gathers, subnormals."""

import platform
from functools import cache

from straightline.llvm.transposition import TextLines


@cache
def write_vector_types(width: int) -> str:
    """Return the LLVM text that defines the vector types of `width` lanes, such as %double, and the integer %lanes.

    %lanes has a bit for each lane. The rest of a program's text uses these names, so that one text serves any width.
    """
    vectors = [f"%{scalar} = type <{width} x {scalar}>\n" for scalar in ("double", "float", "i64", "i32", "i8", "i1")]
    return "".join([*vectors, f"%lanes = type i{width}\n"])


# W as a number: the size of a vector of bytes.
WIDTH = "ptrtoint (ptr getelementptr (%i8, ptr null, i64 1) to i64)"


def write_lane_numbers(width: int) -> str:
    """Return the LLVM text of the function `%i64 @hg_lanes()`, which returns 0, 1, ..., width - 1, one in each lane."""
    numbers = ", ".join(f"i64 {lane}" for lane in range(width))
    return f"define internal %i64 @hg_lanes() noinline nounwind {{\n  ret %i64 <{numbers}>\n}}\n"


def gather_name(bits: int, has_lanes: bool) -> str:
    """Return the name of the function that loads, for each SIMD lane, a number of `bits` bits by the lane's own index.

    `has_lanes`: the memory has a number for each lane at each index; else it is a table that all lanes share.
    """
    return f"hg_gather{bits}_{'lanes' if has_lanes else 'table'}"


def write_gather(bits: int, has_lanes: bool, width: int) -> str:
    """Return the LLVM text of a function that loads, for each of `width` SIMD lanes, a number by the lane's own index.

    Its head is like `%i64 @hg_gather64_table(ptr %start, %i64 %places)`. Numbers have `bits` bits. If `has_lanes`, the
    memory has at each index one number for each lane, and each lane loads its own.
    """
    # The vector begins without numbers ("poison"), and each lane is inserted.
    vector, text, gathered = f"%i{bits}", TextLines(), "poison"
    row = f"[{width} x i{bits}]" if has_lanes else f"i{bits}"
    for lane in range(width):
        index = text.add(f"extractelement %i64 %places, i64 {lane}")
        in_row = f", i64 {lane}" if has_lanes else ""
        address = text.add(f"getelementptr {row}, ptr %start, i64 {index}{in_row}")
        number = text.add(f"load i{bits}, ptr {address}, align {bits // 8}")
        gathered = text.add(f"insertelement {vector} {gathered}, i{bits} {number}, i64 {lane}")
    head = f"define internal {vector} @{gather_name(bits, has_lanes)}(ptr %start, %i64 %places) noinline nounwind"
    body = "\n".join(text.lines)
    return f"{head} {{\n{body}\n  ret {vector} {gathered}\n}}\n"


FLUSH = 0x8040  # of the control word of x86: results and arguments that are subnormal are zeros
X86 = ("x86_64", "amd64", "i386", "i686")


def write_subnormal_flush(width: int) -> str:
    """Return the LLVM text of two functions, `i32 @hg_flush()` and `void @hg_restore(i32)`.

    After the first, the processor takes subnormal numbers for zeros; it returns the processor's former state, which the
    second restores. An operation on subnormal numbers takes x86 a hundred times as long, and in single precision they
    are not rare, from 1e-38 down; XLA's code takes them for zeros too. Other processors take no longer for them: there
    both functions do nothing. The width is not used.
    """
    if platform.machine().lower() not in X86:
        flush, restore = "  ret i32 0\n", "  ret void\n"
    else:
        flush = f"""  %place = alloca i32
  call void @llvm.x86.sse.stmxcsr(ptr %place)
  %before = load i32, ptr %place
  %after = or i32 %before, {FLUSH}
  store i32 %after, ptr %place
  call void @llvm.x86.sse.ldmxcsr(ptr %place)
  ret i32 %before
"""
        restore = """  %place = alloca i32
  store i32 %before, ptr %place
  call void @llvm.x86.sse.ldmxcsr(ptr %place)
  ret void
"""
    return f"""define internal i32 @hg_flush() noinline nounwind {{
{flush}}}
define internal void @hg_restore(i32 %before) noinline nounwind {{
{restore}}}
"""
