"""Simplification of scalar operations as they are made: constants are computed, x + 0 is x, -(-x) is x.

A product with zero is zero only if the other factor is known to be finite: data may be NaN. In a product of matrices a
known zero leaves its term out (`rules/matrices.py`).
"""

import math
import operator
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from straightline.nodes import REAL, Node, Number, Type

COMMUTATIVE = frozenset(("add", "mul", "max", "min", "and", "or", "xor", "eq", "ne"))
DTYPES: dict[str, Any] = {
    "f64": np.float64,
    "f32": np.float32,
    "bool": np.bool_,
    "i32": np.int32,
    "i64": np.int64,
    "u32": np.uint32,
    "u64": np.uint64,
}


class NodeMaker(Protocol):
    """A program that makes nodes; `never_nan` are those that are known not to be NaN."""

    never_nan: set[Node]

    def node(self, op: str, type: Type, *args: Node, value: Any = None) -> Node:
        """Return the node of an operation."""

    def constant(self, value: Number, type: Type) -> Node:
        """Return the node of a constant."""


def wrap_integer(number: int, like: Any) -> Any:
    """Return the lowest bits of a number as an integer of the type of `like`, as overflowing arithmetic does."""
    integer_type, bits = type(like), 8 * like.itemsize
    lowest_bits = number % (1 << bits)
    is_negative = lowest_bits > np.iinfo(integer_type).max  # as a signed number in two's complement
    return integer_type(lowest_bits - (1 << bits) if is_negative else lowest_bits)


def _shift_left(a: Any, b: Any) -> Any:
    """Return the integer a << b in the type of a; 0 where b is negative or at least the type's number of bits."""
    return wrap_integer(int(a) << int(b), a) if 0 <= b < 8 * a.itemsize else a * 0


def _shift_right(a: Any, b: Any) -> Any:
    """Return the integer a >> b with zeros from the left; 0 where b is negative or at least the type's bits."""
    bits = 8 * a.itemsize
    return wrap_integer(int(a) % (1 << bits) >> int(b), a) if 0 <= b < bits else a * 0


def _shift_right_signed(a: Any, b: Any) -> Any:
    """Return a >> b, filled from the left with copies of the highest bit of a, even if a is unsigned.

    If b is negative, or at least the number of bits, every bit of the result is such a copy.
    """
    highest = 8 * a.itemsize - 1  # number of the highest bit
    is_negative = int(a) >> highest == 1  # an unsigned number whose highest bit is set is read as one below zero
    signed = int(a) - (1 << highest + 1) if is_negative else int(a)
    shift = int(b) if 0 <= b <= highest else highest
    return wrap_integer(signed >> shift, a)


def _divide(a: Any, b: Any) -> Any:
    """Return a / b as XLA does; integers are rounded toward zero.

    An integer divided by 0 gives -1 (all bits set). The least integer divided by -1 overflows to itself.
    """
    if isinstance(a, np.floating):
        return np.divide(a, b)
    return wrap_integer(_divide_toward_zero(int(a), int(b)) if b else -1, a)


def _remainder(a: Any, b: Any) -> Any:
    """Return the remainder of a / b, which has the sign of a; an integer's remainder by 0 is a itself."""
    if isinstance(a, np.floating):
        return np.fmod(a, b)
    return wrap_integer(int(a) - _divide_toward_zero(int(a), int(b)) * int(b) if b else int(a), a)


def _divide_toward_zero(a: int, b: int) -> int:
    """Return a / b rounded toward zero."""
    return abs(a) // abs(b) * (1 if (a < 0) == (b < 0) else -1)


def _maximum(a: Any, b: Any) -> Any:
    """Return the larger number, 0 of two zeros unless both are -0; NaN if either is."""
    return a + b if a == b == 0 and isinstance(a, np.floating) else np.maximum(a, b)


def _minimum(a: Any, b: Any) -> Any:
    """Return the smaller number, -0 of two zeros unless both are 0; NaN if either is."""
    return -_maximum(-a, -b) if isinstance(a, np.floating) else np.minimum(a, b)


def _sign(a: Any) -> Any:
    """Return 1 or -1 by the sign of a number; a zero, of either sign, as it is."""
    return a if a == 0 else np.sign(a)


