"""Functions evaluated with what rounding takes from them: f(c + e) as a high part and a low one.

Let fl(a . b) be an operation as it is rounded. Of a sum, a product, a quotient and a root the rounding error d is
itself a number, or nearly, and is computed; of what was lost before, l, a derivative hands on f'(a) l. So the low part
of each number is l+ = f'(a) l + d, the first-order correction of all roundings before it: what is left is of order
eps^2, beside the roundings of functions that have no formula for d (a sine, a logarithm), which are eps of their own
value. For a sum that is what matters: x + v cos(heading) dt far from the origin is rounded at |x| otherwise.

Source: Langlois, Automatic linear correction of rounding errors (2001), with the derivatives forwards; Dekker, A
floating-point technique for extending the available precision (1971), for the errors of sums and products.
"""

from collections.abc import Callable, Sequence
from functools import partial, reduce
from math import prod
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, Var

from heliograph.numerics.numpy_or_jax import called_program


class Compensated(NamedTuple):
    """A number as high + low, of one shape; `low` is None where nothing was lost."""

    high: Any
    low: Any = None


def split_sum(a: jax.Array, b: jax.Array) -> Compensated:
    """Return the rounded sum fl(a + b) and its rounding error a + b - fl(a + b); either of a and b may be larger.

    Source: Knuth, The art of computer programming, volume 2, theorem B of section 4.2.2.
    """
    total = a + b
    b_in_total = total - a
    a_in_total = total - b_in_total
    return Compensated(total, (a - a_in_total) + (b - b_in_total))


def compensate(function: Callable[[jax.Array], jax.Array], unit: float) -> Callable[[Compensated], Compensated]:
    """Return x -> f(high + low) for a JAX function f of one array; the result's low part is what rounding loses.

    Loops pass on what was lost before them, but their own rounding errors stay. A low part that is not finite, as after
    the derivative of a root at 0, becomes 0.

    Args:
        function: f, of operations with derivatives.
        unit: eps of the precision in which it will be computed; constants are divided in it too.
    """

    def evaluate(x: Compensated) -> Compensated:
        """Return f(high + low) as high + low; the low part is 0 if it is not finite, or if nothing was lost (None).

        f is `function`, evaluated operation by operation in a precision with rounding `unit`.
        """
        program = jax.make_jaxpr(function)(x.high)
        result = _CompensatedEvaluation(unit).evaluate_program(program, [x])[0]
        low = jnp.zeros_like(result.high) if result.low is None else result.low
        return Compensated(jnp.asarray(result.high), jnp.where(jnp.isfinite(low), low, 0.0))

    return evaluate


