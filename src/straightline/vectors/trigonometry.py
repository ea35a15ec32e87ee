"""Sine, cosine and the angle of a vector, on vectors of numbers."""

import math

from straightline.vectors.exponential import find_format, round_to_nearest
from straightline.vectors.formula_builder import Vector, copy_sign, fma, polynomial, rounded, select

HALF_PI = 1.57079632679489661923, 6.12323399573676603587e-17, -1.4973849048591833e-33  # pi / 2 as a sum
HALF_PI_OF_FLOATS = 1.5707963705062866, -4.371138828673793e-08, -1.7151244994428829e-15
LARGEST = {"double": 2.0**20, "float": 2.0**16}  # up to which the sum is long enough; beyond, the library is called
PI_LOW = {"double": 1.2246467991473531772e-16, "float": -8.7422776573475858e-08}  # what pi lacks as rounded

SIN = [
    -1.66666666666666324348e-01,
    8.33333333332248946124e-03,
    -1.98412698298579493134e-04,
    2.75573137070700676789e-06,
    -2.50507602534068634195e-08,
    1.58969099521155010221e-10,
]
COS = [
    4.16666666666666019037e-02,
    -1.38888888888741095749e-03,
    2.48015872894767294178e-05,
    -2.75573143513906633035e-07,
    2.08757232129817482790e-09,
    -1.13596475577881948265e-11,
]
TERMS_OF_FLOATS = 4  # of these
ATAN = [
    3.33333333333329318027e-01,
    -1.99999999998764832476e-01,
    1.42857142725034663711e-01,
    -1.11111104054623557880e-01,
    9.09088713343650656196e-02,
    -7.69187620504482999495e-02,
    6.66107313738753120669e-02,
    -5.83357013379057348645e-02,
    4.97687799461593236017e-02,
    -3.65315727442169155270e-02,
    1.62858201153657823623e-02,
]
ATAN_OF_FLOATS = [3.3333328366e-01, -1.9999158382e-01, 1.4253635705e-01, -1.0648017377e-01, 6.1687607318e-02]
# Where atan turns by a known angle: from, (numerator and denominator of (a x + b) / (c x + d)), the angle as a sum.
TURNS = [
    (7 / 16, (2.0, -1.0, 1.0, 2.0), 4.63647609000806093515e-01, 2.26987774529616870924e-17),
    (11 / 16, (1.0, -1.0, 1.0, 1.0), 7.85398163397448278999e-01, 3.06161699786838301793e-17),
    (19 / 16, (1.0, -1.5, 1.5, 1.0), 9.82793723247329054082e-01, 1.39033110312309984516e-17),
    (39 / 16, (0.0, -1.0, 1.0, 0.0), 1.57079632679489655800e00, 6.12323399573676603587e-17),
]


def sin(x: Vector) -> Vector:
    """Return the sine of each number x of a vector, where x = n pi / 2 + r + r_low with an integer n, |r| <= pi / 4.

    The rest is the sum of r and r_low, what rounding takes from r. The sine is that of the rest for even n and its
    cosine for odd n, negated if n mod 4 is 2 or 3. The sine of a small x is x itself, and that of a very large x is
    computed by the C library. `select(condition, a, b)` takes a in the lanes where the condition holds, else b.
    """
    n, r, r_low = _reduce_to_quarter(x)
    is_even = (n & 1).equals(0)
    value = select(is_even, _sin(r, r_low), _cos(r, r_low))
    is_in_first_half_turn = (n & 2).equals(0)
    value = select(is_in_first_half_turn, value, -value)
    small = 2.0 ** -(27 if x.scalar == "double" else 13)
    return _use_library_where_large(x, select(abs(x) < small, x, value), "sin")


def cos(x: Vector) -> Vector:
    """Return the cosine of each number x of a vector, where x = n pi / 2 + r + r_low with an integer n, |r| <= pi / 4.

    The rest is the sum of r and r_low, what rounding takes from r. The cosine is that of the rest for even n and its
    sine for odd n, negated if n mod 4 is 1 or 2. The cosine of a very large x is computed by the C library.
    `select(condition, a, b)` takes a in the lanes where the condition holds, else b.
    """
    n, r, r_low = _reduce_to_quarter(x)
    is_even = (n & 1).equals(0)
    value = select(is_even, _cos(r, r_low), _sin(r, r_low))
    is_not_negated = ((n + 1) & 2).equals(0)
    value = select(is_not_negated, value, -value)
    return _use_library_where_large(x, value, "cos")


