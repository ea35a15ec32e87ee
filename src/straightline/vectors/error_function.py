"""Error function, its complement and its inverse on vectors."""

import math

import jaxlib.version

from straightline.vectors.exponential import exp_of_sum, find_format, log, log1p
from straightline.vectors.formula_builder import Vector, copy_sign, fma, polynomial, select, sqrt

# erf x = x + x P / Q in x^2, |x| < 27/32.
CENTRE = (
    [0.12837916709551256, -0.3250421072470015, -0.02848174957559851, -0.005770270296489442, -2.3763016656650163e-05],
    [1.0, 0.39791722395915535, 0.0650222499887673, 0.005081306281875766, 0.00013249473800432164,
     -3.960228278775368e-06],
)  # fmt: skip
# erf x = AT_ONE + P / Q in x - 1, 27/32 <= x < 5/4.
AT_ONE = 8.45062911510467529297e-01
MIDDLE = (
    [-0.0023621185607526594, 0.41485611868374833, -0.3722078760357013, 0.31834661990116175, -0.11089469428239668,
     0.035478304325618236, -0.002166375594868791, 0.0],
    [1.0, 0.10642088040084423, 0.540397917702171, 0.07182865441419627, 0.12617121980876164, 0.01363708391202905,
     0.011984499846799107, 0.0, 0.0],
)  # fmt: skip
# erfc x = e^(-x^2 - 9/16 + P / Q) / x in 1 / x^2, 5/4 <= x < 1/0.35 and beyond.
OUTER = (
    [-0.009864944034847148, -0.6938585727071818, -10.558626225323291, -62.375332450326006, -162.39666946257347,
     -184.60509290671104, -81.2874355063066, -9.814329344169145],
    [1.0, 19.651271667439257, 137.65775414351904, 434.56587747522923, 645.3872717332679, 429.00814002756783,
     108.63500554177944, 6.570249770319282, -0.0604244152148581],
)  # fmt: skip
FAR = (
    [-0.0098649429247001, -0.799283237680523, -17.757954917754752, -160.63638485582192, -637.5664433683896,
     -1025.0951316110772, -483.5191916086514, 0.0],
    [1.0, 30.33806074348246, 325.7925129965739, 1536.729586084437, 3199.8582195085955, 2553.0504064331644,
     474.52854120695537, -22.44095244658582, 0.0],
)  # fmt: skip

# erf_inv x = x p(w), w = -log(1 - x^2): in w - 3.125 for w < 6.25, in sqrt(w) - 3.25 for w < 16, in sqrt(w) - 5 beyond.
# Source: Giles, Approximating the erfinv function (2010), whose coefficients XLA uses for float64.
INVERSE = (
    [-3.64441206401782e-21, -1.6850591381820166e-19, 1.28584807152564e-18, 1.1157877678025181e-17,
     -1.333171662854621e-16, 2.0972767875968562e-17, 6.637638134358324e-15, -4.054566272975207e-14,
     -8.151934197605472e-14, 2.6335093153082323e-12, -1.2975133253453532e-11, -5.415412054294628e-11,
     1.0512122733215323e-09, -4.112633980346984e-09, -2.9070369957882005e-08, 4.2347877827932404e-07,
     -1.3654692000834679e-06, -1.3882523362786469e-05, 0.00018673420803405714, -0.000740702534166267,
     -0.006033670871430149, 0.24015818242558962, 1.6536545626831027],
    [2.2137376921775787e-09, 9.075656193888539e-08, -2.7517406297064545e-07, 1.8239629214389228e-08,
     1.5027403968909828e-06, -4.013867526981546e-06, 2.9234449089955446e-06, 1.2475304481671779e-05,
     -4.7318229009055734e-05, 6.828485145957318e-05, 2.4031110387097894e-05, -0.0003550375203628475,
     0.0009532893797373805, -0.0016882755560235047, 0.002491442096107851, -0.003751208507569241, 0.005370914553590064,
     1.0052589676941592, 3.0838856104922208],
    [-2.7109920616438573e-11, -2.555641816996525e-10, 1.5076572693500548e-09, -3.789465440126737e-09,
     7.61570120807834e-09, -1.496002662714924e-08, 2.914795345090108e-08, -6.771199775845234e-08,
     2.2900482228026655e-07, -9.9298272942317e-07, 4.526062597223154e-06, -1.968177810553167e-05,
     7.599527703001776e-05, -0.00021503011930044477, -0.00013871931833623122, 1.0103004648645344, 4.849906401408584],
)  # fmt: skip

INVERSE_OF_FLOATS = (
    [2.81022636e-08, 3.43273939e-07, -3.5233877e-06, -4.39150654e-06, 0.00021858087, -0.00125372503, -0.00417768164,
     0.246640727, 1.50140941],
    [-0.000200214257, 0.000100950558, 0.00134934322, -0.00367342844, 0.00573950773, -0.0076224613, 0.00943887047,
     1.00167406, 2.83297682],
)  # fmt: skip

PRECISE = (0, 11, 2)  # the first jaxlib, among those that were tried, whose log1p is precise

# log(1 + t) = t - t^2 / 2 + t^3 P / Q for |t| < sqrt(2) - 1. Source: Moshier's Cephes, https://www.netlib.org/cephes.
LOG1P = (
    [20.039553499201283, 57.11296359058554, 60.94966798098779, 29.911919328553072, 6.578732594206104,
     0.49854102823193375, 4.52700008624452e-05],
    [60.11866049760384, 216.42788614495947, 309.09872225312057, 221.76239823732857, 83.04756596796722,
     15.062909083469192, 1.0],
)  # fmt: skip