class _CompensatedEvaluation:
    """Evaluation of a traced program in numbers high + low: the rounded value, and what rounding took of it."""

    def __init__(self, unit: float):
        """Choose what depends on the precision of the evaluation, and the rules of operations.

        `unit` is eps of the precision, 2^-52 for doubles. A rule returns a result high + low from arguments high + low.
        """
        bits = 1 - round(np.log2(unit))  # bits of a number's fraction
        self.splitter = 2.0 ** ((bits + 1) // 2) + 1  # factor that splits a number into halves of its digits
        self.stored = np.float32 if bits <= 24 else np.float64
        self.rules: dict[str, Callable[..., Compensated]] = {
            "add": self._add, "add_any": self._add, "sub": self._subtract, "mul": self._multiply, "div": self._divide,
            "sqrt": self._take_root, "square": self._square, "integer_pow": self._raise_to_integer,
            "reduce_sum": self._sum, "cumsum": self._sum_running, "dot_general": self._multiply_matrices,
        }  # fmt: skip

    def evaluate_program(self, program: ClosedJaxpr, inputs: Sequence[Compensated]) -> list[Compensated]:
        """Return the results of a program that JAX traced, evaluated operation by operation, with what rounding lost.

        Each number is a pair (high, low), its rounded value and what rounding took of it; `inputs` are the arguments'.
        A constant of the program is a double, which may have more digits than the precision of the evaluation holds:
        the digits beyond it are its low part.
        """
        jaxpr = program.jaxpr
        constants = map(self._split_known, program.consts)
        values: dict[Var, Compensated] = dict(zip(jaxpr.constvars, constants, strict=True))
        values |= zip(jaxpr.invars, inputs, strict=True)

        def look_up(v: Any) -> Compensated:
            """Return the value of an argument of an operation: of a variable, or of a number in the program's text."""
            return self._split_known(v.val) if isinstance(v, Literal) else values[v]

        for equation in jaxpr.eqns:
            results = self._apply_operation(equation, list(map(look_up, equation.invars)))
            values |= zip(equation.outvars, results, strict=True)
        return list(map(look_up, jaxpr.outvars))

    def _split_known(self, number: Any) -> Compensated:
        """Return a known real number as what the precision can hold and the rest; anything else has no rest (None)."""
        if isinstance(number, jax.core.Tracer) or not np.issubdtype(np.asarray(number).dtype, np.floating):
            return Compensated(number)
        exact = np.asarray(number, np.float64)
        high = exact.astype(self.stored).astype(np.float64)
        low = np.subtract(exact, high, out=np.zeros_like(exact), where=np.isfinite(high))
        return Compensated(high, low if np.any(low) else None)

    def _apply_operation(self, equation: JaxprEqn, inputs: list[Compensated]) -> list[Compensated]:
        """Return the results of one operation f of a traced program, as numbers high + low.

        A number is its rounded value `high` and what rounding took of it, `low`. By a rule of `self.rules`, the result
        has the rounding error of f too. Without a rule it is f(high) with the low part f'(high) low, to first order. A
        call of a program and a branch are evaluated operation by operation.
        """
        name, params = equation.primitive.name, equation.params
        program = called_program(equation)
        if program is not None:
            return self.evaluate_program(program, inputs)
        if name == "cond":
            return self._apply_branches(inputs, params["branches"])
        if name in self.rules and all(jnp.issubdtype(jnp.result_type(x.high), jnp.floating) for x in inputs):
            return [self.rules[name](*inputs, **params)]
        return _apply_to_first_order(partial(_apply_unchanged, equation), inputs, equation.primitive.multiple_results)

    def _apply_branches(self, inputs: list[Compensated], branches: Sequence[ClosedJaxpr]) -> list[Compensated]:
        """Return the results of JAX's `cond`: of the branch, a program, whose number is inputs[0].

        Each branch is evaluated with what rounding loses; the other inputs are the branches' arguments.
        """

        def evaluate_branch(branch: ClosedJaxpr, given: list[Compensated]) -> list[Compensated]:
            """Return a branch's results; each real one gets a low part, even 0, as all branches need one structure."""
            results = self.evaluate_program(branch, given)
            are_real = [jnp.issubdtype(jnp.result_type(x.high), jnp.floating) for x in results]
            return [
                Compensated(jnp.asarray(x.high), _or_zero(x.low) + jnp.zeros_like(x.high)) if is_real else x
                for x, is_real in zip(results, are_real, strict=True)
            ]

        index = jnp.asarray(inputs[0].high, np.int32)
        results: list[Compensated] = lax.switch(
            index, [partial(evaluate_branch, branch) for branch in branches], inputs[1:]
        )
        return results

    def _add(self, a: Compensated, b: Compensated, **_: Any) -> Compensated:
        """Return fl(a_high + b_high) and its low part: the rounding error of this sum + a_low + b_low."""
        total, error = split_sum(a.high, b.high)
        return Compensated(total, _sum_terms_present(error, a.low, b.low))

    def _subtract(self, a: Compensated, b: Compensated, **_: Any) -> Compensated:
        """Return a - b as a + (-b), with what rounding loses."""
        return self._add(a, Compensated(-b.high, None if b.low is None else -b.low))

    def _multiply(self, a: Compensated, b: Compensated, **_: Any) -> Compensated:
        """Return fl(a_high b_high) and its low part: the product's rounding error + a_low b_high + b_low a_high."""
        lost = [x.low * y.high for x, y in ((a, b), (b, a)) if x.low is not None]
        rounding_error = self._find_product_error(a.high, b.high)
        return Compensated(a.high * b.high, _sum_terms_present(rounding_error, *lost))

    def _divide(self, a: Compensated, b: Compensated, **_: Any) -> Compensated:
        """Return q = fl(a / b) and its low part (a_high - q b_high + a_low - q b_low) / b_high.

        The product q b_high is rounded too, so that its rounding error is subtracted.
        """
        quotient = a.high / b.high
        rounded_product = quotient * b.high
        by_low_of_b = None if b.low is None else -quotient * b.low
        remainder = (a.high - rounded_product) - _or_zero(self._find_product_error(quotient, b.high))
        return Compensated(quotient, _sum_terms_present(remainder, a.low, by_low_of_b) / b.high)

    def _take_root(self, a: Compensated, **_: Any) -> Compensated:
        """Return r = fl(sqrt(a_high)) and its low part (a_high - r^2 + a_low) / (2 r)."""
        root = jnp.sqrt(a.high)
        remainder = (a.high - root * root) - _or_zero(self._find_product_error(root, root))
        return Compensated(root, _sum_terms_present(remainder, a.low) / (2 * root))

    def _square(self, a: Compensated, **_: Any) -> Compensated:
        """Return the product a a, with what rounding loses."""
        return self._multiply(a, a)

    def _raise_to_integer(self, a: Compensated, y: int, **_: Any) -> Compensated:
        """Return a^y as y - 1 products; for y < 0 it is the reciprocal of a^-y, and for y = 0 it is 1."""
        if y == 0:
            return _one_like(a)
        if y < 0:
            return self._divide(Compensated(np.ones(())), self._raise_to_integer(a, y=-y))
        return reduce(self._multiply, [a] * y)

    def _sum(self, a: Compensated, axes: tuple[int, ...], **_: Any) -> Compensated:
        """Return the sum of the entries along axes, added one by one, with what rounding loses; no entries give 0."""
        for axis in sorted(axes, reverse=True):
            entries = _split_along_axis(a, axis)
            a = reduce(self._add, entries) if entries else Compensated(jnp.sum(a.high, axis=axis))
        return a

    def _sum_running(self, a: Compensated, axis: int, reverse: bool) -> Compensated:
        """Return the running sums along an axis, from its first or (`reverse`) last entry, with what rounding loses."""
        sums = _split_along_axis(a, axis)  # the entries at first
        if reverse:
            for i in reversed(range(len(sums) - 1)):
                sums[i] = self._add(sums[i + 1], sums[i])
        else:
            for i in range(1, len(sums)):
                sums[i] = self._add(sums[i - 1], sums[i])
        highs, lows = [s.high for s in sums], [_or_zero(s.low) + jnp.zeros_like(s.high) for s in sums]
        return Compensated(jnp.stack(highs, axis), jnp.stack(lows, axis))

    def _multiply_matrices(self, a: Compensated, b: Compensated, dimension_numbers: Any, **_: Any) -> Compensated:
        """Return JAX's product of arrays: products of entries, added one after another, with what rounding loses.

        `dimension_numbers` says which axes of a and b are summed over, and which both share with the result.
        """
        # Axes that are summed over, and axes of a batch; the result has the axes batch, rest of a, rest of b.
        (summed_a, summed_b), (batch_a, batch_b) = dimension_numbers
        left = _arrange_factor(a, batch_a, summed_a, left=True)
        right = _arrange_factor(b, batch_b, summed_b, left=False)
        shape_a, shape_b = jnp.shape(a.high), jnp.shape(b.high)
        shape = [shape_a[axis] for axis in batch_a]
        shape += [n for axis, n in enumerate(shape_a) if axis not in (*batch_a, *summed_a)]
        shape += [n for axis, n in enumerate(shape_b) if axis not in (*batch_b, *summed_b)]
        products = [
            self._multiply(x, y) for x, y in zip(_split_along_axis(left, 1), _split_along_axis(right, 1), strict=True)
        ]
        if not products:
            return Compensated(jnp.zeros(shape))
        total = reduce(self._add, products)
        return Compensated(*(None if part is None else jnp.reshape(part, shape) for part in total))

    def _find_product_error(self, a: Any, b: Any) -> Any:
        """Return the rounding error a b - fl(a b) of a product; None if it is exact as a or b is 0 or a power of two.

        Products of halves of the digits are exact, so that the error is a1 b1 - fl(a b) + a1 b2 + a2 b1 + a2 b2.
        """
        if _scales_without_rounding(a) or _scales_without_rounding(b):
            return None
        (a1, a2), (b1, b2) = self._split_digits_in_halves(a), self._split_digits_in_halves(b)
        return ((a1 * b1 - a * b) + a1 * b2 + a2 * b1) + a2 * b2

    def _split_digits_in_halves(self, a: Any) -> tuple[Any, Any]:
        """Return a as a sum of two numbers with half its digits: far - (far - a) with far = splitter a, and the rest.

        NumPy splits known numbers in the precision of the program and keeps them as doubles.

        Source: Dekker, A floating-point technique for extending the available precision (1971).
        """
        if isinstance(a, jax.Array):
            far = a * self.splitter
            upper_half = far - (far - a)
            return upper_half, a - upper_half
        known: Any = np.asarray(a, self.stored)
        far = known * self.stored(self.splitter)
        upper_half = far - (far - known)
        return upper_half.astype(np.float64), (known - upper_half).astype(np.float64)


def _apply_unchanged(equation: JaxprEqn, *arguments: Any) -> Any:
    """Return the results of an operation of a traced program for these arguments, as JAX computes it."""
    primitive: Any = equation.primitive
    return primitive.bind(*arguments, **equation.params)


def _apply_to_first_order(
    function: Callable[..., Any], inputs: Sequence[Compensated], several: bool
) -> list[Compensated]:
    """Return f of numbers in two parts, as numbers in two parts: f(high), and f'(high) low, to first order.

    A number is high + low, its rounded value and what rounding lost of it; low is None where nothing was lost. Results
    are so corrected for earlier roundings: f(high + low) is f(high) + f'(high) low, nearly.

    Args:
        function: f, of the high parts.
        inputs: its arguments.
        several: whether f returns a list of results rather than one.
    """
    with_low = [i for i, x in enumerate(inputs) if x.low is not None]

    def call_with(*values: Any) -> Any:
        """Return f (`function`) of the high parts, with `values` in place of the inputs that have a low part."""
        arguments = [x.high for x in inputs]
        for i, value in zip(with_low, values, strict=True):
            arguments[i] = value
        return function(*arguments)

    lows: Any = None  # the results' low parts; None where no input has one
    if not with_low:
        results = call_with()
    else:
        highs = [jnp.asarray(inputs[i].high) for i in with_low]
        directions = [jnp.broadcast_to(inputs[i].low, x.shape) for i, x in zip(with_low, highs, strict=True)]
        results, lows = jax.jvp(call_with, highs, directions)
    if not several:
        results, lows = [results], None if lows is None else [lows]
    if lows is None:
        return [Compensated(x, None) for x in results]
    # Whole numbers have no derivative.
    return [
        Compensated(x, low if jnp.issubdtype(jnp.result_type(x), jnp.floating) else None)
        for x, low in zip(results, lows, strict=True)
    ]


def _scales_without_rounding(a: Any) -> bool:
    """Return whether a known number multiplies without rounding, because each entry is 0 or a power of two.

    For JAX's numbers, which may not be known yet, it is False.
    """
    if isinstance(a, jax.Array | jax.core.Tracer):
        return False
    mantissa, _ = np.frexp(a)  # from 0.5 to 1; it is 0.5 for a power of two
    return bool(np.all((np.abs(mantissa) == 0.5) | (np.asarray(a) == 0)))


def _split_along_axis(a: Compensated, axis: int) -> list[Compensated]:
    """Return the slices of high + low along an axis, as numbers high + low; their low is None if the whole has none."""
    count = jnp.shape(a.high)[axis]
    highs = [_take(a.high, i, axis) for i in range(count)]
    lows = [None if a.low is None else _take(a.low, i, axis) for i in range(count)]
    return [Compensated(high, low) for high, low in zip(highs, lows, strict=True)]


def _take(x: Any, i: int, axis: int) -> Any:
    """Return entry i of an array along an axis: by JAX for its arrays, by NumPy for known ones, which stay known."""
    return lax.index_in_dim(x, i, axis, keepdims=False) if isinstance(x, jax.Array) else np.take(x, i, axis)


def _arrange_factor(a: Compensated, batch: Sequence[int], summed: Sequence[int], left: bool) -> Compensated:
    """Return a factor of a matrix product, arranged so that the product is an entrywise product summed over axis 1.

    The left factor becomes (batch, summed, rows, 1) and the right one (batch, summed, 1, columns). `batch` and `summed`
    are the factor's axes of these kinds; all axes of a kind become one.
    """
    shape = jnp.shape(a.high)
    others = [axis for axis in range(len(shape)) if axis not in (*batch, *summed)]  # rows, or columns
    batch_size, summed_size, size = (prod(shape[axis] for axis in axes) for axes in (batch, summed, others))
    new_shape = (batch_size, summed_size, size, 1) if left else (batch_size, summed_size, 1, size)
    order = [*batch, *summed, *others]
    high, low = (None if x is None else x.transpose(order).reshape(new_shape) for x in map(_as_array, a))
    return Compensated(high, low)


def _as_array(x: Any) -> Any:
    """Return the high or the low part of a number as an array; None (nothing lost) and JAX's arrays as they are."""
    return x if x is None or isinstance(x, jax.Array) else np.asarray(x)


def _sum_terms_present(*terms: Any) -> Any:
    """Return the sum of those terms that are not None, from the left; None if all are."""
    given = [x for x in terms if x is not None]
    return reduce(lambda a, b: a + b, given) if given else None


def _or_zero(x: Any) -> Any:
    """Return a low part, 0 where nothing was lost."""
    return 0.0 if x is None else x


def _one_like(a: Compensated) -> Compensated:
    """Return ones of the shape of a number high + low, of which nothing is lost."""
    return Compensated(jnp.ones_like(a.high))
