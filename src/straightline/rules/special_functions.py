"""Rules of special functions by their series: incomplete gamma functions, Bessel functions, the digamma function."""

from collections.abc import Callable
from fractions import Fraction
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn

from straightline.lowering import IN_MEMORY, Lowering, Value, arrange_nodes, make_placeholder, type_of
from straightline.nodes import Type, Unsupported

EPSILON = float(np.finfo(np.float64).eps)
FAR = 30.0  # the argument of a Bessel function from which its asymptotic series has all digits
BERNOULLI = [1 / 12, -1 / 120, 1 / 252, -1 / 240, 1 / 132, -691 / 32760, 1 / 12, -3617 / 8160]  # B_2n / (2 n)
TINY = float(np.finfo(np.float64).tiny) / EPSILON
LARGE, TERMS = 2000.0, 20  # the shape from which gamma masses are expanded, to a^-3, and the terms of a coefficient
MOST_TERMS = 5000  # of a series or a fraction, several times as many as it takes


class SeriesState(NamedTuple):
    """State of a series: a number that counts its terms, the last term, and the sum."""

    step: jax.Array
    term: jax.Array
    total: jax.Array


class ContinuedFraction(NamedTuple):
    """State of a continued fraction: how many terms, Lentz's quotients C and D, the value, its last relative change."""

    terms: jax.Array
    c: jax.Array
    d: jax.Array
    value: jax.Array
    change: jax.Array


