"""The error function, its complement and its inverse on vectors."""

import math

from heliograph.codegen.vector_exponential import exp_of_sum, log
from heliograph.codegen.vector_text import Vector, copy_sign, fma, polynomial, select, sqrt

# erf x = x + x P / Q in x^2, |x| < 27/32.
CENTRE = (
    [1.28379167095512558561e-01, -3.25042107247001499370e-01, -2.84817495755985104766e-02, -5.77027029648944159157e-03,
     -2.37630166566501626084e-05],
    [1.0, 3.97917223959155352819e-01, 6.50222499887672944485e-02, 5.08130628187576562776e-03, 1.32494738004321644526e-04,
     -3.96022827877536812320e-06],
)  # fmt: skip
# erf x = AT_ONE + P / Q in x - 1, 27/32 <= x < 5/4.
AT_ONE = 8.45062911510467529297e-01
MIDDLE = (
    [-2.36211856075265944077e-03, 4.14856118683748331666e-01, -3.72207876035701323847e-01, 3.18346619901161753674e-01,
     -1.10894694282396677476e-01, 3.54783043256182359371e-02, -2.16637559486879084300e-03, 0.0],
    [1.0, 1.06420880400844228286e-01, 5.40397917702171048937e-01, 7.18286544141962662868e-02, 1.26171219808761642112e-01,
     1.36370839120290507362e-02, 1.19844998467991074170e-02, 0.0, 0.0],
)  # fmt: skip
# erfc x = e^(-x^2 - 9/16 + P / Q) / x in 1 / x^2, 5/4 <= x < 1/0.35 and beyond.
OUTER = (
    [-9.86494403484714822705e-03, -6.93858572707181764372e-01, -1.05586262253232909814e+01, -6.23753324503260060396e+01,
     -1.62396669462573470355e+02, -1.84605092906711035994e+02, -8.12874355063065934246e+01, -9.81432934416914548592e+00],
    [1.0, 1.96512716674392571292e+01, 1.37657754143519042600e+02, 4.34565877475229228821e+02, 6.45387271733267880336e+02,
     4.29008140027567833386e+02, 1.08635005541779435134e+02, 6.57024977031928170135e+00, -6.04244152148580987438e-02],
)  # fmt: skip
FAR = (
    [-9.86494292470009928597e-03, -7.99283237680523006574e-01, -1.77579549177547519889e+01, -1.60636384855821916062e+02,
     -6.37566443368389627722e+02, -1.02509513161107724954e+03, -4.83519191608651397019e+02, 0.0],
    [1.0, 3.03380607434824582924e+01, 3.25792512996573918826e+02, 1.53672958608443695994e+03, 3.19985821950859553908e+03,
     2.55305040643316442583e+03, 4.74528541206955367215e+02, -2.24409524465858183362e+01, 0.0],
)  # fmt: skip

# erf_inv x = x p(w), w = -log(1 - x^2): in w - 3.125 for w < 6.25, in sqrt(w) - 3.25 for w < 16, in sqrt(w) - 5 beyond.
# Source: Giles, Approximating the erfinv function (2010), whose coefficients XLA uses for float64.
INVERSE = (
    [-3.6444120640178196996e-21, -1.685059138182016589e-19, 1.2858480715256400167e-18, 1.115787767802518096e-17,
     -1.333171662854620906e-16, 2.0972767875968561637e-17, 6.6376381343583238325e-15, -4.0545662729752068639e-14,
     -8.1519341976054721522e-14, 2.6335093153082322977e-12, -1.2975133253453532498e-11, -5.4154120542946279317e-11,
     1.051212273321532285e-09, -4.1126339803469836976e-09, -2.9070369957882005086e-08, 4.2347877827932403518e-07,
     -1.3654692000834678645e-06, -1.3882523362786468719e-05, 0.0001867342080340571352, -0.00074070253416626697512,
     -0.0060336708714301490533, 0.24015818242558961693, 1.6536545626831027356],
    [2.2137376921775787049e-09, 9.0756561938885390979e-08, -2.7517406297064545428e-07, 1.8239629214389227755e-08,
     1.5027403968909827627e-06, -4.013867526981545969e-06, 2.9234449089955446044e-06, 1.2475304481671778723e-05,
     -4.7318229009055733981e-05, 6.8284851459573175448e-05, 2.4031110387097893999e-05, -0.0003550375203628474796,
     0.00095328937973738049703, -0.0016882755560235047313, 0.0024914420961078508066, -0.0037512085075692412107,
     0.005370914553590063617, 1.0052589676941592334, 3.0838856104922207635],
    [-2.7109920616438573243e-11, -2.5556418169965252055e-10, 1.5076572693500548083e-09, -3.7894654401267369937e-09,
     7.6157012080783393804e-09, -1.4960026627149240478e-08, 2.9147953450901080826e-08, -6.7711997758452339498e-08,
     2.2900482228026654717e-07, -9.9298272942317002539e-07, 4.5260625972231537039e-06, -1.9681778105531670567e-05,
     7.5995277030017761139e-05, -0.00021503011930044477347, -0.00013871931833623122026, 1.0103004648645343977,
     4.8499064014085844221],
)  # fmt: skip

