"""Rules of elementwise operations."""

import math
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import numpy as np
from jax.extend.core import JaxprEqn

from straightline.constant_folding import DTYPES
from straightline.graph import Graph
from straightline.lowering import RULES, Lowering, Rule, arrange_nodes, result_shape, result_type
from straightline.nodes import REAL, Node, RandomKey, Type, Unsupported

# Operation of JAX -> the graph's.
ELEMENTWISE = {name: name for name in (
    "add", "sub", "mul", "div", "rem", "neg", "abs", "sqrt", "exp", "log", "log1p", "expm1", "sin", "cos", "tan",
    "tanh", "atan2", "floor", "ceil", "sign", "is_finite", "max", "min", "eq", "ne", "lt", "le", "gt", "ge",
    "and", "or", "xor", "not", "shift_left", "erf", "erf_inv", "erfc", "lgamma", "asin", "acos", "atan",
    "sinh", "cosh", "asinh", "acosh", "atanh", "cbrt", "exp2",
)} | {"add_any": "add", "shift_right_logical": "shift_right"}  # fmt: skip


WORDS: dict[Type, tuple[Type, Type]] = {"f64": ("u64", "i64"), "f32": ("u32", "i32")}  # integers of as many bits


def broadcast_entries(arrays: Sequence[np.ndarray], shape: tuple[int, ...]) -> list[list[Any]]:
    """Return for each array of nodes the list of its entries, broadcast to `shape`, in row-major order."""
    size = math.prod(shape)
    return [
        [a.item()] * size if a.size == 1 else (a if a.shape == shape else np.broadcast_to(a, shape)).ravel().tolist()
        for a in arrays
    ]