def _round_away(a: Any) -> Any:
    """Return the whole number nearest to a, as a real number; of halves the one further from zero."""
    whole = np.trunc(a)
    return whole + np.copysign(1.0, a) if np.abs(a - whole) >= 0.5 else whole


def _power(a: Any, b: Any) -> Any:
    """Return a^b as the C library does, by math.pow.

    NumPy's power is not used: for b = 1/2 it takes the square root, which differs at -0 and -infinity. Where math.pow
    raises an error, NumPy's infinity or NaN is also the C library's result.
    """
    try:
        return type(a)(math.pow(a, b))
    except (ValueError, OverflowError):
        return np.power(a, b)


def _convert_number(a: Any, kind: Any) -> Any:
    """Return a number converted to the type `kind`.

    A real number is truncated to an integer. Beyond the integer type's limits it becomes the limit, and NaN becomes 0.
    """
    if not isinstance(a, np.floating) or kind in (np.float64, np.float32, np.bool_):
        return a.astype(kind)
    limits = np.iinfo(kind)
    if np.isnan(a):
        return kind(0)
    return kind(limits.max if a >= limits.max else limits.min if a <= limits.min else int(a))


# Operations whose numbers of known numbers are computed here; others wait for the run.
EVALUATED: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": _divide, "rem": _remainder, "neg": np.negative,
    "abs": np.abs, "sqrt": np.sqrt, "exp": np.exp, "log": np.log, "log1p": np.log1p, "expm1": np.expm1,
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "tanh": np.tanh, "atan2": np.arctan2, "pow": _power,
    "round_even": np.rint, "round_away": _round_away,
    "floor": np.floor, "ceil": np.ceil, "sign": _sign, "is_finite": np.isfinite,
    "max": _maximum, "min": _minimum,
    "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal,
    "and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor, "not": np.invert,
    "shift_left": _shift_left, "shift_right": _shift_right,
    "shift_right_signed": _shift_right_signed,
}  # fmt: skip


def fold_node(graph: NodeMaker, op: str, type: Type, args: tuple[Node, ...]) -> Node | None:
    """Return a simpler node of the same value as op(args), or None if there is none.

    It is a constant if all arguments are. SIMPLER holds a rule for each operation that can be simplified.
    """
    if all(a.op == "constant" for a in args):
        return _evaluate(graph, op, type, args)
    rule = SIMPLER.get(op)
    return None if rule is None else rule(graph, type, *args)


# The same of doubles, as Python computes them in a tenth of the time: of a matrix's known zeros there are millions.
OF_DOUBLES: dict[str, Callable[[float, float], float]] = {
    "add": operator.add, "sub": operator.sub, "mul": operator.mul,
}  # fmt: skip


def _evaluate(graph: NodeMaker, op: str, type: Type, args: tuple[Node, ...]) -> Node | None:
    """Return the node of the constant that an operation on constant nodes gives; None if it is left to the run."""
    if type == "f64" and op in OF_DOUBLES:
        return graph.constant(OF_DOUBLES[op](float(args[0].value), float(args[1].value)), type)
    numbers = [DTYPES[a.type](a.value) for a in args]
    with np.errstate(all="ignore"):
        if op == "select":
            return args[1] if numbers[0] else args[2]
        if op == "convert":
            value = _convert_number(numbers[0], DTYPES[type])
        elif op == "bitcast":
            value = numbers[0].view(DTYPES[type])
        elif op in EVALUATED:
            value = EVALUATED[op](*numbers)
        else:
            return None
    return graph.constant(value.item(), type)


def _is_zero(node: Node) -> bool:
    """Return whether a node (an operation of the program) is the constant 0."""
    return bool(node.op == "constant" and node.value == 0)


def is_finite(node: Node) -> bool:
    """Return whether a number is known to be finite (neither NaN nor infinite) whatever the data.

    False means that it is not known.
    """
    if node.type not in REAL or (node.op == "constant" and math.isfinite(node.value)):
        return True
    if node.op == "convert":
        return node.args[0].type not in REAL  # an integer or a flag becomes a finite real
    return node.op == "select" and all(is_finite(a) for a in node.args[1:])


