"""Interval arithmetic with outward rounding on functions written in JAX: bounds that hold for every value in a box.

A function is traced to its list of operations, and each is carried out on intervals [low, high] that hold every value
that the exact operation can take; every end is moved outward by more than its rounding. An operation that is not known
here, or a decision that the box leaves open, ends the attempt.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend import core

from heliograph.numerics.numpy_or_jax import called_program

Numbers = np.ndarray
Contraction = tuple[tuple[Sequence[int], Sequence[int]], tuple[Sequence[int], Sequence[int]]]  # contracted, batch
ULPS = 4  # units in the last place: a library's sine or exponential is off by less than one, the arithmetic by a half
MOVES = (
    "reshape", "broadcast_in_dim", "transpose", "squeeze", "slice", "concatenate", "rev", "copy", "expand_dims",
    "dynamic_slice", "gather", "pad", "split", "stack", "unstack", "stop_gradient",
)  # fmt: skip


class NoIntervalError(Exception):
    """An operation outside of what is known here, or a decision that the box leaves open."""


class Interval(NamedTuple):
    """Arrays of lower and upper ends; of truth values, False and True where both are possible."""

    low: Numbers
    high: Numbers


def bound_program(jaxpr: core.ClosedJaxpr, arguments: Sequence[Interval], continuous: bool) -> list[Interval]:
    """Return intervals that hold a traced function's results wherever its arguments lie in these intervals.

    It is used to bound a function over a whole region, where values at points would prove nothing. Each operation of
    the traced program is applied to intervals in place of numbers.

    Args:
        jaxpr: the function, traced by JAX.
        arguments: an interval for each argument, arrays of lower and upper ends.
        continuous: refuse a comparison whose outcome the intervals leave open, where the function may jump, and a
            stopped gradient, which its derivative lacks.

    Raises:
        NoIntervalError: an operation that is not known here, or that is refused.
    """
    values: dict[core.Var, Interval] = {}

    def read(atom: core.Var | core.Literal) -> Interval:
        """Return the interval of a variable, or the point of a literal number."""
        return point_interval(atom.val) if isinstance(atom, core.Literal) else values[atom]

    # Intervals of the arguments and constants, then of each operation's results in order.
    values.update(zip(jaxpr.jaxpr.invars, arguments, strict=True))
    values.update(zip(jaxpr.jaxpr.constvars, map(point_interval, jaxpr.consts), strict=True))
    for equation in jaxpr.jaxpr.eqns:
        inputs = [read(atom) for atom in equation.invars]
        name = equation.primitive.name
        # A call of another program, such as a jitted function, is bounded in the same way.
        if (called := called_program(equation)) is not None:
            results = bound_program(called, inputs, continuous)
        elif name == "mul" and equation.invars[0] is equation.invars[1]:  # x x is never below 0, as x y may be
            results = [_bound_square(inputs[0])]
        elif name == "stop_gradient" and continuous and not np.array_equal(*inputs[0]):  # no point
            raise NoIntervalError("a slope that is stopped")
        # What moves entries about, and whole numbers, are not rounded: the ends' results are the ends.
        elif name in MOVES or all(a.low.dtype.kind in "iu" for a in inputs):
            results = _apply_to_ends(equation, inputs)
        else:
            results = [_apply_operation(equation, inputs, continuous)]
        values.update(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in jaxpr.jaxpr.outvars]


def point_interval(value: object) -> Interval:
    """Return the interval that holds a known value, or an array of values, alone: both ends are the value."""
    array = np.asarray(value)
    return Interval(array, array)


def round_outward(low: object, high: object, ulps: int = 1) -> Interval:
    """Return the interval [low, high] with its ends moved outward by `ulps` units in the last place.

    So it holds what exact arithmetic would have given. An end that is NaN, of which nothing is known, becomes infinite.
    """
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    low, high = np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)
    for _ in range(ulps):
        low, high = np.nextafter(low, -np.inf), np.nextafter(high, np.inf)
    return Interval(low, high)


def _apply_operation(equation: Any, x: list[Interval], continuous: bool) -> Interval:
    """Return the interval that holds an operation's result on intervals x of its arguments.

    `equation` is an operation of a traced JAX program (a jaxpr equation: primitive and parameters). An interval has
    arrays of lower and upper ends; of truth values, False and True where both are possible. If `continuous`, a
    comparison or sign whose outcome the intervals leave open is refused, since the function may jump there.

    Raises:
        NoIntervalError: an operation that is not known here, or that is refused.
    """
    name, params = equation.primitive.name, equation.params
    # Arithmetic, and functions of a single number.
    if name in ARITHMETIC:
        with np.errstate(all="ignore"):
            return ARITHMETIC[name](*x)
    # Sums, comparisons and choices, which need their parameters.
    match name:
        case "integer_pow":
            return _raise_interval_to_power(x[0], params["y"])
        case "convert_element_type":
            dtype, is_point = np.dtype(params["new_dtype"]), np.array_equal(x[0].low, x[0].high)
            if dtype.kind not in "fb" and not is_point:  # to whole numbers: a jump
                raise NoIntervalError("a number made whole")
            return Interval(x[0].low.astype(dtype), x[0].high.astype(dtype))
        case "reduce_sum":
            return _sum_intervals(x[0], tuple(params["axes"]))
        case "dot_general":
            return _bound_contraction(x[0], x[1], params["dimension_numbers"])
        case "iota":
            return point_interval(equation.primitive.bind(**params))
        # A comparison that is true in only a part of the intervals has the ends False and True: not decided.
        case "lt" | "le" | "gt" | "ge" | "eq" | "ne":
            return _check_decided(_compare(name, *x), continuous)
        case "sign":
            sign = Interval(np.sign(x[0].low), np.sign(x[0].high))
            return _check_decided(sign, continuous)
        case "and" | "or":
            combine = np.logical_and if name == "and" else np.logical_or
            return Interval(combine(x[0].low, x[1].low), combine(x[0].high, x[1].high))
        case "not":
            return Interval(~x[0].high, ~x[0].low)
        case "select_n":
            return _select_case(x)
    raise NoIntervalError(name)


def _check_decided(interval: Interval, continuous: bool) -> Interval:
    """Return the interval of a decision; raise NoIntervalError if it is open and the function must be continuous.

    A decision with equal ends is the same in the whole region. One with the ends False and True is open.
    """
    if continuous and not np.array_equal(interval.low, interval.high):
        raise NoIntervalError("a decision that depends on where in the region x is")
    return interval


def _apply_to_ends(equation: Any, x: list[Interval]) -> list[Interval]:
    """Return the intervals after an operation that only moves numbers, by applying it to low ends and to high ends.

    `equation` is the operation of a traced program, such as a reshape or a look-up. Whole numbers among its arguments
    are indices, and must be certain.
    """
    if any(interval.low.dtype.kind in "iu" and not np.array_equal(interval.low, interval.high) for interval in x):
        raise NoIntervalError("a place that depends on x")
    lows = _apply_to_numbers(equation, [interval.low for interval in x])
    highs = _apply_to_numbers(equation, [interval.high for interval in x])
    return [Interval(low, high) for low, high in zip(lows, highs, strict=True)]


def _apply_to_numbers(equation: Any, ends: list[Numbers]) -> list[Numbers]:
    """Return an operation's results on arrays of numbers, as JAX computes them; `ends` are its arguments."""
    outputs = equation.primitive.bind(*map(jax.device_put, ends), **equation.params)
    return list(map(np.asarray, outputs if equation.primitive.multiple_results else [outputs]))