def erf(x: Vector) -> Vector:
    """Return erf x, 2 / sqrt(pi) times the integral of e^(-t^2) from 0 to x, by a formula for each range of |x|.

    With s = |x|: s + s centre below 0.84375, AT_ONE + middle below 1.25, 1 - tail below 6, and 1 beyond.
    """
    size = abs(x)
    centre, middle, tail = _evaluate_ranges(size)
    outer = select(size < 1.25, AT_ONE + middle, select(size >= 6.0, 1.0, 1 - tail))
    return copy_sign(select(size < 0.84375, fma(size, centre, size), outer), x)


def erfc(x: Vector) -> Vector:
    """Return erfc x = 1 - erf x, precise where it is small, by a formula for each range of |x| and sign of x.

    The three parts are those of `erf`: erf x is x + x centre near 0, AT_ONE + middle around 1, and 1 - tail far out.
    """
    size = abs(x)
    centre, middle, tail = _evaluate_ranges(size)
    # Near 0, 1 - (x + x centre); above 1/4, where 1 - x rounds, written about 1/2.
    inner = select(x < 0.25, 1 - fma(x, centre, x), 0.5 - (x - 0.5 + x * centre))
    # Further out, erfc x of positive x, and 2 - erfc(-x) of negative ones; from 28 or -6 on they are 0 and 2.
    positive = select(size < 1.25, (1 - AT_ONE) - middle, select(size >= 28.0, 0.0, tail))
    negative = select(size < 1.25, 1 + (AT_ONE + middle), 2 - tail)
    negative = select(size >= 6.0, 2.0, negative)
    return select(size < 0.84375, inner, select(x < 0.0, negative, positive))


def _evaluate_ranges(size: Vector) -> tuple[Vector, Vector, Vector]:
    """Return (erf x - x) / x, erf x - AT_ONE, and erfc x for numbers x >= 0 (`size`), each valid in its own range.

    The first is valid below 0.84375, the second from there up to 1.25, and the third beyond.
    """
    square = size * size
    centre = polynomial(square, CENTRE[0]) / polynomial(square, CENTRE[1])
    # Near 1 and beyond: one rational function whose coefficients and argument depend on where x is.
    near, far = size < 1.25, size >= 1 / 0.35
    numerator, denominator = (
        [select(near, a, select(far, size.like(c), b)) for a, b, c in zip(MIDDLE[i], OUTER[i], FAR[i], strict=True)]
        for i in (0, 1)
    )
    argument = select(near, size - 1, 1 / square)
    middle = polynomial(argument, numerator) / polynomial(argument, denominator)
    # e^(-x^2) to all digits: x = z + (x - z), z of so few digits that z^2 is exact.
    dropped = 32 if size.scalar == "double" else 13
    z = (size.as_type(find_format(size).word) & -(1 << dropped)).as_type(size.scalar)
    square, rest = fma(-z, z, -0.5625), fma(z - size, z + size, middle)
    power = square + rest
    tail = exp_of_sum(power, (square - power) + rest) / size
    return centre, middle, tail


def erf_inv(x: Vector) -> Vector:
    """Return the inverse of erf by XLA's polynomials, so that normal random numbers agree; infinite at -1 and 1.

    Beyond it is NaN. It is x times a factor, a polynomial in w = -log(1 - x^2) or in its root.
    """
    w = -_log1p(-(x * x))

    def compute_outer_factor() -> Vector:
        """Return the factor for w = -log(1 - x^2) >= 6.25, which about one draw in a thousand needs.

        It is a polynomial in sqrt(w) - 3.25 for w < 16, and one in sqrt(w) - 5 beyond.
        """
        is_below_16, root = w < 16.0, sqrt(w)
        above = polynomial(root - 5, INVERSE[2][::-1])
        below = polynomial(root - 3.25, INVERSE[1][::-1])
        return select(is_below_16, below, above)

    # The tables have the highest coefficient first, `polynomial` takes it last.
    inner_factor = polynomial(w - 3.125, INVERSE[0][::-1])
    factor = x.body.compute_where_needed(w >= 6.25, compute_outer_factor, inner_factor)
    return x * select(abs(x).equals(1.0), math.inf, factor)


def erf_inv_of_floats(x: Vector) -> Vector:
    """Return the inverse of erf as x times one of XLA's two polynomials for float32, with w = -log(1 - x^2).

    For w < 5 it is a polynomial in w - 2.5, beyond in sqrt(w) - 3. At |x| = 1 the result is infinite.
    Source: Giles, Approximating the erfinv function (2010).
    """
    w = -log1p(-(x * x))
    is_near = w < 5.0
    argument = select(is_near, w - 2.5, sqrt(w) - 3)
    # Each lane takes the coefficients of its own polynomial. The tables have the highest coefficient first, and
    # `polynomial` takes it last.
    highest_first = [select(is_near, x.like(near), far) for near, far in zip(*INVERSE_OF_FLOATS, strict=True)]
    factor = polynomial(argument, highest_first[::-1])
    return x * select(abs(x).equals(1.0), math.inf, factor)


def _log1p(t: Vector) -> Vector:
    """Return log(1 + t) as XLA does, so that random numbers agree.

    From jaxlib 0.11.2 on (PRECISE), XLA's is precise. Earlier ones (0.11.0 was tried) are up to 53 units of rounding
    off near -0.4. For |t| < sqrt(2) - 1 they compute t - t^2 / 2 + t^3 times a quotient of polynomials (LOG1P), and
    else log(1 + t), where the sum is rounded.
    """
    if jaxlib.version.__version_info__ >= PRECISE:
        return log1p(t)
    square = t * t
    cubed = t * square * (polynomial(t, LOG1P[0]) / polynomial(t, LOG1P[1]))
    return select(abs(t) < math.sqrt(2) - 1, t + fma(square, -0.5, cubed), log(1 + t))
