"""Scalar operations as text of LLVM IR, on vectors <W x T> of as many runs.

A text names the type <W x T> by `%T` and leaves W open: `vector_types_and_gathers.py` defines the names, and with them
W. The compiler decides nothing: a product and a sum are one fused operation only where the text says so, so that the
bits of a result depend neither on the width nor on the level of optimisation.
"""

import struct
from collections.abc import Callable

from straightline.nodes import REAL, Node, Type, Unsupported
from straightline.vectors.elementary_functions import FUNCTIONS, SCALAR

LLVM = {"f64": "double", "f32": "float", "bool": "i1", "i32": "i32", "i64": "i64", "u32": "i32", "u64": "i64"}
BITS = {"f64": 64, "f32": 32, "bool": 8, "i32": 32, "i64": 64, "u32": 32, "u64": 64}  # in memory
FLOAT = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}
INTEGER = {"add": "add", "sub": "sub", "mul": "mul", "and": "and", "or": "or", "xor": "xor"}
ORDER = {"eq": "eq", "ne": "ne", "lt": "lt", "le": "le", "gt": "gt", "ge": "ge"}
UNARY = {
    "sqrt": "sqrt",
    "abs": "fabs",
    "floor": "floor",
    "ceil": "ceil",
    "round_even": "roundeven",
    "round_away": "round",
}
CALLED = {*FUNCTIONS, *SCALAR, "threefry"}  # functions of their own, `hg_` before the name

Emit = Callable[[str], str]  # the text of an operation -> the name of its result


def vector_type(type: Type) -> str:
    """Return LLVM's name of a vector with a number of this type in each of its W lanes, such as %double."""
    return f"%{LLVM[type]}"


def write_literal(value: float | int | bool, type: Type) -> str:
    """Return the LLVM text of a constant number; LLVM writes a real one, even a float, by its bits as a double."""
    if type in REAL:
        return "0x" + struct.pack(">d", float(value)).hex().upper()
    if type == "bool":
        return "true" if value else "false"
    return str(int(value))


def write_splat(value: float | int | bool, type: Type) -> str:
    """Return the LLVM text of a vector that has a constant in all lanes, such as splat (i64 3)."""
    return f"splat ({LLVM[type]} {write_literal(value, type)})"


def write_operation(node: Node, names: list[str], emit: Emit) -> str:
    """Write a node's operation in LLVM IR for all lanes; return the name of the result.

    A node is one operation on numbers, such as a sum; in the text it acts on vectors with one run in each SIMD lane.

    Args:
        node: the operation, with its arguments and types.
        names: names of its arguments in the text.
        emit: appends an instruction and returns the name of its result.

    Raises:
        Unsupported: an operation that has no text here.
    """
    source: Type = node.args[0].type if node.args else node.type
    operand_type = vector_type(source)
    op, result_type = node.op, vector_type(node.type)
    # Sums, products and such of real numbers, and the choice between two.
    if source in REAL and op in FLOAT:
        return emit(f"{FLOAT[op]} {operand_type} {names[0]}, {names[1]}")
    if op == "select":
        return emit(f"select {operand_type} {names[0]}, {result_type} {names[1]}, {result_type} {names[2]}")
    # Comparisons and conversions depend on the type of the arguments.
    if op in ORDER:
        return emit(f"{_write_comparison(op, source)} {operand_type} {names[0]}, {names[1]}")
    if op == "convert":
        return _write_conversion(source, node.type, names[0], emit)
    if op == "bitcast":
        return emit(f"bitcast {operand_type} {names[0]} to {result_type}")
    if op == "not":
        all_bits = write_splat(True, "bool") if source == "bool" else write_splat(-1, source)
        return emit(f"xor {operand_type} {names[0]}, {all_bits}")
    # Functions that are written as LLVM functions of their own, then arithmetic by type.
    if op in CALLED:
        typed = ", ".join(f"{vector_type(a.type)} {n}" for a, n in zip(node.args, names, strict=True))
        return emit(f"call {result_type} @hg_{name_called_function(node)}({typed})")
    return (_write_float_operation if source in REAL else _write_integer_operation)(node, names, operand_type, emit)