def _compare(name: str, a: Interval, b: Interval) -> Interval:
    """Return the interval of truth values of a comparison of x in a with y in b.

    Its low end is True where the comparison holds for all such x and y, its high end where it holds for some. `name` is
    that of JAX's operation: "lt", "le", "gt", "ge", "eq" or "ne".
    """
    if name in ("gt", "ge"):
        return _compare({"gt": "lt", "ge": "le"}[name], b, a)
    if name == "ne":
        same = _compare("eq", a, b)
        return Interval(~same.high, ~same.low)
    if name == "eq":
        certain = (a.low == a.high) & (b.low == b.high) & (a.low == b.low)
        return Interval(certain, (a.low <= b.high) & (b.low <= a.high))
    if name == "lt":
        return Interval(a.high < b.low, a.low < b.high)
    return Interval(a.high <= b.low, a.low <= b.high)


def _select_case(x: list[Interval]) -> Interval:
    """Return the interval of cases[which], x = [which, *cases].

    `which` is the interval of a whole number, the case number. If its ends differ, several cases are possible, and the
    interval goes from the lowest end of all these cases to the highest.
    """
    case_number, cases = x[0], x[1:]
    lows = np.broadcast_arrays(*[case.low for case in cases])
    highs = np.broadcast_arrays(*[case.high for case in cases])
    lowest_case, highest_case = case_number.low.astype(int), case_number.high.astype(int)
    low, high = np.full(lows[0].shape, np.inf), np.full(lows[0].shape, -np.inf)
    for i, (a, b) in enumerate(zip(lows, highs, strict=True)):
        is_possible = (lowest_case <= i) & (i <= highest_case)
        low = np.where(is_possible, np.minimum(low, a), low)
        high = np.where(is_possible, np.maximum(high, b), high)
    dtype = cases[0].low.dtype
    return Interval(low.astype(dtype), high.astype(dtype))


