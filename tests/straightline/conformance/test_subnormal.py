"""Native code and C compute with subnormal numbers, which XLA takes for zeros: against NumPy and SciPy."""

import math

import numpy as np
import pytest
import scipy.special
from jax import lax

from straightline.nodes import Unsupported
from straightline.rules.elementwise import ELEMENTWISE
from tests.straightline.conformance.c import COMPILERS, by_c
from tests.straightline.conformance.case import Case, is_taken, pairs
from tests.straightline.conformance.elementwise import ARITY, NAMED, UNITS
from tests.straightline.conformance.engines import by_lanes

SMALLEST = np.finfo(np.float64).tiny
VALUES = np.array([5e-324, -5e-324, 1e-310, -1e-310, SMALLEST / 2, SMALLEST, -SMALLEST, 0.0, -0.0, 1.5, 1e300])


def signed(function):
    """An odd function of NumPy or SciPy, which loses the sign of -0."""
    return lambda x: np.copysign(function(x), x)


OTHER_NAMES = {
    "acos": np.arccos, "acosh": np.arccosh, "add_any": np.add, "asin": np.arcsin, "asinh": np.arcsinh,
    "atan": np.arctan, "atan2": np.arctan2, "atanh": np.arctanh, "div": np.divide, "eq": np.equal,
    "erf": scipy.special.erf, "erf_inv": signed(scipy.special.erfinv), "erfc": scipy.special.erfc,
    "ge": np.greater_equal, "gt": np.greater, "is_finite": np.isfinite, "le": np.less_equal, "lt": np.less,
    "lgamma": np.vectorize(lambda x: math.lgamma(x) if x else math.inf),  # SciPy takes subnormal numbers for zeros
    "max": np.maximum, "min": np.minimum, "mul": np.multiply, "ne": np.not_equal, "neg": np.negative, "rem": np.fmod,
    "sign": signed(np.sign), "sub": np.subtract,
}  # fmt: skip
REALS = sorted(
    name
    for name in ELEMENTWISE
    if name == "add_any" or is_taken(NAMED.get(name) or getattr(lax, name), VALUES[: ARITY.get(name, 2)])
)
OF_WHOLE_NUMBERS = {"shift_left", "shift_right_logical", "and", "or", "xor", "not"}


def case(name: str) -> Case:
    """All values, or pairs of them."""
    function = NAMED.get(name) or getattr(lax, name)
    return Case(function, pairs(*(VALUES,) * ARITY.get(name, 2)), UNITS.get(name, 0.0))


def exact(name: str, arguments: tuple[np.ndarray, ...]) -> np.ndarray:
    """What NumPy or SciPy computes."""
    with np.errstate(all="ignore"):
        return np.asarray((OTHER_NAMES.get(name) or getattr(np, name))(*arguments))


def differences(name: str, one: Case, result: np.ndarray) -> list[tuple[np.ndarray, ...]]:
    """Runs whose results differ by more than the units of rounding, of subnormal ones one more; zeros by their sign."""
    expected = exact(name, one.arguments)
    if expected.dtype == bool:
        wrong = result != expected
    else:
        with np.errstate(all="ignore"):
            near = np.abs(result - expected) <= (one.units + (one.units > 0)) * np.spacing(np.abs(expected))
        same = (result == expected) & (np.signbit(result) == np.signbit(expected))
        wrong = ~(same | (np.isnan(result) & np.isnan(expected)) | (near & (expected != 0)))
        if name in ("max", "min"):  # NumPy takes either of two zeros
            wrong &= ~((result == 0) & (expected == 0))
    return [(*(a[k] for a in one.arguments), result[k], expected[k]) for k in np.nonzero(wrong)[0]]


def test_every_operation_on_reals_is_compared():
    assert set(ELEMENTWISE) - set(REALS) == OF_WHOLE_NUMBERS


@pytest.mark.parametrize("name", REALS)
def test_native_code_computes_with_subnormal_numbers(name):
    one = case(name)
    assert not differences(name, one, by_lanes(one)[0])


@pytest.mark.slow
@pytest.mark.skipif(not COMPILERS, reason="no C compiler")
@pytest.mark.parametrize("name", [name for name in REALS if name != "lgamma"])
def test_c_computes_with_subnormal_numbers(name, tmp_path):
    one = case(name)
    one = one._replace(units=one.units and max(one.units, 8.0))
    try:
        result = by_c([one], tmp_path, COMPILERS[0])[0][0]
    except Unsupported:
        return
    assert not differences(name, one, result)
