"""Laws of a scalar gain: each samples itself and knows its moments E[g^k].

A law may be known only roughly: its probabilities may move within |dp| <= radius, sum dp = 0, 0 <= p + dp <= 1. Then
`moment` is nominal, and `extremes` lists the laws at the corners of that polytope, among which every expectation that
is linear in p has its worst case.
"""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.numerics import check
from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.check import array, fail, radii, scalar
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.module import Module, are_same, readable, unwritten
from heliograph.numerics.numpy_or_jax import equal_to_rounding, is_traced, plain, stack_parts, within
from heliograph.numerics.types import ArrayLike, Float

Scalar = Float[jax.Array | np.ndarray, ""]
Vector = Float[jax.Array | np.ndarray, " n"]

DRAWS = 2**14  # of a law that nobody knows but by its samples
NATS = 36.0  # e^-36 is a rounding error of 1
BEYOND = 1e-12  # by which a corner's last probability may lie beyond its ends, for the rounding of the others' sum
CORNER_LIMIT = 12  # atoms whose corners are listed; above, moments are bounded one by one


def draw_index(probabilities: Vector, key: jax.Array) -> jax.Array:
    """Draw an index i with P(i) = probabilities[i]: invert the distribution function at a uniform draw."""
    ends_of_intervals = jnp.cumsum(jnp.asarray(probabilities))[:-1]  # without the last, which is 1
    return jnp.sum(jax.random.uniform(key, dtype=float) > ends_of_intervals)


@readable
class AbstractLaw(Module):
    """A law of a real random gain, independent over time.

    Its parameters are numbers, or traced by JAX: then so are its moments.
    """

    formulas = "constant", "moment", "extremes", "corner_moments", "moment_interval", "list_atoms", "quantile", "bulk"

    @property
    def constant(self) -> Scalar | None:
        """The value of a gain that is not random; by default None, for a random gain."""
        return None

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw one gain; shape ()."""
        raise unwritten(self, "sample")

    def moment(self, order: int) -> float | jax.Array:
        """Return E[g^order] under the nominal law; a JAX tracer if the law's parameters are traced."""
        raise unwritten(self, "moment")

    def extremes(self) -> tuple["AbstractLaw", ...]:
        """Return the laws at the vertices ("corners") of the polytope of possible probabilities; (self,) if known.

        Any expectation is linear in the probabilities, so that its largest value is at one of them.
        """
        return (self,)

    def corner_moments(self, order: int) -> Float[jax.Array | np.ndarray, "corner order+1"]:
        """Return E[g^k], k = 0, ..., order, of each of the `extremes`."""
        return stack_parts([stack_parts([law.moment(k) for k in range(order + 1)]) for law in self.extremes()])

    def moment_interval(self, order: int) -> tuple[float | jax.Array, float | jax.Array]:
        """Return the lowest and highest E[g^order] over the possible laws, those of the `extremes`."""
        ends = self.corner_moments(order)[:, order]
        return plain(ends.min()), plain(ends.max())

    def covers(self, actual: "AbstractLaw") -> bool:
        """Return whether all laws that `actual` may be (within its radius) are laws that this one may be."""
        return are_same(self, actual)

    def list_atoms(self) -> list[tuple[float | jax.Array, float | jax.Array]]:
        """Return (probability, value) of each value that the gain may have, if these are finitely many.

        A mixture filter has a Gaussian for each. By default raise ValueError: the law is continuous.
        """
        raise fail("mixture filter", "gains of finitely many values", type(self).__name__)

    def quantile(self, probability: Vector) -> np.ndarray:
        """Return the gains below which these probabilities lie; by default those of DRAWS samples.

        Raises:
            ValueError: a law that cannot be sampled.
        """
        return np.asarray(np.quantile(self._draw_sample_of_gains(), probability))

    @in_float64
    def _draw_sample_of_gains(self) -> np.ndarray:
        """Draw DRAWS gains (DRAWS,) by a fixed seed, for quantiles of a law that has no formula for them."""
        keys = jax.random.split(jax.random.key(0), DRAWS)
        values: np.ndarray = np.asarray(jax.vmap(self.sample)(keys))
        return values

    @property
    def logarithmic(self) -> bool:
        """True if the gain is positive and spreads over orders of magnitude: integrals are then taken over log g."""
        return False

    def log_density(self, g: jax.Array) -> jax.Array:
        """Return log p(g) + const, for a positive gain g with the density p."""
        raise unwritten(self, "log_density")

    def bulk(self) -> "tuple[Scalar | float, Scalar | float]":
        """Return an interval (low, high) of gains outside of which the gain is with a probability of e^-36 at most."""
        raise unwritten(self, "bulk")

    def mean_law(self) -> "Constant":
        """Return the constant law at E[g], for a filter that takes the mean gain as the true one."""
        return Constant(self.moment(1))


