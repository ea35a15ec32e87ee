"""Scalar operations and literals as expressions of C99."""

import math
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from heliograph.codegen.graph import Node, Type, Unsupported
from heliograph.numerics.check import fail

Real = Literal["double", "float"]

INFIX = {
    "add": "+", "sub": "-", "mul": "*", "div": "/", "and": "&", "or": "|", "xor": "^",
    "eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">=",
}  # fmt: skip
# Functions of libm by the operation's name; in single precision they end in f.
FUNCTIONS = {name: name for name in (
    "sqrt", "exp", "log", "log1p", "expm1", "sin", "cos", "tan", "tanh", "atan2", "pow", "floor", "ceil", "asin",
    "acos", "atan", "sinh", "cosh", "asinh", "acosh", "atanh", "cbrt", "exp2", "erf", "erfc", "nextafter",
)} | {"abs": "fabs", "rem": "fmod", "round_even": "nearbyint"}  # fmt: skip
# What is more than one operator or function; a and b are names or literals, never expressions.
COMPOSED: dict[str, Callable[..., str]] = {
    "neg": "-{0}".format,
    "max": "({0} > {1} || {0} != {0} ? {0} : {1})".format,
    "min": "({0} < {1} || {0} != {0} ? {0} : {1})".format,
    "sign": "({0} > 0 ? 1 : {0} < 0 ? -1 : {0})".format,
    "is_finite": "!!isfinite({0})".format,
    "select": "({0} ? {1} : {2})".format,
}
WHOLE: dict[str, Callable[..., str]] = {
    "div": "({1} ? {0} / {1} : -1)".format,
    "rem": "({1} ? {0} % {1} : {0})".format,
    "abs": "({0} < 0 ? -{0} : {0})".format,
    "sign": "(({0} > 0) - ({0} < 0))".format,
}


def c_type(type: Type, real: Real) -> str:
    """Return the C type of a number in the program."""
    names = {"f64": real, "bool": "int", "i32": "int32_t", "i64": "int64_t", "u32": "uint32_t", "u64": "uint64_t"}
    return names[type]


def literal(value: float | int | bool, type: Type, real: Real) -> str:
    """Return a known number as a literal with every digit that its type has.

    Raises:
        ValueError: a number beyond the range of single precision.
    """
    if type == "bool":
        return "1" if value else "0"
    if type != "f64":
        text = f"{int(value)}{'u' if type[0] == 'u' else ''}{'ll' if type[1:] == '64' else ''}"
        return f"({text})" if value < 0 else text
    # Floating-point numbers: the shortest text that reads back as the same number.
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    if real == "float":
        with np.errstate(over="ignore", under="ignore"):
            single = np.float32(value)
        if not np.isfinite(single):
            raise fail("single precision", "numbers up to 3.4e38", value)
        text = f"{single!s}f"
    else:
        text = repr(float(value))
    return f"({text})" if text.startswith("-") else text


def expression(node: Node, arguments: Sequence[str], real: Real) -> str:
    """Return an operation on names and literals.

    Raises:
        Unsupported: an operation that C does not have.
    """
    op, whole = node.op, node.type != "f64"
    if op == "convert":
        if node.type == "bool":
            return f"({arguments[0]} != 0)"
        return f"({c_type(node.type, real)}){arguments[0]}"
    if op == "not":
        return f"!{arguments[0]}" if node.type == "bool" else f"~{arguments[0]}"
    # Integers first, since C's operators differ from those of floating-point numbers.
    if whole and op in WHOLE:
        return WHOLE[op](*arguments)
    if op in COMPOSED:
        return COMPOSED[op](*arguments)
    if op in INFIX:
        return f"{arguments[0]} {INFIX[op]} {arguments[1]}"
    if op in FUNCTIONS and not whole:
        return f"{FUNCTIONS[op]}{'f' if real == 'float' else ''}({', '.join(arguments)})"
    raise Unsupported(op)
