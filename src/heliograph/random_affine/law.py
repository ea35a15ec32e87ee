"""Laws of a scalar gain: each samples itself and knows its moments E[g^k].

A law may be known only roughly: its probabilities may move within |dp| <= radius, sum dp = 0, 0 <= p + dp <= 1. Then
`moment` is nominal, and `extremes` lists the laws at the corners of that polytope, among which every expectation that
is linear in p has its worst case.
"""

from itertools import product
from math import gamma

import jax
import jax.numpy as jnp
import numpy as np
from scipy import special
from typing_extensions import TypeAliasType

from heliograph.numerics import check
from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.check import array, fail, radii, scalar
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.module import Module, readable, same, unwritten
from heliograph.numerics.traced import equal_to_rounding, is_traced, library, plain, scipy_for, stack_parts, within
from heliograph.numerics.types import ArrayLike, Float

Scalar = Float[jax.Array | np.ndarray, ""]
Vector = Float[jax.Array | np.ndarray, " n"]

DRAWS = 2**14  # of a law that nobody knows but by its samples
CORNER_LIMIT = 12  # atoms whose corners are listed; above, moments are bounded one by one


def draw_index(probabilities: Vector, key: jax.Array) -> jax.Array:
    """Draw one of finitely many: invert the distribution function at a uniform draw."""
    return jnp.sum(jax.random.uniform(key, dtype=float) > jnp.cumsum(jnp.asarray(probabilities))[:-1])


@readable
class AbstractLaw(Module):
    """A law of a real random gain, independent over time.

    Its parameters are numbers, or traced by JAX: then so are its moments.
    """

    @property
    def constant(self) -> Scalar | None:
        """The gain where it is one number; None where it is random."""
        return None

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw one gain; shape ()."""
        raise unwritten(self, "sample")

    def moment(self, order: int) -> float | jax.Array:
        """Return E[g^order] under the nominal law; traced where the law's parameters are."""
        raise unwritten(self, "moment")

    def extremes(self) -> tuple["AbstractLaw", ...]:
        """Return the laws at the corners of the set of possible laws; the law itself when it is known."""
        return (self,)

    def corner_moments(self, order: int) -> Float[jax.Array | np.ndarray, "corner order+1"]:
        """Return E[g^k], k = 0, ..., order, of each of the `extremes`."""
        return stack_parts([stack_parts([law.moment(k) for k in range(order + 1)]) for law in self.extremes()])

    def moment_interval(self, order: int) -> tuple[float | jax.Array, float | jax.Array]:
        """Lowest and highest E[g^order] over the possible laws, those of the `extremes`."""
        ends = self.corner_moments(order)[:, order]
        return plain(ends.min()), plain(ends.max())

    def covers(self, own: "AbstractLaw") -> bool:
        """Test whether another law, with all that it may be, is one of those that this one may be."""
        return same(self, own)

    def list_atoms(self) -> list[tuple[float | jax.Array, float | jax.Array]]:
        """List probability and value of each of finitely many gains; by default a refusal."""
        raise fail("mixture filter", "gains of finitely many values", type(self).__name__)

    def quantile(self, probability: Vector) -> np.ndarray:
        """Gains below which these probabilities lie; by default those of DRAWS samples.

        Raises:
            ValueError: a law that cannot be sampled.
        """
        return np.asarray(np.quantile(self._draw_values(), probability))

    @in_float64
    def _draw_values(self) -> np.ndarray:
        values: np.ndarray = np.asarray(jax.vmap(self.sample)(jax.random.split(jax.random.key(0), DRAWS)))
        return values

    def mean_law(self) -> "Constant":
        """Return the constant law at E[g], for a filter that takes the mean gain as the true one."""
        return Constant(self.moment(1))


LawLike = TypeAliasType("LawLike", AbstractLaw | ArrayLike)  # a law, or a gain that is certain


class Constant(AbstractLaw):
    """A gain that is always `value`."""

    value: Scalar

    def __init__(self, value: "Float[ArrayLike, '']"):
        self.value = scalar("constant gain", value)

    @property
    def constant(self) -> Scalar:
        """The value."""
        return self.value

    def sample(self, key: jax.Array) -> jax.Array:
        """Return the value; the key is unused."""
        return jnp.asarray(self.value)

    def moment(self, order: int) -> float | jax.Array:
        """Return value^order."""
        return plain(self.value**order)

    def list_atoms(self) -> list[tuple[float | jax.Array, float | jax.Array]]:
        """The value, which is certain."""
        return [(1.0, plain(self.value))]