# log(1 + t) = t - t^2 / 2 + t^3 P / Q for |t| < sqrt(2) - 1. Source: Moshier's Cephes, https://www.netlib.org/cephes.
LOG1P = (
    [20.039553499201281259648, 57.112963590585538103336, 60.949667980987787057556, 29.911919328553073277375,
     6.5787325942061044846969, 0.49854102823193375972212, 4.5270000862445199635215e-05],
    [60.118660497603843919306, 216.42788614495947685003, 309.09872225312059774938, 221.76239823732856465394,
     83.047565967967209469434, 15.062909083469192043167, 1.0],
)  # fmt: skip


def erf(x: Vector) -> Vector:
    """2 / sqrt(pi) times the integral of e^(-t^2) from 0 to x."""
    size = abs(x)
    centre, middle, tail = _parts(size)
    outer = select(size < 1.25, AT_ONE + middle, select(size >= 6.0, 1.0, 1 - tail))
    return copy_sign(select(size < 0.84375, fma(size, centre, size), outer), x)


def erfc(x: Vector) -> Vector:
    """1 - erf x, precise where it is small."""
    size = abs(x)
    centre, middle, tail = _parts(size)
    inner = select(x < 0.25, 1 - fma(x, centre, x), 0.5 - (x - 0.5 + x * centre))
    positive = select(size < 1.25, (1 - AT_ONE) - middle, select(size >= 28.0, 0.0, tail))
    negative = select(size < 1.25, 1 + (AT_ONE + middle), 2 - tail)
    negative = select(size >= 6.0, 2.0, negative)
    return select(size < 0.84375, inner, select(x < 0.0, negative, positive))


def _parts(size: Vector) -> tuple[Vector, Vector, Vector]:
    """(erf x - x) / x near 0, erf x - AT_ONE near 1, erfc x beyond: each right where it is used alone."""
    square = size * size
    centre = polynomial(square, CENTRE[0]) / polynomial(square, CENTRE[1])
    # Near 1 and beyond: one rational function whose coefficients and argument depend on where x is.
    near, far = size < 1.25, size >= 1 / 0.35
    above, below = (
        [select(near, a, select(far, c, b)) for a, b, c in zip(MIDDLE[i], OUTER[i], FAR[i], strict=True)]
        for i in (0, 1)
    )
    argument = select(near, size - 1, 1 / square)
    middle = polynomial(argument, above) / polynomial(argument, below)
    # e^(-x^2) to all digits: x = z + (x - z), z of so few digits that z^2 is exact.
    z = (size.as_type("i64") & -(1 << 32)).as_type("double")
    square, rest = fma(-z, z, -0.5625), fma(z - size, z + size, middle)
    power = square + rest
    tail = exp_of_sum(power, (square - power) + rest) / size
    return centre, middle, tail


def erf_inv(x: Vector) -> Vector:
    """The inverse of erf, by the polynomials of which XLA draws normal numbers; infinite at -1 and 1, NaN beyond."""
    w = -_log1p(-(x * x))

    def outer() -> Vector:
        # One draw in a thousand.
        middle, root = w < 16.0, sqrt(w)
        tail = polynomial(root - 5, INVERSE[2][::-1])
        end = polynomial(root - 3.25, INVERSE[1][::-1])
        return select(middle, end, tail)

    factor = x.body.where_any(w >= 6.25, outer, polynomial(w - 3.125, INVERSE[0][::-1]))
    return x * select(abs(x).equals(1.0), math.inf, factor)


def _log1p(t: Vector) -> Vector:
    """log(1 + t) as XLA computes it, so that its draws and these are the same: 53 units of rounding off near -0.4."""
    square = t * t
    cubed = t * square * (polynomial(t, LOG1P[0]) / polynomial(t, LOG1P[1]))
    return select(abs(t) < math.sqrt(2) - 1, t + fma(square, -0.5, cubed), log(1 + t))
