"""A random gain given a noisy reading of it: the law of g given a = g + e, e of N(0, s^2)."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.types import Array, Float
from heliograph.random_affine.laws.law import AbstractLaw, Constant, Discrete

GAINS, ERRORS = 96, 24  # quadrature nodes for means over a gain, and over the error of its reading
NODES = 64  # Gauss-Legendre nodes over all that matters of the posterior density
NATS = 36.0  # a density that is less than e^-36 of its largest value does not count: that is a rounding error
GRID = 33  # points among which the mode, and then each end, is looked for
ZOOMS = 12  # times that the grid shrinks to two of its cells: by (2 / 32)^12, to the last bit


class GainLawGivenReading(AbstractLaw):
    """Law of a gain given a reading of it, known by its mean and variance.

    Args:
        mean: E[g | a].
        variance: Var(g | a).
    """

    mean: Float[Array, ""]
    variance: Float[Array, ""]

    def sample(self, key: jax.Array) -> jax.Array:
        """Refuse: the law is what a receiver believes, and nothing is drawn from it."""
        raise fail("a gain given its reading", "a law that can be sampled", "mean and variance alone")

    def moment(self, order: int) -> jax.Array:
        """Return E[g^order | a] of the gain g given its reading a, for orders 0, 1 and 2, from mean and variance."""
        if order > 2:
            raise fail("moments of a gain given its reading", "at most order 2", order)
        powers = jnp.stack([jnp.ones(()), jnp.asarray(self.mean), self.variance + jnp.square(self.mean)])
        return powers[order]


def require_density(law: AbstractLaw) -> AbstractLaw:
    """Return a gain's law if readings of the gain can be used: one with a density, or of finitely many values.

    Raises:
        ValueError: another law, probabilities that are uncertain.
    """
    if not isinstance(law, Constant | Discrete) and type(law).log_density is AbstractLaw.log_density:
        raise fail("gain of which a pilot tells", "a law with a density or of finitely many values", type(law).__name__)
    if isinstance(law, Discrete) and np.any(law.radius > 0):
        raise fail("gain of which a pilot tells", "known probabilities", "uncertain ones")
    return law


def gain_given_reading(law: AbstractLaw, reading: Float[Array, ""], variance: Float[Array, ""]) -> AbstractLaw:
    """Return the law of g given a = g + e: p(g | a) ~ p(g) exp(-(a - g)^2 / 2 s^2); where a is NaN, the gain's own.

    Args:
        law: of the gain before the reading.
        reading: a, NaN where none came.
        variance: s^2, positive.

    Raises:
        ValueError: a law without a density; probabilities that are uncertain.
    """
    if isinstance(law, Constant):
        return law
    # A NaN is no reading: computed with 0 in its place, and then not used.
    known = ~jnp.isnan(reading)
    a = jnp.where(known, reading, 0.0)
    if isinstance(law, Discrete):
        log_density = jnp.log(law.probabilities) - jnp.square(a - law.values) / (2 * variance)
        return Discrete(law.values, jnp.where(known, jax.nn.softmax(log_density), law.probabilities))
    mean, variance_given_reading = _integrate_posterior(law, a, jnp.asarray(variance))
    own_mean, own_square = law.moment(1), law.moment(2)
    return GainLawGivenReading(
        mean=jnp.where(known, mean, own_mean),
        variance=jnp.where(known, variance_given_reading, own_square - own_mean**2),
    )


@compile_in_float64
def _integrate_posterior(law: AbstractLaw, a: jax.Array, variance: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the mean and variance of a positive gain g given a reading a = g + e, e of N(0, variance).

    By quadrature over all t where the posterior's log density is within NATS of that at its mode. In t = g^(1/4), or
    log g of a law that is wide on a logarithmic scale, the density is smooth to its ends.

    Args:
        law: of g before the reading.
        a: the reading.
        variance: of its error.
    """
    deviation = jnp.sqrt(variance)

    def to_gain(t: jax.Array) -> jax.Array:
        """Return the gain g of the variable of integration t: e^t for a law over orders of magnitude, else t^4."""
        return jnp.exp(t) if law.logarithmic else t**4

    def from_gain(g: Float[Array, ""]) -> jax.Array:
        """Return t of a gain, the inverse of `to_gain`; a negative gain counts as 0."""
        return jnp.log(jnp.maximum(g, np.finfo(float).tiny)) if law.logarithmic else jnp.maximum(g, 0.0) ** 0.25

    def log_density(t: jax.Array) -> jax.Array:
        """Return log p(t | a) up to a constant, for the gain g = e^t (`logarithmic` law) or g = t^4 (any other law).

        It is the law's log density in t plus the log density of the reading a = g + e, where e has this `deviation`.
        """
        g = to_gain(t)
        log_slope = t if law.logarithmic else 3 * jnp.log(t)  # log of dg/dt, up to a constant
        return law.log_density(g) + log_slope - jnp.square((a - g) / deviation) / 2

    # All gains that may count: those of the law, those near the reading, and all between.
    low, high = law.bulk()
    low = from_gain(jnp.minimum(low, a - 9 * deviation))
    high = from_gain(jnp.maximum(high, a + 9 * deviation))
    # The part of these that does count: within NATS of the mode.
    mode = _find_density_mode(log_density, low, high)
    least = log_density(mode) - NATS
    ends = _find_density_edge(log_density, low, mode, least), _find_density_edge(log_density, high, mode, least)
    # Where the interval ends has no part in the integral, and none in its derivative, which at g = 0 it would not have.
    left, right = jax.lax.stop_gradient(ends)
    # Weights p(t | a) dt at the nodes, normalised; the variance about the mean, so that nothing cancels.
    x, w = np.polynomial.legendre.leggauss(NODES)
    t = (left + right) / 2 + (right - left) / 2 * x
    weights = jax.nn.softmax(np.log(w) + jax.vmap(log_density)(t))
    g = to_gain(t)
    mean = weights @ g
    return mean, weights @ jnp.square(g - mean)