LawLike = TypeAliasType("LawLike", AbstractLaw | ArrayLike)  # a law, or a gain that is certain


class Constant(AbstractLaw):
    """A gain that is always `value`."""

    value: Scalar

    def __init__(self, value: "Float[ArrayLike, '']"):
        """Hold the value that the gain has with probability 1."""
        self.value = scalar("constant gain", value)

    @property
    def constant(self) -> Scalar:
        """The gain, which is not random: `value`. A law that is random has None here."""
        return self.value

    def sample(self, key: jax.Array) -> jax.Array:
        """Return the value; the key is unused."""
        return jnp.asarray(self.value)

    def moment(self, order: int) -> float | jax.Array:
        """Return E[g^order] = value^order."""
        return plain(self.value**order)

    def list_atoms(self) -> list[tuple[float | jax.Array, float | jax.Array]]:
        """Return the only (probability, value) pair: (1, value)."""
        return [(1.0, plain(self.value))]


class Discrete(AbstractLaw):
    """Gains `values` with `probabilities`, each known within its `radius`."""

    values: Vector
    probabilities: Vector
    radius: np.ndarray

    def __init__(self, values: ArrayLike, probabilities: ArrayLike, radius: ArrayLike = 0.0):
        """Hold the possible gains, their probabilities, and how far each probability may be off (`radius`)."""
        self.values = array("gain values", values, (None,))
        self.probabilities = check.probabilities("gain probabilities", probabilities, len(self.values))
        self.radius = radii("probability radius", radius, self.probabilities)

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw one of the values, by inverting the distribution function at a uniform draw."""
        return jnp.asarray(self.values)[draw_index(self.probabilities, key)]

    def moment(self, order: int) -> float | jax.Array:
        """Return E[g^order] = sum_i p_i v_i^order, with the nominal probabilities p."""
        return plain(self.probabilities @ self.values**order)

    def moment_interval(self, order: int) -> tuple[float | jax.Array, float | jax.Array]:
        """Return the lowest and highest E[g^order] = sum_i p_i v_i^order over all probabilities p that are possible.

        `worst` returns the maximum of such a sum, and the minimum is minus the maximum of the negative sum. So the
        extreme laws ("corners"), which may be too many, need not be listed.
        """
        if order == 0:
            return 1.0, 1.0
        powers = self.values**order
        lowest, highest = -self.worst(-powers), self.worst(powers)
        return lowest, highest

    def covers(self, actual: AbstractLaw) -> bool:
        """Return whether all laws that `actual` may be are laws that this one may be.

        Its values must be the same, and its probabilities with their radii must lie within this law's radii. A radius
        is how far a probability may be off. A law of another kind must be the same law.
        """
        if not isinstance(actual, Discrete) or not equal_to_rounding(self.values, actual.values):
            return are_same(self, actual)
        return within(actual.probabilities, actual.radius, self.probabilities, self.radius)

    def list_atoms(self) -> list[tuple[float | jax.Array, float | jax.Array]]:
        """Return (probability, value) of each value, with the nominal probabilities."""
        return [(plain(p), plain(v)) for p, v in zip(self.probabilities, self.values, strict=True)]

    def worst(self, payoff: ArrayLike) -> float:
        """Return the exact maximum of sum_i (p_i + dp_i) payoff_i over the polytope of probabilities.

        |dp_i| is at most the radius. Every probability begins at its lower end. The mass that is missing to a sum of 1
        goes to the largest payoffs first. This is the fractional knapsack, which solves the linear programme.
        """
        gain = array("payoff", payoff, self.values.shape)
        low = np.maximum(self.probabilities - self.radius, 0.0)
        high = np.minimum(self.probabilities + self.radius, 1.0)
        mass_left, total = 1.0 - low.sum(), float(low @ gain)
        largest_first = np.argsort(-gain, kind="stable")
        for i in largest_first:
            added = min(mass_left, high[i] - low[i])
            total, mass_left = total + added * gain[i], mass_left - added
        return total

    def extremes(self) -> tuple[AbstractLaw, ...]:
        """Return the laws at all vertices ("corners") of the polytope of possible probabilities.

        Raises:
            ValueError: more than CORNER_LIMIT uncertain atoms, whose corners are too many to list.
        """
        return tuple(Discrete(self.values, corner) for corner in self.corners())

    def corner_moments(self, order: int) -> Float[jax.Array | np.ndarray, "corner order+1"]:
        """Return E[g^k] = sum_i p_i v_i^k at [corner, k], k = 0, ..., order, for the p of each of the `corners`."""
        corners = self.corners()
        moments_by_order = [corners @ self.values**k for k in range(order + 1)]
        return stack_parts(moments_by_order).T

    @cache_by_object
    def corners(self) -> Float[jax.Array | np.ndarray, "corner atom"]:
        """Return the corners of the polytope of probabilities, one in each row, with every value's probability.

        The probabilities are known within a radius each. Any law that is possible is a mixture of the polytope's
        corners, so that a bound which holds at every corner holds for all of them. The polytope: each probability
        within its radius and in [0, 1], the sum 1. At a corner all uncertain probabilities but one are at an end of
        their intervals.

        Raises:
            ValueError: more than CORNER_LIMIT uncertain atoms, whose corners are too many to list.
        """
        free = np.flatnonzero(self.radius > 0)
        if len(free) < 2:  # a single uncertain probability cannot move: the known ones leave it the rest of the sum 1
            return self.probabilities[None]
        if len(free) > CORNER_LIMIT:
            raise fail("uncertain probabilities of one gain", f"at most {CORNER_LIMIT}", len(free))
        # Interval of each probability.
        low = np.maximum(self.probabilities - self.radius, 0.0)
        high = np.minimum(self.probabilities + self.radius, 1.0)
        corners = set()
        # Try each uncertain probability as the one that is not at an end: it makes the sum 1. This is a corner if it is
        # then within its own interval.
        for slack in free:
            others = [i for i in free if i != slack]
            for ends in product(*((low[i], high[i]) for i in others)):
                corner = self.probabilities.copy()
                corner[others] = ends
                corner[slack] = 0.0  # not counted in the sum of the others
                corner[slack] = 1.0 - corner.sum()
                if low[slack] - BEYOND <= corner[slack] <= high[slack] + BEYOND:
                    corners.add(tuple(np.round(np.clip(corner, 0.0, 1.0), 15)))
        # Rounding to 15 digits made equal corners equal, so that each is listed once. Divide by the sum, to make it 1
        # again.
        return np.array([np.array(corner) / sum(corner) for corner in sorted(corners)])


class CertainDiscrete(Discrete):
    """Gains of finitely many values whose probabilities are certain, even if JAX traces all numbers.

    Its only corner is known without a look at `radius`, which a traced law could not decide on.

    Raises:
        ValueError: a law whose probabilities may be off.
    """

    def __init__(self, law: Discrete):
        """Take values and probabilities from `law`, whose probabilities must have no radius of uncertainty."""
        if np.any(law.radius > 0):
            raise fail("probabilities of a gain", "known ones, beside what a message tells", "uncertain ones")
        self.values, self.probabilities, self.radius = law.values, law.probabilities, law.radius

    def corners(self) -> Float[jax.Array | np.ndarray, "corner atom"]:
        """Return the only possible probabilities, shape (1, values)."""
        return self.probabilities[None]


def bernoulli(probability: "Float[ArrayLike, '']", radius: "Float[ArrayLike, '']" = 0.0) -> Discrete:
    """Return the law of a link that works (gain 1) with `probability` and is silent (gain 0) otherwise.

    Args:
        probability: P(gain 1), from 0 to 1.
        radius: how far the probability may be off, 0 unless given.

    Raises:
        ValueError: a probability outside [0, 1], or a radius that it does not allow.
    """
    p = scalar("probability that a link works", probability, low=0.0, high=1.0)
    return Discrete([0.0, 1.0], [1 - p, p], radius)


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
        """Hold E[g], E[g^2], ...; raise ValueError unless some distribution may have these moments.

        A distribution has them only if its Hankel matrix, of the entries E[g^(i + j)], is positive semidefinite.
        """
        self.moments = array("gain moments", moments, (None,))
        if is_traced(self.moments):  # numbers that are not known yet cannot be checked
            return
        sequence = np.concatenate([[1.0], self.moments])
        half = (len(sequence) - 1) // 2
        # Moments of a distribution have a positive semidefinite Hankel matrix E[V V'], V = (1, g, g^2, ...).
        hankel = np.array([[sequence[i + j] for j in range(half + 1)] for i in range(half + 1)])
        root_of_diagonal = np.sqrt(np.maximum(np.diag(hankel), np.finfo(float).tiny))
        smallest = np.linalg.eigvalsh(hankel / np.outer(root_of_diagonal, root_of_diagonal))[0]
        if np.any(np.diag(hankel) < 0) or smallest < -1e-10:  # rounding of a correlation matrix
            raise fail("gain moments", "those of some distribution", f"{self.moments.tolist()}, which none has")

    def sample(self, key: jax.Array) -> jax.Array:
        """Refuse: the law itself is unknown."""
        raise fail("simulating a gain known by its moments only", "a law that can be sampled", "GivenMoments")

    def moment(self, order: int) -> float | jax.Array:
        """Return E[g^order] of the gain g, one of the given moments; raise ValueError above these."""
        if order == 0:
            return 1.0
        if order > len(self.moments):
            raise fail("gain moments", f"moments up to order {order}", f"{len(self.moments)} of them")
        return plain(self.moments[order - 1])