def _bound_product(a: Interval, b: Interval) -> tuple[Numbers, Numbers]:
    """Return the least and the largest product x y of x in a and y in b, which are products of ends; not rounded."""
    ends = [x * y for x in a for y in b]
    # An infinite end stands for finite numbers, and 0 times each of them is 0.
    ends = [np.where(np.isnan(end), 0.0, end) for end in ends]
    return np.minimum.reduce(ends), np.maximum.reduce(ends)


def _bound_quotient(a: Interval, b: Interval) -> Interval:
    """Return an interval that holds x / y for x in a and y in b: all numbers, if y may be 0.

    Else the quotient is monotone in x and in y, so that its extremes are at ends.
    """
    holds_zero = (b.low <= 0) & (b.high >= 0)
    # Where y may be 0 the divisor is set to 1, and the quotient is not used.
    divisor = Interval(np.where(holds_zero, 1.0, b.low), np.where(holds_zero, 1.0, b.high))
    ends = [x / y for x in a for y in divisor]
    low, high = np.minimum.reduce(ends), np.maximum.reduce(ends)
    return round_outward(np.where(holds_zero, -np.inf, low), np.where(holds_zero, np.inf, high))


def _bound_square(a: Interval) -> Interval:
    """Return the interval of x^2, which begins at 0 if x may be 0.

    The product rule for x * x would take both factors for different numbers, and begin at low * high.
    """
    squares_of_ends = a.low**2, a.high**2
    low, high = np.minimum(*squares_of_ends), np.maximum(*squares_of_ends)
    holds_zero = (a.low <= 0) & (a.high >= 0)
    square = round_outward(np.where(holds_zero, 0.0, low), high)
    return Interval(np.maximum(square.low, 0.0), square.high)


def _raise_interval_to_power(a: Interval, exponent: int) -> Interval:
    """Return an interval of x^k for x in a and a whole number k, the `exponent`.

    Odd powers are monotone; even ones depend on |x| alone, and are monotone in it. x^-k is 1 / x^k. A power may be off
    by ULPS units in the last place.
    """
    if exponent < 0:
        unit_interval = point_interval(np.ones_like(a.low))
        return _bound_quotient(unit_interval, _raise_interval_to_power(a, -exponent))
    base = _bound_absolute(a) if exponent % 2 == 0 else a
    return round_outward(base.low**exponent, base.high**exponent, ULPS)


def _bound_absolute(a: Interval) -> Interval:
    """Return the interval of |x|, from 0 where x may be 0."""
    sizes_of_ends = np.abs(a.low), np.abs(a.high)
    least, largest = np.minimum(*sizes_of_ends), np.maximum(*sizes_of_ends)
    holds_zero = (a.low <= 0) & (a.high >= 0)
    return Interval(np.where(holds_zero, 0.0, least), largest)


def _make_monotone_bound(
    function: Callable[[Numbers], Numbers], low: float = -np.inf, high: float = np.inf
) -> Callable[..., Interval]:
    """Return the interval version of a nondecreasing function, whose values lie between `low` and `high`.

    The ends of an interval go to the ends of its values, widened by the error of the library's function (ULPS).
    """

    def call(a: Interval) -> Interval:
        """Return the interval of the function's values on an interval of its argument."""
        values = round_outward(function(a.low), function(a.high), ULPS)
        return Interval(np.maximum(values.low, low), np.minimum(values.high, high))

    return call


def _bound_cosine(a: Interval) -> Interval:
    """Return the interval of cos: up to 1 if an even multiple of pi is inside, down to -1 if an odd one is.

    ULPS: units in the last place by which a library's cosine may be off.
    """
    ends = np.cos(a.low), np.cos(a.high)
    cosine = round_outward(np.minimum(*ends), np.maximum(*ends), ULPS)
    # Ends in multiples of pi, widened by more than their rounding.
    low_in_pi = a.low / np.pi - 1e-9 * (1 + np.abs(a.low))
    high_in_pi = a.high / np.pi + 1e-9 * (1 + np.abs(a.high))
    holds_even_multiple = np.floor(high_in_pi / 2) >= np.ceil(low_in_pi / 2)
    holds_odd_multiple = np.floor((high_in_pi - 1) / 2) >= np.ceil((low_in_pi - 1) / 2)
    is_infinite = ~(np.isfinite(a.low) & np.isfinite(a.high))
    low = np.where(holds_odd_multiple | is_infinite, -1.0, cosine.low)
    high = np.where(holds_even_multiple | is_infinite, 1.0, cosine.high)
    return Interval(np.maximum(low, -1.0), np.minimum(high, 1.0))


