"""Exponential, logarithm and related functions on vectors."""

import math

from straightline.vectors.formulas import Vector, copy_sign, fma, polynomial, select

LOG2_E = 1 / math.log(2)
LN2_HIGH, LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10  # the first has 21 zeros at its end
ROUND = 1.5 * 2.0**52  # added to a number below 2^51, it rounds it to an integer, the lowest bits of the sum
ROUND_BITS = 0x4338000000000000
ONE_BITS, ROOT_HALF_BITS, FRACTION = 0x3FF0000000000000, 0x3FE6A09E667F3BCD, 52
TINY = 2.0**-1022  # the smallest normal number

# 1/2!, 1/3!, ... of exp on |r| <= ln(2)/2, where 1/14! is below half a unit of rounding of 1.
EXP = [1 / math.factorial(i) for i in range(2, 15)]
# log(1 + f) = 2 s + s z (c_0 + c_1 z + ...), s = f / (2 + f), z = s^2, on 1/sqrt(2) < 1 + f < sqrt(2).
LOG = [
    6.666666666666735130e-01,
    3.999999999940941908e-01,
    2.857142874366239149e-01,
    2.222219843214978396e-01,
    1.818357216161805012e-01,
    1.531383769920937332e-01,
    1.479819860511658591e-01,
]


def exp(x: Vector) -> Vector:
    """e^x = 2^n e^r, r = x - n ln 2."""
    count, n = _nearest(x * LOG2_E)
    r = fma(n, -LN2_LOW, fma(n, -LN2_HIGH, x))
    return _limited(x, _scaled(1 + fma(r * r, polynomial(r, EXP), r), count), 709.782712893384, -745.1332191019412)


def exp_of_sum(x: Vector, low: Vector) -> Vector:
    """e^(x + low), |low| small against 1, within 0.6 units of rounding: 1 + r as a sum of two numbers."""
    count, n = _nearest(x * LOG2_E)
    first, rest = _reduced(x, n)
    r = first + (rest + low)
    rest = (first - r) + (rest + low)
    leading = 1 + r
    small = fma(r * r, polynomial(r, EXP), fma(r, rest, rest))
    return _limited(x, _scaled(leading + ((1 - leading + r) + small), count), 709.782712893384, -745.1332191019412)


def expm1(x: Vector) -> Vector:
    """e^x - 1 = 2 (2^(n-1) (e^r - 1) + 2^(n-1) - 1/2), which neither overflows early nor cancels."""
    count, n = _nearest(select(x < -50.0, -50.0, x) * LOG2_E)
    r, low = _reduced(select(x < -50.0, -50.0, x), n)
    # e^(r + low) - 1 = r + low + r low + r^2/2 + ...
    small = r + fma(r * r, polynomial(r, EXP), fma(r, low, low))
    power = _power(count - 1)
    whole = 2 * fma(power, small, power - 0.5)
    return _limited(x, select(abs(x) < 2.0**-54, x, whole), 709.782712893384, -math.inf)


def log(x: Vector) -> Vector:
    """log(2^k m) = k ln 2 + log m, m between sqrt(1/2) and sqrt(2)."""
    small = x < TINY
    k, m = _exponent(select(small, x * 2.0**54, x))
    value = _log(k - select(small, 54.0, 0.0), m - 1, 0.0)
    return _with_domain(x, value)


def log1p(x: Vector) -> Vector:
    """log(1 + x) = log(u) + log((1 + x) / u), u = 1 + x as rounded."""
    u = 1 + x
    rounded = select(abs(x) < 1.0, x - (u - 1), 1 - (u - x))
    k, m = _exponent(u)
    value = _log(k, m - 1, rounded / u)
    return select(abs(x) < 2.0**-54, x, _with_domain(u, value))


def tanh(x: Vector) -> Vector:
    """-t / (2 + t), t = e^(-2|x|) - 1; beyond 1/2, 1 - 2 / (2 + t), t = e^(2|x|) - 1."""
    size = abs(x)
    large = size > 0.5
    t = expm1(select(large, 2 * size, -2 * size))
    ratio = select(large, -2.0, t) / (2 + t)
    return copy_sign(select(large, 1 + ratio, ratio), x)


def _nearest(x: Vector) -> tuple[Vector, Vector]:
    """The nearest integer, as 64 bits and as a double; |x| < 2^51."""
    moved = x + ROUND
    return moved.as_type("i64") - ROUND_BITS, moved - ROUND


def _reduced(x: Vector, n: Vector) -> tuple[Vector, Vector]:
    """x - n ln 2 as the sum of two numbers."""
    first = fma(n, -LN2_HIGH, x)
    rest = n * LN2_LOW
    r = first - rest
    return r, (first - r) - rest


def _power(n: Vector) -> Vector:
    """2^n of integers -1022 ... 1023."""
    return ((n << FRACTION) + ONE_BITS).as_type("double")


def _scaled(x: Vector, n: Vector) -> Vector:
    """x 2^n in two factors, each of which is a normal number."""
    half = n >> 1
    return x * _power(half) * _power(n - half)


def _limited(x: Vector, value: Vector, largest: float, smallest: float) -> Vector:
    """The result; infinity for x beyond the largest, 0 below the smallest, NaN of NaN."""
    return select(x > largest, math.inf, select(x < smallest, 0.0, value))


def _exponent(x: Vector) -> tuple[Vector, Vector]:
    """k and m of x = 2^k m, sqrt(1/2) <= m < sqrt(2), of a positive normal number."""
    bits = x.as_type("i64")
    k = (bits - ROOT_HALF_BITS) >> FRACTION
    m = (bits - (k << FRACTION)).as_type("double")
    return (k + ROUND_BITS).as_type("double") - ROUND, m


def _log(k: Vector, f: Vector, more: Vector | float) -> Vector:
    """K ln 2 + log(1 + f) + more, where `more` is small against the rest or the rest is zero."""
    s = f / (2 + f)
    z = s * s
    half = 0.5 * f * f
    r = z * polynomial(z, LOG)
    return fma(k, LN2_HIGH, f - (half - fma(s, half + r, fma(k, LN2_LOW, more))))


def _with_domain(x: Vector, value: Vector) -> Vector:
    """A logarithm's result; -infinity of 0, NaN below, infinity of infinity."""
    special = select(x.equals(0.0), -math.inf, select(x > 0.0, x, math.nan))
    return select((x > 0.0) & (x < math.inf), value, special)