class Discrete(AbstractLaw):
    """Gains `values` with `probabilities`, each known within its `radius`."""

    values: Vector
    probabilities: Vector
    radius: np.ndarray

    def __init__(self, values: ArrayLike, probabilities: ArrayLike, radius: ArrayLike = 0.0):
        self.values = array("gain values", values, (None,))
        self.probabilities = check.probabilities("gain probabilities", probabilities, len(self.values))
        self.radius = radii("probability radius", radius, self.probabilities)

    def sample(self, key: jax.Array) -> jax.Array:
        """Invert the distribution function at a uniform draw."""
        return jnp.asarray(self.values)[draw_index(self.probabilities, key)]

    def moment(self, order: int) -> float | jax.Array:
        """Return sum_i p_i v_i^order."""
        return plain(self.probabilities @ self.values**order)

    def moment_interval(self, order: int) -> tuple[float | jax.Array, float | jax.Array]:
        """Lowest and highest E[g^order], also where the corners are too many to list."""
        powers = self.values**order
        return (-self.worst(-powers), self.worst(powers)) if order else (1.0, 1.0)

    def covers(self, own: AbstractLaw) -> bool:
        """A law of the same values whose probabilities stay within the radius."""
        if not isinstance(own, Discrete) or not equal_to_rounding(self.values, own.values):
            return same(self, own)
        return within(own.probabilities, own.radius, self.probabilities, self.radius)

    def list_atoms(self) -> list[tuple[float | jax.Array, float | jax.Array]]:
        """The values, with their probabilities."""
        return [(plain(p), plain(v)) for p, v in zip(self.probabilities, self.values, strict=True)]

    def worst(self, payoff: ArrayLike) -> float:
        """Exact maximum of sum_i (p_i + dp_i) payoff_i over the polytope of probabilities.

        Start with every probability at its lower end and give the mass that is left to the largest payoffs first (the
        fractional knapsack, which solves this linear programme).
        """
        gain = array("payoff", payoff, self.values.shape)
        low = np.maximum(self.probabilities - self.radius, 0.0)
        high = np.minimum(self.probabilities + self.radius, 1.0)
        left, total = 1.0 - low.sum(), float(low @ gain)
        for i in np.argsort(-gain, kind="stable"):
            step = min(left, high[i] - low[i])
            total, left = total + step * gain[i], left - step
        return total

    def extremes(self) -> tuple[AbstractLaw, ...]:
        """Laws at all corners of the polytope.

        Raises:
            ValueError: more than CORNER_LIMIT uncertain atoms, whose corners are too many to list.
        """
        return tuple(Discrete(self.values, corner) for corner in self.corners())

    def corner_moments(self, order: int) -> Float[jax.Array | np.ndarray, "corner order+1"]:
        """E[g^k], k = 0, ..., order, of each of the `extremes`."""
        corners = self.corners()
        return stack_parts([corners @ self.values**k for k in range(order + 1)]).T

    @cache_by_object
    def corners(self) -> Float[jax.Array | np.ndarray, "corner atom"]:
        """Corners of the polytope of probabilities: each but one at an end of its interval.

        Raises:
            ValueError: more than CORNER_LIMIT uncertain atoms, whose corners are too many to list.
        """
        free = np.flatnonzero(self.radius > 0)
        if len(free) < 2:  # a single uncertain probability cannot move: the others hold the sum
            return self.probabilities[None]
        if len(free) > CORNER_LIMIT:
            raise fail("uncertain probabilities of one gain", f"at most {CORNER_LIMIT}", len(free))
        low = np.maximum(self.probabilities - self.radius, 0.0)
        high = np.minimum(self.probabilities + self.radius, 1.0)
        corners = set()
        # A vertex has all uncertain probabilities but one at an end; the one left makes the sum 1.
        for slack in free:
            others = [i for i in free if i != slack]
            for ends in product(*((low[i], high[i]) for i in others)):
                corner = self.probabilities.copy()
                corner[others] = ends
                corner[slack] = 0.0
                corner[slack] = 1.0 - corner.sum()
                if low[slack] - 1e-12 <= corner[slack] <= high[slack] + 1e-12:
                    corners.add(tuple(np.round(np.clip(corner, 0.0, 1.0), 15)))
        return np.array([np.array(c) / sum(c) for c in sorted(corners)])


