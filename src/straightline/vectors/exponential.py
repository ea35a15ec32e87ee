"""Exponential, logarithm and related functions on vectors."""

import math
from typing import NamedTuple

from straightline.vectors.formula_builder import Vector, copy_sign, fma, polynomial, select

LOG2_E = 1 / math.log(2)


class PrecisionFormat(NamedTuple):
    """Numbers of a precision, and what depends on it in a formula.

    `word`: the integer of as many bits. `fraction`: bits after the leading one, of which `round`, added to a small
    number, leaves the nearest integer. `tiny`: the smallest normal number, `largest` and `smallest` where e^x is
    infinite and zero. `log`: c_i of log(1 + f) = 2 s + s z (c_0 + c_1 z + ...), s = f / (2 + f), z = s^2, on
    1/sqrt(2) < 1 + f < sqrt(2). `exp`: 1/2!, 1/3!, ... for e^r on |r| <= ln(2)/2, to below half a unit of rounding.
    """

    word: str
    fraction: int
    round: float
    round_bits: int
    one_bits: int
    root_half_bits: int
    ln2: tuple[float, float]  # as a sum of which the first has zeros at its end
    tiny: float
    largest: float
    smallest: float
    exp: list[float]
    log: list[float]

    @property
    def negligible(self) -> float:
        """Return 2^-(f + 2), f the bits of the fraction: a quarter of the unit of rounding of 1.

        For smaller x the first term of a series is the result: e^x - 1 = x + x^2 / 2 + ... and log(1 + x) = x - x^2 / 2
        + ... are x, since x^2 / 2 is less than half a unit of rounding of x.
        """
        return 2.0 ** -(self.fraction + 2)


FORMATS = {
    "double": PrecisionFormat(
        "i64", 52, 1.5 * 2.0**52, 0x4338000000000000, 0x3FF0000000000000, 0x3FE6A09E667F3BCD,
        (6.93147180369123816490e-01, 1.90821492927058770002e-10), 2.0**-1022, 709.782712893384, -745.1332191019412,
        [1 / math.factorial(i) for i in range(2, 15)],
        [6.666666666666735130e-01, 3.999999999940941908e-01, 2.857142874366239149e-01, 2.222219843214978396e-01,
         1.818357216161805012e-01, 1.531383769920937332e-01, 1.479819860511658591e-01],
    ),
    "float": PrecisionFormat(
        "i32", 23, 1.5 * 2.0**23, 0x4B400000, 0x3F800000, 0x3F3504F3,
        (6.9314575195e-01, 1.4286067653e-06), 2.0**-126, 88.72283935546875, -103.97208404541016,
        [1 / math.factorial(i) for i in range(2, 8)],
        [0.66666662693, 0.40000972152, 0.28498786688, 0.24279078841],
    ),
}  # fmt: skip


def find_format(x: Vector) -> PrecisionFormat:
    """Return the constants of the precision (double or float) of a vector's numbers."""
    return FORMATS[x.scalar]


def exp(x: Vector) -> Vector:
    """Return e^x = 2^n e^r, where n is the integer nearest to x / ln 2, and r = x - n ln 2.

    e^r = 1 + r + r^2 p(r) with a polynomial p. ln 2 is a sum of two numbers, so that r is precise.
    """
    form = find_format(x)  # the constants for this width of numbers
    integer_n, n = round_to_nearest(x * LOG2_E)
    ln2_high, ln2_low = form.ln2
    r = fma(n, -ln2_low, fma(n, -ln2_high, x))
    exp_r = 1 + fma(r * r, polynomial(r, form.exp), r)
    return _limit_result(x, _scale_by_power_of_two(exp_r, integer_n), form.largest, form.smallest)


def exp_of_sum(x: Vector, low: Vector) -> Vector:
    """Return e^(x + low) within 0.6 units of rounding; |low| is small against 1.

    It is computed as in `exp`, with r = x + low - n ln 2. But r, and also 1 + r, is kept as a sum of two numbers: the
    second is what rounding takes from the first.
    """
    form = find_format(x)
    integer_n, n = round_to_nearest(x * LOG2_E)
    reduced, rounding = _reduce_argument(x, n)
    r = reduced + (rounding + low)
    r_low = (reduced - r) + (rounding + low)
    leading = 1 + r
    leading_low = 1 - leading + r
    small = fma(r * r, polynomial(r, form.exp), fma(r, r_low, r_low))
    exp_r = leading + (leading_low + small)
    return _limit_result(x, _scale_by_power_of_two(exp_r, integer_n), form.largest, form.smallest)


def expm1(x: Vector) -> Vector:
    """Return e^x - 1 = 2 (2^(n-1) (e^r - 1) + 2^(n-1) - 1/2), which neither overflows early nor cancels.

    n is the integer nearest to x / ln 2, and r = x - n ln 2. Below -50 the result is -1 to the last digit, as at -50.
    """
    form = find_format(x)
    integer_n, n = round_to_nearest(select(x < -50.0, -50.0, x) * LOG2_E)
    r, low = _reduce_argument(select(x < -50.0, -50.0, x), n)
    # e^(r + low) - 1 = r + low + r low + r^2/2 + ...
    expm1_r = r + fma(r * r, polynomial(r, form.exp), fma(r, low, low))
    power = _power_of_two(form, integer_n - 1)
    result = 2 * fma(power, expm1_r, power - 0.5)
    return _limit_result(x, select(abs(x) < form.negligible, x, result), form.largest, -math.inf)