LogDensity = Callable[[jax.Array], jax.Array]


def _find_density_mode(log_density: LogDensity, low: jax.Array, high: jax.Array) -> jax.Array:
    """Return where a density with one mode in [low, high] is largest.

    The interval is replaced ZOOMS times by the two cells beside the largest of GRID points in it.
    """
    steps = np.linspace(0.0, 1.0, GRID)

    def zoom(_: int, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Return the neighbours of the best point of a grid between these ends; `steps` are its points from 0 to 1."""
        left, right = ends
        points = left + (right - left) * steps
        best = jnp.argmax(jax.vmap(log_density)(points))
        return points[jnp.maximum(best - 1, 0)], points[jnp.minimum(best + 1, GRID - 1)]

    left, right = jax.lax.fori_loop(0, ZOOMS, zoom, (low, high))
    mode: jax.Array = (left + right) / 2
    return mode


def _find_density_edge(log_density: LogDensity, outer: jax.Array, mode: jax.Array, least: jax.Array) -> jax.Array:
    """Return a place near the one where the density rises above `least`, on its side towards `outer`.

    Args:
        log_density: logarithm of a density with one mode.
        outer: an end of the interval, where the density is below `least`.
        mode: where the density is largest.
        least: the logarithm to find.
    """
    steps = np.linspace(0.0, 1.0, GRID)

    def zoom(_: int, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Return the outer and the inner end of the grid's cell in which the density rises above `least`.

        `steps` are the grid's points from 0 at the outer end to 1 at the inner end, where the density is above `least`.
        """
        outside, inside = ends
        points = outside + (inside - outside) * steps
        is_above = (jax.vmap(log_density)(points) > least).at[-1].set(True)
        first_above = jnp.argmax(is_above)
        return points[jnp.maximum(first_above - 1, 0)], points[first_above]

    outside: jax.Array = jax.lax.fori_loop(0, ZOOMS // 2, zoom, (outer, mode))[0]
    return outside


def gain_quadrature(
    law: AbstractLaw,
) -> tuple[Float[np.ndarray, "nodes 1"], Float[np.ndarray, " nodes"]]:
    """Return gains (nodes, 1) and weights (nodes,) by which a mean over a gain is a sum: those of Gauss and Legendre.

    E f(g) is about sum_i weight_i f(gain_i), so that filters can sum over the values of a random gain.

    Args:
        law: law of the gain, with a density or of finitely many values.

    Raises:
        ValueError: another law; uncertain probabilities.
    """
    require_density(law)
    # Finitely many values: the law itself.
    if isinstance(law, Constant | Discrete):
        weights, values = np.array(law.list_atoms(), dtype=float).T
        return values[:, None], weights
    # E f(g) = int f(g(t)) p(g(t)) g'(t) dt with g = e^t or t^4, which takes nodes to where p changes fast, near 0.
    # The nodes x in (-1, 1) are moved to t between the ends of the interval that holds nearly all of the law.
    x, w = np.polynomial.legendre.leggauss(GAINS)
    low, high = (float(end) for end in law.bulk())
    with jax.enable_x64(True):
        ends = np.log([low, high]) if law.logarithmic else np.array([low, high]) ** 0.25
        t = ends.mean() + (ends[1] - ends[0]) / 2 * x
        g = np.exp(t) if law.logarithmic else t**4
        # log(p g'), g' = e^t or 4 t^3, up to a constant, which division by the sum of the weights removes.
        log_density = np.asarray(jax.vmap(law.log_density)(jnp.asarray(g))) + (t if law.logarithmic else 3 * np.log(t))
    weights = w * np.exp(log_density - log_density.max())
    return g[:, None], weights / weights.sum()


def reading_quadrature(
    law: AbstractLaw, variance: float
) -> tuple[Float[np.ndarray, "nodes 1"], Float[np.ndarray, " nodes"]]:
    """Return readings a = g + e (nodes, 1) and weights (nodes,): a mean over readings is a weighted sum over them.

    Args:
        law: law of the gain g, as `gain_quadrature` takes it.
        variance: positive variance of e.
    """
    gains, weights = gain_quadrature(law)
    nodes, node_weights = np.polynomial.hermite_e.hermegauss(ERRORS)  # of a standard normal error
    readings = gains + np.sqrt(variance) * nodes
    joint_weights = np.outer(weights, node_weights / node_weights.sum())
    return readings.reshape(-1, 1), joint_weights.ravel()