def name_called_function(node: Node) -> str:
    """Return the name of the function that computes an operation: in single precision it ends in f, as in C."""
    return f"{node.op}f" if node.type == "f32" else node.op


def _write_comparison(op: str, type: Type) -> str:
    """Return LLVM's instruction for a comparison of numbers of this type.

    With NaN, `ne` is true ("une": unordered or not equal). All other comparisons are then false ("o": ordered).
    """
    if type in REAL:
        return "fcmp une" if op == "ne" else f"fcmp o{op}"
    if op in ("eq", "ne"):
        return f"icmp {op}"
    return f"icmp {'u' if type in ('u32', 'u64', 'bool') else 's'}{op}"


def _write_float_operation(node: Node, names: list[str], text: str, emit: Emit) -> str:
    """Write an operation on vectors of real numbers; return the name of its result.

    `names` are those of the arguments, `text` their vector type in LLVM IR; `emit` appends an instruction.
    """
    op, type, first = node.op, node.args[0].type, f"{text} {names[0]}"
    if op == "neg":
        return emit(f"fneg {first}")
    if op in UNARY:
        return emit(f"call {text} @llvm.{UNARY[op]}({first})")
    # maximum and minimum of IEEE 754-2019: NaN if either is.
    if op in ("max", "min"):
        return emit(f"call {text} @llvm.{op}imum({first}, {text} {names[1]})")
    if op == "is_finite":
        size = emit(f"call {text} @llvm.fabs({first})")
        return emit(f"fcmp olt {text} {size}, {write_splat(float('inf'), type)}")
    # sign x = 1 or -1, but x itself for zeros and NaN ("one": ordered and not equal, so that NaN is not).
    if op == "sign":
        signed = emit(f"call {text} @llvm.copysign({text} {write_splat(1.0, type)}, {first})")
        is_nonzero = emit(f"fcmp one {first}, {write_splat(0.0, type)}")
        return emit(f"select {vector_type('bool')} {is_nonzero}, {text} {signed}, {first}")
    if op == "rem":
        return emit(f"frem {first}, {names[1]}")
    raise Unsupported(op)


def _write_integer_operation(node: Node, names: list[str], text: str, emit: Emit) -> str:
    """Write an operation on vectors of integers or flags; return the name of its result.

    `names` are those of the arguments, `text` their vector type in LLVM IR; `emit` appends an instruction.
    """
    op, type, first = node.op, node.args[0].type, f"{text} {names[0]}"
    is_signed = type.startswith("i")
    prefix = "s" if is_signed else "u"  # of LLVM's functions of signed and of unsigned numbers
    if op in INTEGER:
        return emit(f"{INTEGER[op]} {first}, {names[1]}")
    if op == "neg":
        return emit(f"sub {text} zeroinitializer, {names[0]}")
    # The max of flags is "or", the min is "and". LLVM's own max and min of flags end the process where it generates
    # code quickly, without optimising, for AVX-512.
    if type == "bool" and op in ("max", "min"):
        return emit(f"{'or' if op == 'max' else 'and'} {first}, {names[1]}")
    if op in ("max", "min"):
        return emit(f"call {text} @llvm.{prefix}{op}({first}, {text} {names[1]})")
    if op == "abs" and is_signed:
        return emit(f"call {text} @llvm.abs({first}, i1 false)")
    # sign x = x limited to [-1, 1], of unsigned numbers to [0, 1].
    if op == "sign":
        limited = emit(f"call {text} @llvm.{prefix}min({first}, {text} {write_splat(1, type)})")
        return (
            emit(f"call {text} @llvm.smax({text} {limited}, {text} {write_splat(-1, type)})") if is_signed else limited
        )
    if op in ("div", "rem"):
        return _write_division(node, names, text, emit)
    if op in ("shift_left", "shift_right", "shift_right_signed"):
        return _write_shift(node, names, text, emit)
    raise Unsupported(f"{op} of {type}")


