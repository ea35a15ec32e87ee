"""Cases of operations on numbers one by one: made of the table of rules, for every type that each takes."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from jax import lax

from straightline.rules.elementwise import ELEMENTWISE
from tests.straightline.conformance.case import DTYPES, Case, numbers, of_each_type, pairs

# JAX's function where it has another name.
NAMED: dict[str, Callable[..., Any]] = {
    "and": lax.bitwise_and,
    "or": lax.bitwise_or,
    "xor": lax.bitwise_xor,
    "not": lax.bitwise_not,
    "add_any": lambda x, y: jax.vjp(lambda v: (v, v), x)[1]((x, y))[0],
}
ARITY = {name: 1 for name in (
    "neg", "abs", "sqrt", "exp", "log", "log1p", "expm1", "sin", "cos", "tan", "tanh", "floor", "ceil", "sign",
    "is_finite", "not", "erf", "erf_inv", "erfc", "lgamma", "asin", "acos", "atan", "sinh", "cosh", "asinh", "acosh",
    "atanh", "cbrt", "exp2",
)}  # all others take two  # fmt: skip
# Of XLA's code for these the last two digits are wrong; `test_native.py` holds native code against NumPy's.
FOURTEEN_DIGITS = ("cbrt", "cosh", "sinh", "exp2", "lgamma")
UNITS = {name: 4.0 for name in (
    "exp", "log", "log1p", "expm1", "sin", "cos", "tan", "tanh", "atan2", "erf", "erf_inv", "erfc", "asin",
    "acos", "atan", "asinh", "acosh", "atanh",
)} | dict.fromkeys(FOURTEEN_DIGITS, 256.0)  # fmt: skip
MAKERS: dict[str, Callable[[], list[Case]]] = {
    name: partial(of_each_type, NAMED.get(name) or getattr(lax, name), ARITY.get(name, 2), UNITS.get(name, 0.0))
    for name in ELEMENTWISE
}
WHOLE = tuple(d for d in DTYPES if d not in (np.float64, np.bool_))


def _select_cases() -> list[Case]:
    cases = []
    for dtype in DTYPES:
        values = numbers(dtype)[:4] if dtype != np.bool_ else numbers(dtype)
        cases.append(Case(lambda c, x, y: lax.select_n(c, x, y), pairs(np.array([False, True]), values, values)))
        which = np.array([-(2**31), -1, 0, 1, 2, 3, 2**31 - 1], np.int32)
        cases.append(Case(lambda k, x, y: lax.select_n(k, x, y, x), pairs(which, values, values)))
    return cases


def _conversions() -> list[Case]:
    return [
        Case(
            partial(lax.convert_element_type, new_dtype=to),
            (numbers(d),),
            label=f"{np.dtype(d).name} to {np.dtype(to).name}",
        )
        for d in (*DTYPES, np.float32)
        for to in (*DTYPES, np.float32)
    ]


def _bits() -> list[Case]:
    made = [(np.float64, d) for d in (np.uint64, np.int64, np.uint32)]
    made += [(np.float32, np.uint32), (np.float32, np.int32), (np.uint32, np.float32), (np.int32, np.float32)]
    made += [
        (np.uint64, np.uint32),
        (np.uint64, np.float64),
        (np.int64, np.float64),
        (np.int32, np.uint32),
        (np.uint32, np.int32),
        (np.int64, np.uint64),
        (np.uint64, np.int64),
    ]
    return [
        Case(
            partial(lax.bitcast_convert_type, new_dtype=to),
            (numbers(d),),
            label=f"{np.dtype(d).name} as {np.dtype(to).name}",
        )
        for d, to in made
    ]


def _total(op: str) -> list[Case]:
    """Through the search that uses it: in a table with NaN and both zeros, of all kinds of numbers."""
    cases = []
    for dtype in DTYPES[:1] + WHOLE:
        table = np.sort(numbers(dtype))
        for side in ("left", "right"):
            cases.append(Case(lambda x, t=table, s=side: jax.numpy.searchsorted(t, x, side=s), (numbers(dtype),)))
    return cases


MAKERS |= {
    "select_n": _select_cases,
    "integer_pow": lambda: [
        c for n in (-3, -2, -1, 0, 1, 2, 3, 7) for c in of_each_type(lambda x, n=n: lax.integer_pow(x, n), 1, 4.0)
    ],
    "square": partial(of_each_type, lax.square, 1),
    "pow": partial(of_each_type, lax.pow, 2, 4.0, mixed=True),
    "rsqrt": partial(of_each_type, lax.rsqrt, 1, 2.0),
    "logistic": partial(of_each_type, lax.logistic, 1, 4.0),
    "clamp": lambda: [
        Case(lambda a, x, b: lax.clamp(a, x, b), pairs(numbers(d)[:12], numbers(d), numbers(d)[:12]))
        for d in DTYPES
        if d != np.bool_
    ],
    "nextafter": partial(of_each_type, lax.nextafter, 2),
    "convert_element_type": _conversions,
    "bitcast_convert_type": _bits,
    "round": lambda: [c for how in lax.RoundingMethod for c in of_each_type(lambda x, how=how: lax.round(x, how), 1)],
    "shift_right_arithmetic": partial(of_each_type, lax.shift_right_arithmetic, 2),
    "log2": partial(of_each_type, jax.numpy.log2, 1, 4.0, dtypes=(np.float64,)),
    "one_minus_square": partial(of_each_type, lambda x: 1 - x * x, 1),
    "eq_to": partial(_total, "eq"),
    "le_to": partial(_total, "le"),
    "lt_to": partial(_total, "lt"),
}