def _make_elementwise_rule(op: str) -> Rule:
    """Return the rule of an operation of JAX that is the operation `op` of native code, applied to each entry."""

    def rule(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
        """Return an array of nodes: entry i of the result is `op` applied to entry i of each argument."""
        shape, type = result_shape(equation), result_type(equation)
        arguments_of_entries = zip(*broadcast_entries(inputs, shape), strict=True)
        return [arrange_nodes([lowering.graph.node(op, type, *nodes) for nodes in arguments_of_entries], shape)]

    return rule


def _make_rule_of_entries(function: Any) -> Rule:
    """Return the rule that makes each entry of the result by function(graph, type, parameters, *entries).

    It adds scalar operations (nodes) to the graph: `type` is the result's, `parameters` are those of JAX's operation,
    and the entries are one node of each argument.
    """

    def rule(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
        """Return an array of nodes: entry i is what `function` makes of entry i of each argument."""
        shape, type, graph = result_shape(equation), result_type(equation), lowering.graph
        entries = zip(*broadcast_entries(inputs, shape), strict=True)
        return [arrange_nodes([function(graph, type, equation.params, *entry) for entry in entries], shape)]

    return rule


def select(graph: Graph, condition: Node, a: Any, b: Any) -> Any:
    """Return the node of "a if condition else b", an operation of each run; random keys are selected word by word."""
    if isinstance(a, RandomKey):
        return RandomKey(select(graph, condition, a.first, b.first), select(graph, condition, a.second, b.second))
    return graph.node("select", a.type, condition, a, b)


def _select_n(graph: Graph, type: Type, params: Any, which: Node, *cases: Any) -> Any:
    """Return the case whose number is `which`, a flag or an integer.

    It is a chain of selections, made from the last case backward. A number that no other case has takes the last case.
    """
    if len(cases) == 2 and which.type == "bool":
        return select(graph, which, cases[1], cases[0])
    chosen = cases[-1]
    for number, case in reversed(list(enumerate(cases[:-1]))):
        chosen = select(graph, graph.node("eq", "bool", which, graph.constant(number, which.type)), case, chosen)
    return chosen


def _lower_select_n(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Lower `select_n`, whose first input says for each entry which of the other inputs is taken.

    The inputs that are chosen from hold numbers or random keys.
    """
    # `_select_n` uses neither its type ("u32") nor its parameters (None): a selection has the type of its cases.
    shape = result_shape(equation)
    entries = zip(*broadcast_entries(inputs, shape), strict=True)
    return [arrange_nodes([_select_n(lowering.graph, "u32", None, *entry) for entry in entries], shape)]


def _raise_to_integer(graph: Graph, type: Type, params: Any, x: Node) -> Node:
    """Return the node of x^n by repeated squaring, with the integer n = params["y"]; for n < 0 it is 1 / x^-n.

    With the binary digits b_0, b_1, ... of |n|, x^|n| is the product of x^(2^i) over the i with b_i = 1.
    """
    remaining_digits = abs(params["y"])
    factors, power = [], x  # power: x, x^2, x^4, ..., one for each binary digit from the lowest on
    while remaining_digits:
        if remaining_digits % 2:
            factors.append(power)
        remaining_digits //= 2
        if remaining_digits:
            power = graph.node("mul", type, power, power)
    unit = graph.constant(1.0 if type in REAL else 1, type)
    product = reduce(lambda a, b: graph.node("mul", type, a, b), factors, unit)
    return product if params["y"] >= 0 else graph.node("div", type, unit, product)


def _power_of_number(graph: Graph, type: Type, params: Any, x: Node, exponent: Node) -> Node:
    """Return the node of x^y for a real x; an integer exponent y is converted to the type of x."""
    return graph.node("pow", type, x, exponent if exponent.type == type else graph.node("convert", type, exponent))


def _clamp(graph: Graph, type: Type, params: Any, low: Node, x: Node, high: Node) -> Node:
    """Return the node of x limited to the range from `low` to `high`: min(max(low, x), high)."""
    return graph.node("min", type, graph.node("max", type, low, x), high)


def _convert(graph: Graph, type: Type, params: Any, x: Node) -> Node:
    """Return the node of x converted to `type`, that of the result."""
    return graph.node("convert", type, x)


def _bitcast(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return an array of nodes of numbers whose bits are read as another type.

    The other type has as many bits, or a number of 64 bits becomes two words of 32 bits, the low one first.
    """
    (x,), type, shape, node = inputs, result_type(equation), result_shape(equation), lowering.graph.node
    numbers = x.ravel().tolist()
    kinds = {n.type for n in numbers}
    have_as_many_bits = all(kind[1:] == type[1:] for kind in kinds)  # a type is a letter and its bits: f64
    if shape == x.shape and have_as_many_bits:
        return [arrange_nodes([n if n.type == type else node("bitcast", type, n) for n in numbers], shape)]
    if shape == (*x.shape, 2) and kinds <= {"f64", "u64"} and type == "u32":
        bits = [n if n.type == "u64" else node("bitcast", "u64", n) for n in numbers]
        half = lowering.graph.constant(32, "u64")
        words = [node("convert", "u32", w) for b in bits for w in (b, node("shift_right", "u64", b, half))]
        return [arrange_nodes(words, shape)]
    raise Unsupported(f"bitcast from {', '.join(sorted(kinds))} to {type}")


def _logistic(graph: Graph, type: Type, params: Any, x: Node) -> Node:
    """Return the node of the logistic function 1 / (1 + e^-x); the operation's `params` are not used."""
    unit = graph.constant(1.0, type)
    power = graph.node("exp", type, graph.node("neg", type, x))
    return graph.node("div", type, unit, graph.node("add", type, unit, power))


def _root_reciprocal(graph: Graph, type: Type, params: Any, x: Node) -> Node:
    """Return the node of 1 / sqrt(x); the operation's `params` are not used."""
    return graph.node("div", type, graph.constant(1.0, type), graph.node("sqrt", type, x))


def _square(graph: Graph, type: Type, params: Any, x: Node) -> Node:
    """Return the node of x^2 = x x; the operation's `params` are not used."""
    return graph.node("mul", type, x, x)


def _one_minus_square(graph: Graph, type: Type, params: Any, x: Node) -> Node:
    """Return the node of 1 - x^2; the operation's `params` are not used."""
    return graph.node("sub", type, graph.constant(1.0, type), graph.node("mul", type, x, x))


def _log2(graph: Graph, type: Type, params: Any, x: Node) -> Node:
    """Return the node of the binary logarithm, log(x) (1 / log 2); the operation's `params` are not used."""
    return graph.node("mul", type, graph.node("log", type, x), graph.constant(1 / math.log(2), type))


def _polynomial(graph: Graph, type: Type, params: Any, x: Node, *coefficients: Node) -> Node:
    """Return the node of c_0 + c_1 x + c_2 x^2 + ... by Horner's rule; the operation's `params` are not used."""
    value = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        value = graph.node("add", type, graph.node("mul", type, value, x), c)
    return value


def _round(graph: Graph, type: Type, params: Any, x: Node) -> Node:
    """Return the node of the whole number nearest to x; of halves the even one, or the one further from zero.

    JAX's `rounding_method` is 1 for the even one and 0 for the other.
    """
    return graph.node("round_even" if int(params["rounding_method"]) else "round_away", type, x)


def _return_arguments(lowering: Lowering, equation: JaxprEqn, inputs: list[Any]) -> list[Any]:
    """Return the arguments as they are: the rule of an operation that changes no number, such as `copy`."""
    return inputs


def _make_total_order_rule(op: str) -> Callable[..., Node]:
    """Return the function that makes the node of a comparison `op` ("eq", "le" or "lt") by the total order of IEEE 754.

    That order is -NaN < -inf < ... < -0 < 0 < ... < inf < NaN; the function compares integers that have it.
    """

    def rank_by_bits(graph: Graph, x: Node) -> Node:
        """Return an unsigned integer made of a real number's bits, such that integers have the order of the reals.

        All bits of a negative number are inverted, and only the sign bit of any other. Integers are left unchanged.
        """
        if x.type not in REAL:
            return x
        word, highest = WORDS[x.type][0], int(x.type[1:]) - 1  # the unsigned type of as many bits; the sign's bit
        bits = graph.node("bitcast", word, x)
        is_negative = graph.node("shift_right", word, bits, graph.constant(highest, word))  # 0 or 1
        all_if_negative = graph.node("sub", word, graph.constant(0, word), is_negative)  # -1 has all bits set
        sign = graph.constant(1 << highest, word)
        return graph.node("xor", word, bits, graph.node("or", word, all_if_negative, sign))

    def compare_by_rank(graph: Graph, type: Type, params: Any, x: Node, y: Node) -> Node:
        """Return the node of `x op y` by the total order."""
        return graph.node(op, type, rank_by_bits(graph, x), rank_by_bits(graph, y))

    return compare_by_rank


def _next_after(graph: Graph, type: Type, params: Any, x: Node, y: Node) -> Node:
    """Return the number next to x towards y, y if they are equal, NaN if one is NaN.

    Its bits, as an integer, are those of x and one more or less.
    """
    whole, smallest = WORDS[type][1], float(np.finfo(DTYPES[type]).smallest_subnormal)
    node, zero, one = graph.node, graph.constant(0.0, type), graph.constant(1, whole)
    bits = node("bitcast", whole, x)
    # Away from zero one more: where x < y and x is positive, or x > y and it is negative.
    away = node("eq", "bool", node("lt", "bool", x, y), node("lt", "bool", zero, x))
    next_bits = node("select", whole, away, node("add", whole, bits, one), node("sub", whole, bits, one))
    # From zero on it is the smallest number of the sign of y.
    down, up = graph.constant(-smallest, type), graph.constant(smallest, type)
    next_to_zero = node("select", type, node("lt", "bool", y, zero), down, up)
    moved = node("select", type, node("eq", "bool", x, zero), next_to_zero, node("bitcast", type, next_bits))
    moved = node("select", type, node("eq", "bool", x, y), y, moved)
    none_is_nan = node("and", "bool", node("eq", "bool", x, x), node("eq", "bool", y, y))
    return node("select", type, none_is_nan, moved, graph.constant(math.nan, type))


def _shift_right_arithmetic(graph: Graph, type: Type, params: Any, x: Node, by: Node) -> Node:
    """Return the node of x shifted right by `by` bits, with copies of the sign bit from the left."""
    return graph.node("shift_right_signed", type, x, by)


RULES |= {name: _make_elementwise_rule(op) for name, op in ELEMENTWISE.items()}
RULES |= {
    "select_n": _lower_select_n, "integer_pow": _make_rule_of_entries(_raise_to_integer),
    "square": _make_rule_of_entries(_square),
    "pow": _make_rule_of_entries(_power_of_number),
    "rsqrt": _make_rule_of_entries(_root_reciprocal), "logistic": _make_rule_of_entries(_logistic),
    "clamp": _make_rule_of_entries(_clamp),
    "convert_element_type": _make_rule_of_entries(_convert), "bitcast_convert_type": _bitcast,
    "one_minus_square": _make_rule_of_entries(_one_minus_square), "log2": _make_rule_of_entries(_log2),
    "polynomial": _make_rule_of_entries(_polynomial),
    "eq_to": _make_rule_of_entries(_make_total_order_rule("eq")),
    "le_to": _make_rule_of_entries(_make_total_order_rule("le")),
    "lt_to": _make_rule_of_entries(_make_total_order_rule("lt")), "round": _make_rule_of_entries(_round),
    "nextafter": _make_rule_of_entries(_next_after),
    "shift_right_arithmetic": _make_rule_of_entries(_shift_right_arithmetic),
}  # fmt: skip
PASSED_ON = ("copy", "copy_p", "stop_gradient", "optimization_barrier", "name")
RULES |= dict.fromkeys(PASSED_ON, _return_arguments)