def bernoulli(probability: "Float[ArrayLike, '']", radius: "Float[ArrayLike, '']" = 0.0) -> Discrete:
    """Return the law of a link that works (gain 1) with `probability` and is silent (gain 0) otherwise.

    Args:
        probability: P(gain 1), from 0 to 1.
        radius: how far the probability may be off, 0 unless given.

    Raises:
        ValueError: a probability outside [0, 1], or a radius that it does not allow.
    """
    p = scalar("probability that a link works", probability, 0.0, 1.0)
    return Discrete([0.0, 1.0], [1 - p, p], radius)


class Rayleigh(AbstractLaw):
    """Rayleigh fading: the length of a centred complex Gaussian with standard deviation `scale` per part."""

    scale: Scalar

    def __init__(self, scale: "Float[ArrayLike, '']"):
        self.scale = scalar("Rayleigh scale", scale, 0.0)

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw scale * sqrt(-2 log u)."""
        return jax.random.rayleigh(key, jnp.asarray(self.scale), dtype=float)

    def moment(self, order: int) -> float | jax.Array:
        """Return scale^k 2^(k/2) Gamma(1 + k/2)."""
        return plain((self.scale * np.sqrt(2)) ** order * gamma(1 + order / 2))

    def quantile(self, probability: Vector) -> np.ndarray:
        """Return scale sqrt(-2 log(1 - p))."""
        return np.asarray(np.sqrt(-2 * np.log1p(-probability)) * float(self.scale))


class Rician(AbstractLaw):
    """Rician fading: a line of sight of amplitude `sight` plus scatter of standard deviation `scale` per part."""

    sight: Scalar
    scale: Scalar

    def __init__(self, sight: "Float[ArrayLike, '']", scale: "Float[ArrayLike, '']"):
        self.sight = scalar("Rician line of sight", sight, 0.0)
        self.scale = scalar("Rician scale", scale, np.finfo(float).tiny)

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw the length of (sight + scale n1, scale n2)."""
        parts = jax.random.normal(key, (2,), dtype=float) * self.scale
        return jnp.hypot(self.sight + parts[0], parts[1])

    def moment(self, order: int) -> float | jax.Array:
        """Return scale^k 2^(k/2) Gamma(1 + k/2) L_(k/2)(-sight^2 / (2 scale^2)), L the Laguerre function."""
        shape = _laguerre(order, ((self.sight / self.scale) ** 2) / 2)
        return plain((self.scale * np.sqrt(2)) ** order * gamma(1 + order / 2) * shape)

    def quantile(self, probability: Vector) -> np.ndarray:
        """Return scale sqrt of the quantile of the noncentral chi-squared law of 2 degrees."""
        return np.asarray(
            np.sqrt(special.chndtrix(probability, 2, (float(self.sight) / float(self.scale)) ** 2)) * float(self.scale)
        )


def _laguerre(order: int, x: Scalar) -> Scalar:
    """L_(order/2)(-x) = 1F1(-order/2; 1; -x) for x >= 0, by (v + 1) L_(v+1) = (2 v + 1 + x) L_v - v L_(v-1).

    Even orders are polynomials, from L_0 = 1; odd ones start from exponentially scaled Bessel functions,
    L_(-1/2)(-x) = e^(-x/2) I_0(x/2) and L_(1/2)(-x) = e^(-x/2) ((1 + x) I_0(x/2) + x I_1(x/2)). L grows with v, so the
    difference loses no digits.
    """
    if order % 2:
        bessel = scipy_for(x).special
        before = bessel.i0e(x / 2)
        now, v = (1 + x) * before + x * bessel.i1e(x / 2), 0.5
    else:
        before, now, v = 0.0 * x, 1.0 + 0.0 * x, 0.0
    while v < order / 2:
        before, now, v = now, ((2 * v + 1 + x) * now - v * before) / (v + 1), v + 1
    moment: Scalar = now
    return moment