def log(x: Vector) -> Vector:
    """Return log x = k ln 2 + log m, where x = 2^k m and m lies between sqrt(1/2) and sqrt(2).

    It is -infinity at x = 0, and NaN for x < 0.
    """
    # A subnormal x is multiplied by 2^power, which makes it normal; `power` is then subtracted from k.
    form = find_format(x)
    is_subnormal, power = x < form.tiny, form.fraction + 2
    k, m = _split_exponent(select(is_subnormal, x * 2.0**power, x))
    value = _log(k - select(is_subnormal, x.like(power), 0.0), m - 1, 0.0)
    return _set_log_outside_domain(x, value)


def log1p(x: Vector) -> Vector:
    """Return log(1 + x) = log(u) + log((1 + x) / u), where u is 1 + x after rounding.

    Where x^2 is negligible against x, it is x itself.
    """
    # The second logarithm is close to d / u, where d is what rounding took from 1 + x.
    u = 1 + x
    rounded = select(abs(x) < 1.0, x - (u - 1), 1 - (u - x))
    k, m = _split_exponent(u)
    value = _log(k, m - 1, rounded / u)
    return select(abs(x) < find_format(x).negligible, x, _set_log_outside_domain(u, value))


def tanh(x: Vector) -> Vector:
    """Return the hyperbolic tangent of |x|, with the sign of x.

    For |x| <= 1/2 it is -t / (2 + t) with t = e^(-2|x|) - 1. Beyond, it is 1 - 2 / (2 + t) with t = e^(2|x|) - 1. Each
    form is precise where it is used.
    """
    size = abs(x)
    large = size > 0.5
    t = expm1(select(large, 2 * size, -2 * size))
    ratio = select(large, -2.0, t) / (2 + t)
    return copy_sign(select(large, 1 + ratio, ratio), x)


def round_to_nearest(x: Vector) -> tuple[Vector, Vector]:
    """Return the integer nearest to x, as an integer and as a real number; |x| < 2^51 (doubles) or 2^22 (floats).

    `form.round` is so large that the last bit of a sum with it is worth 1. The sum is therefore rounded to an integer,
    which is in its lower bits. `form.round_bits` are the bits of `form.round` as an integer.
    """
    form = find_format(x)
    moved = x + form.round
    return moved.as_type(form.word) - form.round_bits, moved - form.round


def _reduce_argument(x: Vector, n: Vector) -> tuple[Vector, Vector]:
    """Return x - n ln 2 as a sum of two numbers, where the second is what rounding takes from the first.

    ln 2 is itself a sum of two numbers, ln2_high + ln2_low.
    """
    ln2_high, ln2_low = find_format(x).ln2
    first = fma(n, -ln2_high, x)
    second = n * ln2_low
    difference = first - second
    return difference, (first - difference) - second


def _power_of_two(form: PrecisionFormat, n: Vector) -> Vector:
    """Return 2^n of integers n, -1022 to 1023 for doubles and -126 to 127 for floats, made from its bits.

    The bits of a real number are its exponent above those of the fraction, so that those of 2^n are those of 1 plus n
    shifted by the length of the fraction.
    """
    return ((n << form.fraction) + form.one_bits).as_type("double" if form.word == "i64" else "float")


def _scale_by_power_of_two(x: Vector, n: Vector) -> Vector:
    """Return x 2^n, multiplied in two steps, since 2^n alone may be beyond the range of normal numbers."""
    form, half = find_format(x), n >> 1
    return x * _power_of_two(form, half) * _power_of_two(form, n - half)


def _limit_result(x: Vector, value: Vector, largest: float, smallest: float) -> Vector:
    """Return `value` with infinity where x is above `largest` and 0 where it is below `smallest`; NaN stays NaN."""
    return select(x > largest, math.inf, select(x < smallest, 0.0, value))


def _split_exponent(x: Vector) -> tuple[Vector, Vector]:
    """Return k, as a real number, and m with x = 2^k m and sqrt(1/2) <= m < sqrt(2), for a positive normal number x.

    Read as integers (`form.word`), positive numbers are in their order. The lower bits are those of the fraction, and
    above them is the exponent, so that x 2^k has the bits of x plus k << fraction. `root_half_bits` are the bits of
    sqrt(1/2).
    """
    form = find_format(x)
    bits = x.as_type(form.word)
    k = (bits - form.root_half_bits) >> form.fraction  # rounded down: sqrt(1/2) 2^k <= x < sqrt(1/2) 2^(k+1)
    m = (bits - (k << form.fraction)).as_type(x.scalar)
    # k as a real number: `round` is so large that its last bit is worth 1, so that its bits plus k are round + k.
    k_real = (k + form.round_bits).as_type(x.scalar) - form.round
    return k_real, m


def _log(k: Vector, f: Vector, low: Vector | float) -> Vector:
    """Return k ln 2 + log(1 + f) + low, where `low` is small against the rest, or the rest is zero.

    log(1 + f) = f - f^2 / 2 + s (f^2 / 2 + r) with s = f / (2 + f) and a polynomial r in s^2. ln 2 is a sum
    of two numbers.
    """
    form = find_format(f)
    s = f / (2 + f)
    z = s * s
    half = 0.5 * f * f
    r = z * polynomial(z, form.log)
    ln2_high, ln2_low = form.ln2
    return fma(k, ln2_high, f - (half - fma(s, half + r, fma(k, ln2_low, low))))


def _set_log_outside_domain(x: Vector, value: Vector) -> Vector:
    """Return the logarithm `value` of x with -infinity where x is 0, NaN below, and infinity where x is infinite."""
    special = select(x.equals(0.0), -math.inf, select(x > 0.0, x, math.nan))
    return select((x > 0.0) & (x < math.inf), value, special)
