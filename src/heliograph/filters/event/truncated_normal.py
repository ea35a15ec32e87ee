"""Moments of a standard normal number that is known to lie in an interval, to the last digits wherever that lies."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from straightline import operation

# The density beyond sqrt(t^2 + REACH), t the interval's point nearest 0, is below exp(-REACH / 2) = 8e-17 of that at t.
REACH = 74.0
NODES, WEIGHTS = (array / 2 for array in np.polynomial.legendre.leggauss(40))
NODES = NODES + 0.5  # on (0, 1)


FAR = 4.0  # from there the tail is a continued fraction, before it a complementary error function
DEPTH = 32  # of the fraction, of which the variance at FAR has a relative error of 4e-14


class TruncatedNormalMoments(NamedTuple):
    """log P(lower <= e <= upper) of e ~ N(0, 1), and mean and variance of e in the interval."""

    log_mass: jax.Array
    mean: jax.Array
    variance: jax.Array


PAIR = 2  # computed side by side: of one alone each operation waits for the one before
Moments = Callable[..., TruncatedNormalMoments]


def _loop_two_intervals_at_a_time(moments: Moments) -> Moments:
    """Return `moments` as one operation that takes intervals in a loop, PAIR (2) at a time.

    Native code then holds the program of the moments only once, for any number of intervals.
    """

    def compute_in_loop(*ends: jax.Array) -> TruncatedNormalMoments:
        """Compute `moments` of intervals with these ends, PAIR (2) at a time, or singly if their number is odd."""
        width = 1 if ends[0].size % PAIR else PAIR
        results = jax.lax.map(lambda pair: moments(*pair), [end.reshape(-1, width) for end in ends])
        return TruncatedNormalMoments(*(moment.reshape(ends[0].shape) for moment in results))

    return operation(compute_in_loop)(moments)


@_loop_two_intervals_at_a_time
def truncated_normal(lower: jax.Array, upper: jax.Array) -> TruncatedNormalMoments:
    """Return log mass, mean and variance of N(0, 1) cut to [lower, upper], either of which may be infinite.

    The closed forms are differences of larger numbers: 1 + (a phi(a) - b phi(b)) / Z - m^2 is wrong, or negative, far
    from 0 and where the interval is short. Instead the density is integrated about t, the point of the interval that is
    nearest 0, in u = |x| - |t|, relative to its value there:

        phi(t + u) / phi(t) = exp(-u (u / 2 + t)),      0 <= u <= sqrt(t^2 + 74) - t

    by 40 Gauss-Legendre nodes. The variance is a sum of squares, so that it is never negative. Relative errors: of the
    variance 1e-13, of the mean and of the mass 1e-12. An interval of one point has the mass 0 (-inf) and variance 0.

    Shapes: of both the same, which the results have.

    Source: Golub and Welsch, Calculation of Gauss quadrature rules (1969).
    """
    # Reflect, so that the lower end is the one nearer 0 (or both ends lie on either side of it).
    turned = lower + upper < 0
    a, b = jnp.where(turned, -upper, lower), jnp.where(turned, -lower, upper)
    t = jnp.maximum(a, 0.0)

    # The part that counts, in u = x - t: sqrt(t^2 + 74) - t = 74 / (sqrt(t^2 + 74) + t), without cancellation; the root
    # as far sqrt((t / far)^2 + 74 / far^2), in which t^2 cannot overflow.
    far = jnp.maximum(t, 1.0)
    above = REACH / (far * jnp.sqrt((t / far) ** 2 + (REACH / far) / far) + t)
    high = jnp.minimum(b - t, above)
    low = jnp.maximum(a - t, -jnp.sqrt(REACH))
    width = high - low
    nodes, weights = (array.reshape(-1, *[1] * low.ndim) for array in (NODES, WEIGHTS))
    u = low + width * nodes
    density = jnp.exp(-u * (u / 2 + t))

    # Mass, and variance about the mean of the nodes.
    whole = jnp.sum(weights * density, axis=0)
    share = weights * density / whole
    middle = jnp.sum(share * u, axis=0)  # mean of u
    variance = jnp.sum(share * (u - middle) ** 2, axis=0)

    # Mean by the ends: (phi(a) - phi(b)) / Z with phi(a) - phi(b) = phi(a) (1 - exp(-(b - a)(b + a) / 2)).
    integral = whole * width
    at_end = jnp.where(a < 0, jnp.exp(-(a**2) / 2), 1.0)  # phi(a) / phi(t)
    difference = -at_end * jnp.expm1(-(b - a) * (b + a) / 2)
    by_ends = difference / jnp.where(integral > 0, integral, 1.0)
    is_short = width * (1 + t) < 1e-2  # there the nodes are as good, and no product of small numbers underflows
    mean = jnp.where(is_short & (a >= 0), t + middle, by_ends)
    mean = jnp.where(jnp.isinf(a) & jnp.isinf(b), 0.0, mean)

    log_mass = -(t**2) / 2 + jnp.log(integral) - np.log(2 * np.pi) / 2
    return TruncatedNormalMoments(log_mass, jnp.where(turned, -mean, mean), variance)


@_loop_two_intervals_at_a_time
def upper_tail(lower: jax.Array) -> TruncatedNormalMoments:
    """Return log mass, mean and variance of N(0, 1) above `lower`, by a tenth of `truncated_normal`'s operations.

    phi and Q are density and upper tail of N(0, 1), and a = `lower`. With the hazard h = phi(a) / Q(a) the mean is h,
    the variance 1 - h (h - a). Far out both lose digits, but by Laplace h = a + u_1 / a with u_n = n / (1 + u_{n+1} /
    a^2), and the variance is u_1 (u_2 - u_1) / a^2, which loses none. The fraction is evaluated as numerator and
    denominator. Relative errors are those of `truncated_normal`.

    Shapes: any; the results have it.

    Source: Laplace, Traite de mecanique celeste, vol. 4 (1805), the continued fraction of Mills' ratio.
    """
    # Near 0 or below it: Q = erfc(a / sqrt 2) / 2.
    a = jnp.clip(lower, -40.0, FAR)
    mass = jax.scipy.special.erfc(a / np.sqrt(2)) / 2
    hazard = jnp.exp(-(a**2) / 2) / (np.sqrt(2 * np.pi) * mass)
    near = TruncatedNormalMoments(jnp.log(mass), hazard, 1 - hazard * (hazard - a))
    # Far out: u_n = n / (1 + x u_{n+1}), x = 1 / a^2, from u = 0 at DEPTH down to u_2 and u_1.
    a = jnp.maximum(lower, FAR)
    x = 1 / (a * a)
    numerator = jnp.zeros_like(a)
    denominator = jnp.ones_like(a)
    for n in range(DEPTH, 1, -1):
        numerator, denominator = n * denominator, denominator + x * numerator
    u_2 = numerator / denominator
    u_1 = 1 / (1 + x * u_2)
    mean = a + u_1 / a
    log_mass = -(a**2) / 2 - np.log(2 * np.pi) / 2 - jnp.log(mean)
    far = TruncatedNormalMoments(log_mass, mean, x * u_1 * (u_2 - u_1))
    return TruncatedNormalMoments(*(jnp.where(lower < FAR, near_, far_) for near_, far_ in zip(near, far, strict=True)))