def _fold_add(graph: NodeMaker, type: Type, a: Node, b: Node) -> Node | None:
    """Return a simpler node for a + b, by x + 0 = x and a + (-x) = a - x; None where nothing is simpler."""
    if a.op == "constant" and a.value == 0:
        return b
    if b.op == "constant" and b.value == 0:
        return a
    if type in REAL and b.op == "neg":
        return graph.node("sub", type, a, b.args[0])
    if type in REAL and a.op == "neg":
        return graph.node("sub", type, b, a.args[0])
    return None


def _fold_sub(graph: NodeMaker, type: Type, a: Node, b: Node) -> Node | None:
    """Return a simpler node for a - b, by x - 0 = x, -0 - x = -x and a - (-x) = a + x; None if nothing is simpler."""
    if _is_zero(b):
        return a
    # -0 - x is -x, but +0 - x is not: at x = 0 it is +0, and -x is -0.
    if type in REAL and _is_zero(a) and math.copysign(1, a.value) < 0:
        return graph.node("neg", type, b)
    if type in REAL and b.op == "neg":
        return graph.node("add", type, a, b.args[0])
    return None


def _fold_mul(graph: NodeMaker, type: Type, a: Node, b: Node) -> Node | None:
    """Return a simpler node for a b; None where nothing is simpler.

    By 1 x = x, 0 x = 0 of a finite x, -1 x = -x, (x + x) / 2 = x and c (-x) = (-c) x of a constant c.
    """
    if b.op == "constant":
        a, b = b, a
    if a.op != "constant":
        return None
    if a.value == 1:
        return b
    if a.value == 0 and is_finite(b):
        return a
    if type in REAL and a.value == -1:
        return graph.node("neg", type, b)
    if a.value == 0.5 and b.op == "add" and b.args[0] is b.args[1]:
        return b.args[0]
    # c (-x) = (-c) x. Not of c = 0: which zero comes out is left to the run.
    if a.value == 0 or b.op != "neg":
        return None
    return graph.node("mul", type, graph.constant(-a.value, type), b.args[0])


def _fold_div(graph: NodeMaker, type: Type, a: Node, b: Node) -> Node | None:
    """Return a / b as the product a (1/b) if b is a power of two, where this is exact; None for any other b."""
    if type not in REAL or b.op != "constant" or not b.value or not math.isfinite(b.value):
        return None
    # A power of two has the mantissa 1/2; both it and its reciprocal must be normal numbers.
    largest = 1e300 if type == "f64" else 1e37
    if abs(math.frexp(b.value)[0]) != 0.5 or not 1 / largest < abs(b.value) < largest:
        return None
    return graph.node("mul", type, a, graph.constant(1 / b.value, type))


def _fold_neg(graph: NodeMaker, type: Type, a: Node) -> Node | None:
    """Return the node of x for -a if a is -x; None where nothing is simpler."""
    return a.args[0] if a.op == "neg" else None


def _fold_and(graph: NodeMaker, type: Type, a: Node, b: Node) -> Node | None:
    """Return a simpler node for a & b where one is a constant flag or both are the same node; else None."""
    if b.op == "constant":
        a, b = b, a
    if a.op == "constant" and type == "bool":
        return b if a.value else a
    return a if a is b else None


def _fold_or(graph: NodeMaker, type: Type, a: Node, b: Node) -> Node | None:
    """Return a simpler node for a | b where one is a constant flag or 0, or both are the same node; else None."""
    if b.op == "constant":
        a, b = b, a
    if a.op == "constant" and type == "bool":
        return a if a.value else b
    if a.op == "constant" and a.value == 0:
        return b
    return a if a is b else None


def _fold_xor(graph: NodeMaker, type: Type, a: Node, b: Node) -> Node | None:
    """Return a simpler node for a ^ b (exclusive or) where one is 0 or a constant flag; None for any other."""
    if b.op == "constant":
        a, b = b, a
    if a.op == "constant" and not a.value:
        return b
    return graph.node("not", type, b) if a.op == "constant" and type == "bool" else None


def _fold_not(graph: NodeMaker, type: Type, a: Node) -> Node | None:
    """Return the node of x for `not a` if a is `not x`; None where nothing is simpler."""
    return a.args[0] if a.op == "not" else None


def _fold_shift(graph: NodeMaker, type: Type, a: Node, b: Node) -> Node | None:
    """Return a for a shift of a by b if b is the constant 0; None where nothing is simpler."""
    return a if _is_zero(b) else None