class Nakagami(AbstractLaw):
    """Nakagami-m fading with `shape` m >= 1/2 and mean power `power` = E[g^2]."""

    shape: Scalar
    power: Scalar

    def __init__(self, shape: "Float[ArrayLike, '']", power: "Float[ArrayLike, '']" = 1.0):
        self.shape = scalar("Nakagami shape", shape, 0.5)
        self.power = scalar("Nakagami power", power, 0.0)

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw the root of a gamma variable with shape m and mean `power`."""
        return jnp.sqrt(jax.random.gamma(key, jnp.asarray(self.shape), dtype=float) * self.power / self.shape)

    def moment(self, order: int) -> float | jax.Array:
        """Return Gamma(m + k/2) / Gamma(m) (power / m)^(k/2)."""
        gammaln = scipy_for(self.shape).special.gammaln
        ratio = library(self.shape).exp(gammaln(self.shape + order / 2) - gammaln(self.shape))
        return plain(ratio * (self.power / self.shape) ** (order / 2))

    def quantile(self, probability: Vector) -> np.ndarray:
        """Return the root of the quantile of the gamma law of g^2."""
        return np.asarray(
            np.sqrt(special.gammaincinv(float(self.shape), probability) * float(self.power) / float(self.shape))
        )


class LogNormal(AbstractLaw):
    """Shadowing: log g is Gaussian with `log_mean` and `log_deviation`."""

    log_mean: Scalar
    log_deviation: Scalar

    def __init__(self, log_mean: "Float[ArrayLike, '']", log_deviation: "Float[ArrayLike, '']"):
        self.log_mean = scalar("log-normal mean", log_mean)
        self.log_deviation = scalar("log-normal deviation", log_deviation, 0.0)

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw exp(log_mean + log_deviation n)."""
        return jnp.exp(self.log_mean + self.log_deviation * jax.random.normal(key, dtype=float))

    def moment(self, order: int) -> float | jax.Array:
        """Return exp(k mu + k^2 sigma^2 / 2)."""
        exponent = order * self.log_mean + (order * self.log_deviation) ** 2 / 2
        return plain(library(exponent).exp(exponent))

    def quantile(self, probability: Vector) -> np.ndarray:
        """Return exp(log_mean + log_deviation t) with t the normal quantile."""
        return np.asarray(np.exp(float(self.log_mean) + float(self.log_deviation) * special.ndtri(probability)))


class GivenMoments(AbstractLaw):
    """Law of a gain of which only the moments are known, from measurements or from a data sheet.

    It designs filters but cannot be sampled: many laws share these moments.

    Args:
        moments: E[g], E[g^2], ..., shape (order,).

    Raises:
        ValueError: no distribution on the real line has these moments (a Hankel matrix is indefinite), or a moment of
            higher order than given is asked for.
    """

    moments: Vector

    def __init__(self, moments: "Float[ArrayLike, ' order']"):
        self.moments = array("gain moments", moments, (None,))
        if is_traced(self.moments):
            return
        sequence = np.concatenate([[1.0], self.moments])
        half = (len(sequence) - 1) // 2
        # Moments of a distribution have a positive semidefinite Hankel matrix E[V V'], V = (1, g, g^2, ...).
        hankel = np.array([[sequence[i + j] for j in range(half + 1)] for i in range(half + 1)])
        scale = np.sqrt(np.maximum(np.diag(hankel), np.finfo(float).tiny))
        smallest = np.linalg.eigvalsh(hankel / np.outer(scale, scale))[0]
        if np.any(np.diag(hankel) < 0) or smallest < -1e-10:  # rounding of a correlation matrix
            raise fail("gain moments", "those of some distribution", f"{self.moments.tolist()}, which none has")

    def sample(self, key: jax.Array) -> jax.Array:
        """Refuse: the law itself is unknown."""
        raise fail("simulating a gain known by its moments only", "a law that can be sampled", "GivenMoments")

    def moment(self, order: int) -> float | jax.Array:
        """Return the given E[g^order]."""
        if order == 0:
            return 1.0
        if order > len(self.moments):
            raise fail("gain moments", f"moments up to order {order}", f"{len(self.moments)} of them")
        return plain(self.moments[order - 1])