def _sum_intervals(a: Interval, axes: tuple[int, ...]) -> Interval:
    """Return an interval that holds the sum over some axes, rounding included.

    In any order a sum of n terms x_i is off by at most (n - 1) eps sum |x_i|, to first order in eps.
    """
    count = int(np.prod([a.low.shape[i] for i in axes]))
    size = np.sum(np.maximum(np.abs(a.low), np.abs(a.high)), axis=axes)
    rounding = 2 * (count + 2) * np.finfo(float).eps * size
    return round_outward(np.sum(a.low, axis=axes) - rounding, np.sum(a.high, axis=axes) + rounding)


def _bound_contraction(a: Interval, b: Interval, dimensions: Contraction) -> Interval:
    """Return the interval of a contraction (`dot_general`): that of all products, then of their sums.

    Args:
        a: lower and upper ends of the first factor's entries.
        b: lower and upper ends of the second factor's entries.
        dimensions: the contracted axes of a and of b, and the axes of both that are a batch.
    """
    (left, right), (left_batch, right_batch) = dimensions

    def lay_out(x: Numbers, contracted: Sequence[int], batch: Sequence[int], before: int, after: int) -> Numbers:
        """Return x with axes (batch, `before` ones, free, `after` ones, contracted), so that both factors broadcast.

        Both factors share the batch axes. Free axes belong to one factor alone. Contracted axes are summed over. The
        `before` and `after` axes have length 1, and stand for the other factor's free axes.
        """
        free = [i for i in range(x.ndim) if i not in contracted and i not in batch]
        batch_sizes, free_sizes, contracted_sizes = ([x.shape[i] for i in axes] for axes in (batch, free, contracted))
        x = np.transpose(x, [*batch, *free, *contracted])
        return x.reshape(*batch_sizes, *[1] * before, *free_sizes, *[1] * after, *contracted_sizes)

    free_a = a.low.ndim - len(left) - len(left_batch)
    free_b = b.low.ndim - len(right) - len(left_batch)
    wide_a = Interval(*(lay_out(end, left, left_batch, 0, free_b) for end in a))
    wide_b = Interval(*(lay_out(end, right, right_batch, free_a, 0) for end in b))
    # The products of all pairs; rounded outward, so that rounding cannot move a true product out of its interval.
    product = round_outward(*_bound_product(wide_a, wide_b))
    axes = tuple(range(product.low.ndim - len(left), product.low.ndim))
    return _sum_intervals(product, axes)


ARITHMETIC: dict[str, Callable[..., Interval]] = {
    "add": lambda a, b: round_outward(a.low + b.low, a.high + b.high),
    "add_any": lambda a, b: round_outward(a.low + b.low, a.high + b.high),
    "sub": lambda a, b: round_outward(a.low - b.high, a.high - b.low),
    "mul": lambda a, b: round_outward(*_bound_product(a, b)),
    "div": _bound_quotient,
    "neg": lambda a: Interval(-a.high, -a.low),
    "max": lambda a, b: Interval(np.maximum(a.low, b.low), np.maximum(a.high, b.high)),
    "min": lambda a, b: Interval(np.minimum(a.low, b.low), np.minimum(a.high, b.high)),
    "abs": _bound_absolute,
    "square": _bound_square,
    "one_minus_square": lambda a: ARITHMETIC["sub"](
        point_interval(np.ones_like(a.low)), _bound_square(a)
    ),  # a slope of tanh
    "exp": _make_monotone_bound(np.exp, 0.0),
    "log": _make_monotone_bound(lambda x: np.where(x > 0, np.log(np.maximum(x, 0.0)), np.nan)),
    "log1p": _make_monotone_bound(lambda x: np.where(x > -1, np.log1p(np.maximum(x, -1.0)), np.nan)),
    "expm1": _make_monotone_bound(np.expm1, -1.0),
    "sqrt": _make_monotone_bound(lambda x: np.where(x >= 0, np.sqrt(np.maximum(x, 0.0)), np.nan)),
    "rsqrt": lambda a: _bound_quotient(point_interval(np.ones_like(a.low)), ARITHMETIC["sqrt"](a)),
    "tanh": _make_monotone_bound(np.tanh, -1.0, 1.0),
    "logistic": _make_monotone_bound(lambda x: 1 / (1 + np.exp(-x)), 0.0, 1.0),
    "atan": _make_monotone_bound(np.arctan),
    "sin": lambda a: _bound_cosine(round_outward(a.low - np.pi / 2, a.high - np.pi / 2, ULPS)),
    "cos": _bound_cosine,
}