def _fold_extremum(graph: NodeMaker, type: Type, a: Node, b: Node) -> Node | None:
    """Return a for the larger or the smaller of a and b if these are the same node; None where nothing is simpler."""
    return a if a is b else None


def _fold_select(graph: NodeMaker, type: Type, condition: Node, a: Node, b: Node) -> Node | None:
    """Return a simpler node for `a where the condition holds, else b`; None where nothing is simpler.

    So it is where the condition is known or negated, where a choice within has the same one, or between two flags.
    """
    if a is b:
        return a
    if condition.op == "constant":
        return a if condition.value else b
    if condition.op == "not":
        return graph.node("select", type, condition.args[0], b, a)
    if a.op == "select" and a.args[0] is condition:
        return graph.node("select", type, condition, a.args[1], b)
    if b.op == "select" and b.args[0] is condition:
        return graph.node("select", type, condition, a, b.args[2])
    if type == "bool" and a.op == "constant" and b.op == "constant":
        return condition if a.value else graph.node("not", "bool", condition)
    return None


def _make_equality_rule(op: str) -> Callable[..., Node | None]:
    """Return the rule that simplifies a comparison by == (op "eq") or != ("ne")."""

    def fold_flag_comparison(graph: NodeMaker, type: Type, a: Node, b: Node) -> Node | None:
        """Return a simpler node for a comparison by `op` ("eq" or "ne"), or None if there is none.

        A comparison of a flag with 0 or 1 becomes the flag or its negation. A comparison of a number with itself is a
        constant, unless the number may be NaN, which does not equal itself.
        """
        if a is b and (a.type not in REAL or a in graph.never_nan or is_finite(a)):
            return graph.constant(op == "eq", "bool")
        if a.op == "constant":
            a, b = b, a
        if b.op != "constant":
            return None
        flag = a.args[0] if a.op == "convert" and a.args[0].type == "bool" else a
        if flag.type != "bool" or b.value not in (0, 1):
            return None
        return flag if bool(b.value) == (op == "eq") else graph.node("not", "bool", flag)

    return fold_flag_comparison


def _make_flag_order_rule(strict: bool, turned: bool) -> Callable[..., Node | None]:
    """Return the rule that writes an order of flags, false before true, as logic.

    `strict`: < rather than <=; `turned`: > for <, or >= for <=.
    """

    def fold_flag_order(graph: NodeMaker, type: Type, a: Node, b: Node) -> Node | None:
        """Return a comparison of the order of two flags as logic, where false < true; None for numbers.

        LLVM cannot compare flags by order. `strict`: the comparison is < rather than <=. `turned`: b is on the left.
        """
        if a.type != "bool":
            return None
        # low < high is "not low and high", low <= high is "not low or high".
        low, high = (b, a) if turned else (a, b)
        return graph.node("and" if strict else "or", "bool", graph.node("not", "bool", low), high)

    return fold_flag_order


def _fold_convert(graph: NodeMaker, type: Type, a: Node) -> Node | None:
    """Return a simpler node for a conversion of `a` to `type`, or None if there is none.

    If `a` has the type already, it is `a`. A float that was converted to double and goes back is the first float.
    A conversion to a flag becomes the comparison a != 0.
    """
    if a.type == type:
        return a
    if type == "f32" and a.op == "convert" and a.args[0].type == "f32" and a.type == "f64":  # nothing was lost
        return a.args[0]
    if type == "bool":
        return graph.node("ne", "bool", a, graph.constant(0.0 if a.type in REAL else 0, a.type))
    return None


SIMPLER: dict[str, Callable[..., Node | None]] = {
    "add": _fold_add, "sub": _fold_sub, "mul": _fold_mul, "div": _fold_div, "neg": _fold_neg,
    "and": _fold_and, "or": _fold_or, "xor": _fold_xor, "not": _fold_not, "select": _fold_select,
    "shift_left": _fold_shift, "shift_right": _fold_shift, "max": _fold_extremum, "min": _fold_extremum,
    "eq": _make_equality_rule("eq"), "ne": _make_equality_rule("ne"), "convert": _fold_convert,
    "lt": _make_flag_order_rule(strict=True, turned=False), "le": _make_flag_order_rule(strict=False, turned=False),
    "gt": _make_flag_order_rule(strict=True, turned=True), "ge": _make_flag_order_rule(strict=False, turned=True),
}  # fmt: skip
