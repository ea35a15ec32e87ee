"""Text of LLVM IR that depends on the number of lanes W: the types <W x T>, the lanes' numbers, and gathers."""

from functools import cache


@cache
def types(width: int) -> str:
    """Return the text that names each type <W x T> `%T`, and an integer of W bits `%lanes`."""
    vectors = [f"%{scalar} = type <{width} x {scalar}>\n" for scalar in ("double", "i64", "i32", "i8", "i1")]
    return "".join([*vectors, f"%lanes = type i{width}\n"])


# The address of the second vector of bytes from none is W.
WIDTH = "ptrtoint (ptr getelementptr (%i8, ptr null, i64 1) to i64)"


def lane_numbers(width: int) -> str:
    """Write `%i64 @hg_lanes()`: 0, 1, ... W - 1."""
    numbers = ", ".join(f"i64 {lane}" for lane in range(width))
    return f"define internal %i64 @hg_lanes() noinline nounwind {{\n  ret %i64 <{numbers}>\n}}\n"


def gather_name(bits: int, spread: bool) -> str:
    """Return the name of a gather."""
    return f"hg_gather{bits}_{'lanes' if spread else 'table'}"


def gather(bits: int, spread: bool, width: int) -> str:
    """Write `%i64 @hg_gather64_table(ptr start, %i64 places)`, a load for each lane; of its entries if `spread`."""
    vector, lines, total = f"%i{bits}", [], "poison"
    for lane in range(width):
        lines.append(f"%p{lane} = extractelement %i64 %places, i64 {lane}")
        row, index = (f"[{width} x i{bits}]", f", i64 {lane}") if spread else (f"i{bits}", "")
        lines.append(f"%a{lane} = getelementptr {row}, ptr %start, i64 %p{lane}{index}")
        lines.append(f"%x{lane} = load i{bits}, ptr %a{lane}, align {bits // 8}")
        lines.append(f"%r{lane} = insertelement {vector} {total}, i{bits} %x{lane}, i64 {lane}")
        total = f"%r{lane}"
    body = "".join(f"  {line}\n" for line in lines)
    head = f"define internal {vector} @{gather_name(bits, spread)}(ptr %start, %i64 %places) noinline nounwind"
    return f"{head} {{\n{body}  ret {vector} {total}\n}}\n"