def _write_division(node: Node, names: list[str], text: str, emit: Emit) -> str:
    """Write a / b or a % b of integers; return the name of its result.

    As in JAX, a / 0 has all bits set and a % 0 is a; the least number by -1 is itself, with the rest 0.
    `names` are those of a and b in the text, `text` their vector type; `emit` appends an instruction.
    """
    op, type, (a, b) = node.op, node.args[0].type, names
    instruction = f"{'s' if type[0] == 'i' else 'u'}{op}"
    if node.args[1].op == "constant" and node.args[1].value not in (0, -1):
        return emit(f"{instruction} {text} {a}, {b}")
    # What LLVM does not define is divided by 1, which has the right result of the least number by -1.
    flags = vector_type("bool")
    is_zero = undefined = emit(f"icmp eq {text} {b}, zeroinitializer")
    if type[0] == "i":
        undefined = emit(f"or {flags} {is_zero}, {emit(f'icmp eq {text} {b}, {write_splat(-1, type)}')}")
        is_least = emit(f"icmp eq {text} {a}, {write_splat(-(2 ** (BITS[type] - 1)), type)}")
        undefined = emit(f"and {flags} {undefined}, {emit(f'or {flags} {is_zero}, {is_least}')}")
    divisor = emit(f"select {flags} {undefined}, {text} {write_splat(1, type)}, {text} {b}")
    divided = emit(f"{instruction} {text} {a}, {divisor}")
    by_zero = write_splat(-1, type) if op == "div" else a
    return emit(f"select {flags} {is_zero}, {text} {by_zero}, {text} {divided}")


def _write_shift(node: Node, names: list[str], text: str, emit: Emit) -> str:
    """Write a shift of integers, and return the name of its result.

    A shift by all bits or more leaves 0, or copies of the sign if it is arithmetic. LLVM does not define such a shift.
    `names`: of the number and of the shift. `text`: the vector's type. `emit` appends an operation.
    """
    type, (a, b), shift = node.args[0].type, names, node.args[1]
    instruction = {"shift_left": "shl", "shift_right": "lshr"}.get(node.op, "ashr")
    if shift.op == "constant" and 0 <= shift.value < BITS[type]:
        return emit(f"{instruction} {text} {a}, {b}")
    # An arithmetic shift by all bits but one leaves only copies of the sign; others by too many bits become 0 below.
    clamped_shift = emit(f"call {text} @llvm.umin({text} {b}, {text} {write_splat(BITS[type] - 1, type)})")
    shifted = emit(f"{instruction} {text} {a}, {clamped_shift}")
    if instruction == "ashr":
        return shifted
    in_range = emit(f"icmp ult {text} {b}, {write_splat(BITS[type], type)}")
    return emit(f"select {vector_type('bool')} {in_range}, {text} {shifted}, {text} zeroinitializer")


def _write_conversion(source: Type, target: Type, name: str, emit: Emit) -> str:
    """Write a conversion between types; return the name of its result.

    `name` is the number's in the text; `emit` appends an instruction. A real number as an integer is truncated, the
    type's limit where it is beyond, and 0 of NaN (LLVM's `.sat`).
    """
    operand_type, result_type = vector_type(source), vector_type(target)
    if source == target or LLVM[source] == LLVM[target]:
        return name
    if source in REAL and target in REAL:
        return emit(f"{'fpext' if target == 'f64' else 'fptrunc'} {operand_type} {name} to {result_type}")
    if target in REAL:
        return emit(f"{'sitofp' if source[0] == 'i' else 'uitofp'} {operand_type} {name} to {result_type}")
    if source in REAL:
        instruction = "fptosi" if target[0] == "i" else "fptoui"
        return emit(f"call {result_type} @llvm.{instruction}.sat({operand_type} {name})")
    if BITS[target] < BITS[source]:
        return emit(f"trunc {operand_type} {name} to {result_type}")
    return emit(f"{'sext' if source[0] == 'i' else 'zext'} {operand_type} {name} to {result_type}")


def write_fused(node: Node, product: Node, names: list[str], emit: Emit) -> str:
    """Write a b + c, c - a b or a b - c, rounded once, and return the name of the result.

    `names` are those of a, b and c. `product` is the node of a b. A difference whose second argument is the product
    is c - a b; one whose first argument is the product is a b - c.
    """
    reals = vector_type(node.type)
    a, b, c = names
    if node.op == "sub":
        if node.args[1] is product:
            a = emit(f"fneg {reals} {a}")
        else:
            c = emit(f"fneg {reals} {c}")
    return emit(f"call {reals} @llvm.fma({reals} {a}, {reals} {b}, {reals} {c})")