def regularised_incomplete_gammas(a: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute the mass below and above x of the gamma law of shape a: P(a, x) and Q(a, x) = 1 - P, each to its digits.

    With the density p = x^a e^-x / Gamma(a): up to x = a + 1 P is computed by a series, above it Q by a continued
    fraction (`_sum_lower_series`, `_evaluate_upper_fraction`), as each is accurate there. For a > LARGE both are
    expanded in 1 / a. NaN where a or x is below zero.

    Source: Abramowitz and Stegun, Handbook of mathematical functions, 6.5.29 and 6.5.31.
    """
    is_valid, is_large = (a > 0) & (x >= 0), a > LARGE
    # Where neither series nor fraction is used, compute with 1 for a and x, so that no NaN comes into the loops.
    serves_none = is_large | ~is_valid
    a_or_one, x_or_one = jnp.where(serves_none, 1.0, a), jnp.where(serves_none, 1.0, x)
    # x > a + 1: the fraction is used; else the series.
    above = x_or_one > a_or_one + 1
    density = jnp.exp(a_or_one * jnp.log(x_or_one) - x_or_one - jax.lax.lgamma(a_or_one))
    lower = density * _sum_lower_series(a_or_one, x_or_one, skipped=above)
    upper = density * _evaluate_upper_fraction(a_or_one, x_or_one, serves=above)
    # The smaller mass as computed, to all its digits; the other one is 1 minus it.
    p = jnp.where(x_or_one == jnp.inf, 1.0, jnp.where(above, 1 - upper, lower))
    q = jnp.where(above & (x_or_one < jnp.inf), upper, 1 - p)
    # Large a: take the expansion.
    expanded_p, expanded_q = regularised_incomplete_gammas_of_large_shape(a, x)
    use_expansion = is_large & (x < jnp.inf)
    p, q = jnp.where(use_expansion, expanded_p, p), jnp.where(use_expansion, expanded_q, q)
    # Limits: all mass is below x = inf, and a law of shape 0 is all at 0.
    p, q = jnp.where(x == jnp.inf, 1.0, p), jnp.where(x == jnp.inf, 0.0, q)
    at_zero = (a == 0) & (x > 0)
    p, q = jnp.where(at_zero, 1.0, p), jnp.where(at_zero, 0.0, q)
    return jnp.where(is_valid | at_zero, p, jnp.nan), jnp.where(is_valid | at_zero, q, jnp.nan)


def _sum_lower_series(a: jax.Array, x: jax.Array, skipped: jax.Array) -> jax.Array:
    """Return P(a, x) / (x^a e^-x / Gamma(a)) = sum_n x^n / (a (a + 1) ... (a + n)); 0 where it is skipped.

    It converges fast for x < a + 1.
    """

    def add_term(state: SeriesState) -> SeriesState:
        """Add the next term of the series: the last term times x / d, where d is a + 1, a + 2, ... in turn."""
        denominator, term, total = state
        term = term * x / (denominator + 1)
        return SeriesState(denominator + 1, term, total + term)

    def has_more_terms(state: SeriesState) -> jax.Array:
        """Return whether the last term counts: a series that is skipped ends at once."""
        return (state.term > EPSILON * state.total) & (state.step < a + MOST_TERMS)

    first = jnp.where(skipped, 0.0, 1 / a)
    return jax.lax.while_loop(has_more_terms, add_term, SeriesState(a, first, first)).total


def _evaluate_upper_fraction(a: jax.Array, x: jax.Array, serves: jax.Array) -> jax.Array:
    """Return Q(a, x) / (x^a e^-x / Gamma(a)) where x > a + 1, by a continued fraction; elsewhere any number.

    Q is the regularised upper incomplete gamma function. The ratio is 1 / (x + 1 - a - 1 (1 - a) / (x + 3 - a -
    2 (2 - a) / (x + 5 - a - ...))), by Lentz's method: the value is a product of C_n D_n, quotients of consecutive
    numerators and of consecutive denominators. `serves`: where x > a + 1; the loop ends at once for other entries.

    Source: Lentz, Generating Bessel functions in Mie scattering calculations using continued fractions (1976).
    """

    def continue_fraction(state: ContinuedFraction) -> ContinuedFraction:
        """Add level n of the continued fraction, with the numerator n (a - n) and the denominator x + 2 n + 1 - a.

        By Lentz's method the fraction is a product of ratios c d, and it has converged when the last ratio is 1. The
        last number of the state is |c d - 1|.
        """
        n, c, d, fraction, _ = state
        numerator, denominator = n * (a - n), x + 2 * n + 1 - a
        c = denominator + numerator / c
        d = 1 / _replace_zero_by_tiny(denominator + numerator * d)
        return ContinuedFraction(n + 1, _replace_zero_by_tiny(c), d, fraction * c * d, jnp.abs(c * d - 1))

    def still_changes(state: ContinuedFraction) -> jax.Array:
        """Return whether the last level changed the value; a fraction that does not serve ends at once."""
        return (state.change > EPSILON) & (state.terms < MOST_TERMS)

    first = 1 / jnp.where(serves, x + 1 - a, 1.0)
    start = ContinuedFraction(
        terms=jnp.ones_like(x), c=jnp.full_like(x, 1 / TINY), d=first, value=first, change=jnp.where(serves, 1.0, 0.0)
    )
    return jax.lax.while_loop(still_changes, continue_fraction, start).value


def regularised_incomplete_gammas_of_large_shape(a: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute P(a, x) and Q(a, x), the masses of the gamma law of a large shape a below and above x, by expansion.

    A series in powers of x would take many terms for a large a; this expansion in 1 / a is about the normal law.

    With y^2 / 2 = m - log(1 + m), m = x / a - 1, y of the sign of m,
    Q = erfc(y root(a / 2)) / 2 + e^(-a y^2 / 2) / root(2 pi a) (c_0(y) + c_1(y) / a + c_2(y) / a^2), P = 1 - Q.

    Source: Temme, The asymptotic expansion of the incomplete gamma functions (1979); DLMF 8.12.3, 8.12.4.
    """
    m = jnp.clip((x - a) / a, -0.9, 3.0)  # beyond these limits the smaller mass is below the least positive number
    # y^2 / 2 = m - log(1 + m) = m s - 2 s (s^2 / 3 + s^4 / 5 + ...), s = m / (2 + m): near 0, where the difference
    # would cancel, by the series up to s^26 / 27, whose next term is below rounding for |m| < 0.4.
    s = m / (2 + m)
    tail = jnp.zeros_like(m)
    for n in range(27, 1, -2):
        tail = (tail + 1 / n) * s * s
    half_square = jnp.where(jnp.abs(m) < 0.4, m * s - 2 * s * tail, m - jnp.log1p(m))
    y = jnp.where(m < 0, -1.0, 1.0) * jnp.sqrt(2 * half_square)
    # c_0(y) + c_1(y) / a + c_2(y) / a^2 from the last on; each c_k is a power series of y, by Horner's rule.
    correction = jnp.zeros_like(y)
    for coefficients in expand_coefficients()[::-1]:
        c_k = jnp.zeros_like(y)
        for c in coefficients[::-1]:
            c_k = c_k * y + c
        correction = correction / a + c_k
    correction = correction * jnp.exp(-a * half_square) / jnp.sqrt(2 * np.pi * a)
    z = y * jnp.sqrt(a / 2)
    return jax.lax.erfc(-z) / 2 - correction, jax.lax.erfc(z) / 2 + correction


@cache
def expand_coefficients() -> list[list[float]]:
    """Return `TERMS` coefficients of the power series in y of c_0, c_1 and c_2, of Temme's expansion of Q(a, x).

    Q(a, x) is the incomplete gamma function for a large shape a. With m = x / a - 1 and y^2 / 2 = m - log(1 + m), its
    correction is c_0(y) + c_1(y) / a + c_2(y) / a^2, c_0 = 1 / m - 1 / y and c_k = c_(k-1)' / y + (-1)^k g_k / m. The
    g_1 = 1 / 12 and g_2 = 1 / 288 are those of Stirling's series of Gamma(a).
    """
    count = TERMS + 5
    # m = y sum_n b_n y^n, b_0 = 1. The derivative of y^2 / 2 is y = m m' / (1 + m), so y (1 + m) = m m'. Its power
    # n + 1 of y is b_(n-1) = sum_{k=0}^n b_k (n - k + 1) b_(n-k), in which b_n has the factor n + 2.
    b = [Fraction(1)]
    for n in range(1, count):
        terms_without_b_n = sum((b[k] * b[n - k] * (n - k + 1) for k in range(1, n)), Fraction(0))
        b.append((b[n - 1] - terms_without_b_n) / (n + 2))
    # 1 / m = (1 / y) sum_n r_n y^n, r_0 = 1, from sum_{k=0}^n b_k r_(n-k) = 0.
    r = [Fraction(1)]
    for n in range(1, count):
        r.append(-sum((b[k] * r[n - k] for k in range(1, n + 1)), Fraction(0)))
    # c_0 = 1 / m - 1 / y has the coefficients r_1, r_2, ...; in c_1 and c_2, too, the terms with 1 / y cancel.
    series = [r[1:]]
    for signed_g in (Fraction(-1, 12), Fraction(1, 288)):  # (-1)^k g_k
        previous = series[-1]
        series.append([(n + 2) * previous[n + 2] + signed_g * r[n + 1] for n in range(len(previous) - 2)])
    return [[float(c) for c in coefficients[:TERMS]] for coefficients in series]


def _replace_zero_by_tiny(x: jax.Array) -> jax.Array:
    """Return x, with TINY in the place of 0, since Lentz's method divides by it: the next quotient makes up for it."""
    return jnp.where(x == 0, TINY, x)


def scaled_bessel(order: int, x: jax.Array) -> jax.Array:
    """Compute e^-|x| I_v(x), the scaled modified Bessel function of order v = 0 or 1.

    The factor e^-|x| keeps it finite for large x. Up to |x| = FAR it is summed by the power series
    I_v = (x / 2)^v sum_k (x^2 / 4)^k / (k! (k + v)!), v the `order`. Beyond it is summed by the asymptotic series
    I_v = e^x / root(2 pi x) (1 + sum_k a_k), a_k = a_k-1 ((2 k - 1)^2 - 4 v^2) / (8 k x), a_0 = 1, whose terms fall to
    1e-26. One loop sums both, so that each lane takes the ratio of terms of its own series.

    Source: Abramowitz and Stegun, Handbook of mathematical functions, 9.6.10 and 9.7.1.
    """
    size = jnp.abs(x)
    is_far = size > FAR

    def add_term(state: SeriesState) -> SeriesState:
        """Add term k of the series of a Bessel function: the last term times a ratio.

        Where `is_far` it is the asymptotic series, elsewhere the power series. `size` is the function's argument, and
        `order` its order.
        """
        k, term, total = state
        power_ratio = size * size / (4 * k * (k + order))
        asymptotic_ratio = ((2 * k - 1) ** 2 - 4 * order**2) / (8 * k * jnp.where(is_far, size, 1.0))
        ratio = jnp.where(is_far, asymptotic_ratio, power_ratio)
        return SeriesState(k + 1, term * ratio, total + term * ratio)

    def has_more_terms(state: SeriesState) -> jax.Array:
        """Return whether the last term is above rounding."""
        return jnp.abs(state.term) > EPSILON / 8 * state.total

    # Term of k = 0: 1, or x / 2 in the power series of I_1.
    first = jnp.where(is_far | (order == 0), 1.0, size / 2)
    total = jax.lax.while_loop(has_more_terms, add_term, SeriesState(jnp.ones_like(x), first, first)).total
    # Factor before the sum: 1 / root(2 pi x) far out (e^x e^-x cancel), else e^-|x|.
    scale = jnp.where(is_far, 1 / (np.sqrt(2 * np.pi) * jnp.sqrt(jnp.where(is_far, size, 1.0))), jnp.exp(-size))
    value = jnp.where(jnp.isnan(x), jnp.nan, total * scale)
    if order == 0:
        return value
    return jnp.where(x < 0, -value, jnp.where(x == 0, x, value))  # I_1 is odd; zeros keep their sign


def digamma(x: jax.Array) -> jax.Array:
    """Compute the derivative of log Gamma(x): at 10 and more from its asymptotic series, to which a recurrence leads.

    psi(x) = psi(x + 1) - 1 / x = log x - 1 / (2 x) - sum_n B_2n / (2 n x^2n), psi(x) = psi(1 - x) - pi / tan(pi x).

    Source: Abramowitz and Stegun, Handbook of mathematical functions, 6.3.5, 6.3.7 and 6.3.18.
    """
    # Where x is not positive, psi(1 - x) first. From `large` = y + n >= 10 back: psi(y) = psi(y + n) - sum 1 / (y + i).
    mirrored = x <= 0
    large = jnp.where(mirrored, 1 - x, x)
    reciprocals = jnp.zeros_like(x)
    for _ in range(10):
        is_small = large < 10
        reciprocals, large = reciprocals + jnp.where(is_small, 1 / large, 0.0), jnp.where(is_small, large + 1, large)
    square, tail = 1 / (large * large), jnp.zeros_like(x)
    for coefficient in BERNOULLI[::-1]:
        tail = (tail + coefficient) * square
    value = jnp.log(large) - 0.5 / large - tail - reciprocals
    # tan(pi x) by the distance from the nearest whole number, which is exact; a pole at each of these.
    distance = x - jnp.round(x)
    reflection = np.pi / jnp.tan(np.pi * jnp.where(distance == 0, 1.0, distance))
    return jnp.where(mirrored, jnp.where(distance == 0, jnp.nan, value - reflection), value)


def _lower_igamma(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Return P(a, x) for JAX's operation `igamma`, or Q(a, x) = 1 - P(a, x) for `igammac`, entry by entry.

    P is the mass below x of the gamma law of shape a. `inputs` are the arrays a and x; the function that computes P and
    Q, written with JAX, is lowered: added as scalar operations to the program that is being written (`lowering`).
    """
    p, q = _inline_in_double(regularised_incomplete_gammas, lowering, equation, inputs)
    return [q if equation.primitive.name == "igammac" else p]


def _inline_in_double(
    function: Callable[..., Any], lowering: Lowering, equation: JaxprEqn, inputs: list[Value]
) -> list[Value]:
    """Return the results of a function of scalars for each entry of arrays, computed in double precision.

    The arguments may be doubles or floats. The results are converted back to the arguments' type.
    """
    avals: list[Any] = [v.aval for v in equation.invars]
    if avals[0].dtype not in (np.float64, np.float32):
        raise Unsupported(f"{equation.primitive.name} of numbers of type {avals[0].dtype}")
    program = _trace_over_arrays(function, len(avals), avals[0].shape)
    results = lowering.inline_program(program, [_convert(lowering, "f64", x) for x in inputs])
    return [_convert(lowering, type_of(avals[0]), x) for x in results]


def _convert(lowering: Lowering, type: Type, value: Value) -> Value:
    """Return an array as nodes (scalar operations) that convert each of its numbers to another type."""
    nodes = lowering.nodes(value)
    return arrange_nodes((lowering.graph.node("convert", type, n) for n in nodes.ravel().tolist()), nodes.shape)


@cache
def _trace_over_arrays(function: Callable[..., Any], count: int, shape: tuple[int, ...]) -> ClosedJaxpr:
    """Return the program that applies a function of `count` scalars to each entry of `count` arrays of this shape.

    JAX traces it in double precision, by `vmap` over each axis; it is traced once for each shape.
    """
    over_arrays = function
    for _ in shape:
        over_arrays = jax.vmap(over_arrays)
    with jax.enable_x64(True):
        return jax.make_jaxpr(over_arrays)(*[make_placeholder(shape, np.float64)] * count)


OF_ONE: dict[str, Callable[[jax.Array], jax.Array]] = {
    "bessel_i0e": partial(scaled_bessel, 0),
    "bessel_i1e": partial(scaled_bessel, 1),
    "digamma": digamma,
}
IN_MEMORY |= {"igamma": _lower_igamma, "igammac": _lower_igamma}
IN_MEMORY |= {name: partial(_inline_in_double, function) for name, function in OF_ONE.items()}
