"""Rules that weigh the components of a measurement by how far they are from what was expected."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.gaussian.scores import AbstractWeights, Expected, reweighted, squared_residuals
from heliograph.numerics.check import TINY, check_count, scalar
from heliograph.numerics.linalg import diagonal_of
from heliograph.numerics.types import ArrayLike, Float

Number = Float[jax.Array | np.ndarray, ""]
Degrees = Float[jax.Array | np.ndarray, " m"]


class Huber(AbstractWeights):
    """Huber's weight w = min(1, c / |d|), d the innovation in its deviations: beyond c an error counts by its size.

    Source: Huber, Robust estimation of a location parameter (1964).
    """

    c: Number

    def __init__(self, c: "Float[ArrayLike, '']" = 1.345):
        self.c = scalar("constant of Huber's rule", c, TINY)

    def weights(self, e: jax.Array, squared: jax.Array, scale: jax.Array) -> jax.Array:
        """min(1, c / |d|)."""
        within = squared <= self.c**2
        return jnp.where(within, 1.0, self.c / jnp.sqrt(jnp.where(within, 1.0, squared)))


class InverseMultiquadric(AbstractWeights):
    """Weight w = 1 / (1 + d^2 / c^2), d the innovation in its deviations: what is far loses all weight.

    Its covariance is that of the innovation, so that good values count after an outage, when the state is uncertain.
    """

    c: Number

    def __init__(self, c: "Float[ArrayLike, '']" = 3.0):
        self.c = scalar("constant of the inverse multiquadric rule", c, TINY)

    def weights(self, e: jax.Array, squared: jax.Array, scale: jax.Array) -> jax.Array:
        """1 / (1 + d^2 / c^2)."""
        return 1 / (1 + squared / self.c**2)


class WoLF(AbstractWeights):
    """Weight w = 1 / (1 + e^2 / (c^2 r)), by the noise's variance r alone (a squared weight of the likelihood).

    Source: Duran-Martin et al., Outlier-robust Kalman filtering through generalised Bayes (2024), freed of units by r.
    """

    c: Number

    def __init__(self, c: "Float[ArrayLike, '']"):
        self.c = scalar("constant of the weighted likelihood filter", c, TINY)

    def weights(self, e: jax.Array, squared: jax.Array, scale: jax.Array) -> jax.Array:
        """1 / (1 + e^2 / (c^2 r))."""
        return 1 / (1 + e**2 / (self.c**2 * scale))


class Gate(AbstractWeights):
    """Chi-squared gate: w = 1 where d^2 <= c, else 0. It may lock a filter out after an outage.

    Source: Bar-Shalom, Li and Kirubarajan, Estimation with applications to tracking and navigation (2001).
    """

    c: Number

    def __init__(self, c: "Float[ArrayLike, '']" = 9.0):
        self.c = scalar("limit of the gate", c, TINY)

    def weights(self, e: jax.Array, squared: jax.Array, scale: jax.Array) -> jax.Array:
        """1 or 0."""
        return jnp.where(squared <= self.c, 1.0, 0.0)


class StudentVB(AbstractWeights):
    """Variational Bayes for Student's noise: `iterations` updates from the prior, each with the last one's weights.

    w_i = (nu + 1) / (nu + E_i / r_i), E_i = (z_i - t_i+)^2 + V_ii+. The degrees nu are those of the noise law.

    Source: Piche, Sarkka and Hartikainen, Recursive outlier-robust filtering and smoothing for nonlinear systems using
    the multivariate Student-t distribution (2012).
    """

    iterations: int = eqx.field(static=True)
    degrees: Degrees

    def __init__(self, iterations: int = 4):
        self.iterations = check_count("iterations of variational Bayes", iterations)
        self.degrees = np.zeros(0)

    def of_law(self, degrees: Degrees) -> "StudentVB":
        """The same rule with the degrees of each received component."""
        rule = StudentVB(self.iterations)
        object.__setattr__(rule, "degrees", degrees)
        return rule

    def iterate(
        self, before: Expected, noise: jax.Array, e: jax.Array, present: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The weights of the last update, and those that it would give the next one."""
        scale = diagonal_of(noise)
        used = w = jnp.broadcast_to(jnp.ones_like(scale), e.shape)
        for _ in range(self.iterations):
            used = w
            residual = squared_residuals(before, reweighted(noise, used), e, present)
            w = (jnp.asarray(self.degrees) + 1) / (jnp.asarray(self.degrees) + residual / scale)
        return used, w