def _reduce_to_quarter(x: Vector) -> tuple[Vector, Vector, Vector]:
    """Return the number n of quarter turns in x as an integer, and the rest x - n pi / 2 as a sum of two numbers.

    The second number of the sum is what rounding takes from the first.

    pi / 2 is a sum of three numbers (high, middle, low), which are subtracted one by one. The first difference,
    x - n high, is exact.
    """
    quarter, n = round_to_nearest(x * (2 / math.pi))
    high, middle, low = HALF_PI if x.scalar == "double" else HALF_PI_OF_FLOATS
    first = fma(n, -high, x)
    # Compute first - n middle as a sum: rounding takes something from the product and from the difference.
    product = n * middle
    second = first - product
    subtracted = second - first
    rounding_of_second = (first - (second - subtracted)) - (product + subtracted)
    rest = rounding_of_second - fma(n, middle, -product) - n * low
    r = second + rest
    return quarter, r, (second - r) + rest


def _sin(x: Vector, low: Vector) -> Vector:
    """Return sin(x + low) = x + x^3 p(x^2) + low (1 - x^2 / 2), where |x| <= pi / 4 and `low` is tiny.

    The polynomial p has the coefficients SIN.
    """
    z = x * x
    v = z * x
    r = polynomial(z, _select_coefficients(x, SIN)[1:])
    return x - ((z * (0.5 * low - v * r) - low) - v * SIN[0])


def _cos(x: Vector, low: Vector) -> Vector:
    """Return cos(x + low) = 1 - x^2 / 2 + x^4 p(x^2) - x low, where |x| <= pi / 4 and `low` is tiny.

    The polynomial p has the coefficients COS. (1 - w) - half is what rounding takes from w = 1 - x^2 / 2.
    """
    z = x * x
    half = 0.5 * z
    w = 1 - half
    return w + (((1 - w) - half) + (z * (z * polynomial(z, _select_coefficients(x, COS))) - x * low))


def _select_coefficients(x: Vector, coefficients: list[float]) -> list[float]:
    """Return the first coefficients of a polynomial, as many as count in the precision of the vector x."""
    return coefficients if x.scalar == "double" else coefficients[:TERMS_OF_FLOATS]


def _use_library_where_large(x: Vector, value: Vector, name: str) -> Vector:
    """Return `value` in the lanes where |x| < LARGEST, in the others the C library's function `name` of x.

    The library is called only if some lane of the vector needs it.
    """
    return x.body.compute_where_needed(abs(x) >= LARGEST[x.scalar], lambda: x.body.call(name, x), value)


def atan(x: Vector) -> Vector:
    """Return the arc tangent of each number of a vector: that of |x|, with the sign of x."""
    return copy_sign(_atan_of_positive(abs(x)), x)


def _atan_of_positive(x: Vector) -> Vector:
    """Return atan x for x >= 0 as A + atan t, t = (x - tan A) / (1 + x tan A), with a tabulated angle A near atan x.

    atan t = t - t^3 p(t^2), with a polynomial p of coefficients ATAN, for the small |t| that remains. A vector holds
    one number for each SIMD lane.
    """
    # A large number stands for infinity, since infinity times 0 is NaN.
    x = select(x > 2.0**66, 2.0**66, x)
    # Each lane takes the last entry of TURNS whose `start` is not above x, or A = 0, where t = x. An entry has the
    # coefficients of t = (a x + b) / (c x + d), and A as the sum `high` + `low`.
    coefficients = tuple(map(x.like, (1.0, 0.0, 0.0, 1.0)))
    high = low = x.like(0.0)
    for start, new_coefficients, new_high, new_low in TURNS:
        is_reached = x >= start
        pairs = zip(new_coefficients, coefficients, strict=True)
        coefficients = tuple(select(is_reached, new, old) for new, old in pairs)
        if x.scalar == "float":  # the table has the sum of two doubles: split the first into two floats
            angle, new_high = new_high, rounded(new_high)
            new_low = angle - new_high
        high, low = select(is_reached, new_high, high), select(is_reached, new_low, low)
    a, b, c, d = coefficients
    t = fma(x, a, b) / fma(x, c, d)
    z = t * t
    p = polynomial(z, ATAN if x.scalar == "double" else ATAN_OF_FLOATS)
    # high + t + (low - t^3 p), with the small terms added first.
    return high - ((t * (z * p) - low) - t)


def atan2(y: Vector, x: Vector) -> Vector:
    """Return the angle of the point (x, y), from -pi to pi, or NaN if a coordinate is NaN.

    It is a = atan |y / x| for x > 0 and pi - a for x < 0, with the sign of y.
    """
    # If |x| = |y|, the quotient could be 0/0 or infinity/infinity, which is NaN. The ratio is 0 at the origin, else 1.
    have_equal_sizes = abs(x).equals(abs(y))
    ratio = select(have_equal_sizes, select(y.equals(0.0), y.like(0.0), 1.0), abs(y / x))
    angle = _atan_of_positive(ratio)
    is_x_negative = x.as_type(find_format(x).word) < 0  # as an integer, so that -0 counts as negative
    angle = select(is_x_negative, math.pi - (angle - PI_LOW[x.scalar]), angle)
    return copy_sign(select(_is_number(x) & _is_number(y), angle, math.nan), y)


def _is_number(x: Vector) -> Vector:
    """Return in which lanes x is not NaN: NaN does not equal itself."""
    return x.equals(x)
