"""Laws of fading gains: Rayleigh, Rician, Nakagami and log-normal, each with its moments, density and quantiles."""

from math import gamma

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from heliograph.numerics.check import scalar
from heliograph.numerics.numpy_or_jax import library, plain, scipy_for
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.laws.law import NATS, AbstractLaw, Scalar, Vector


class Rayleigh(AbstractLaw):
    """Rayleigh fading: the length of a centred complex Gaussian with standard deviation `scale` per part."""

    scale: Scalar

    def __init__(self, scale: "Float[ArrayLike, '']"):
        """Hold the standard deviation of the complex Gaussian's real part, which is its imaginary part's too."""
        self.scale = scalar("Rayleigh scale", scale, low=0.0)

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw a gain, scale sqrt(-2 log u) with u uniform in (0, 1)."""
        return jax.random.rayleigh(key, jnp.asarray(self.scale), dtype=float)

    def moment(self, order: int) -> float | jax.Array:
        """Return E[g^k] = scale^k 2^(k/2) Gamma(1 + k/2), k = `order`."""
        return plain((self.scale * np.sqrt(2)) ** order * gamma(1 + order / 2))

    def quantile(self, probability: Vector) -> np.ndarray:
        """Return the gains scale sqrt(-2 log(1 - p)) at which the distribution function has the values p."""
        return np.asarray(np.sqrt(-2 * np.log1p(-probability)) * float(self.scale))

    def log_density(self, g: jax.Array) -> jax.Array:
        """Return log(g) - g^2 / (2 scale^2), the logarithm of the density up to a constant."""
        return jnp.log(g) - jnp.square(g / self.scale) / 2

    def bulk(self) -> tuple[Scalar | float, Scalar | float]:
        """Return the interval (0, 9 scales) of gains, which holds all of the law but a share of e^-40."""
        return 0.0, 9 * self.scale


class Rician(AbstractLaw):
    """Rician fading: a line of sight of amplitude `sight` plus scatter of standard deviation `scale` per part."""

    sight: Scalar
    scale: Scalar

    def __init__(self, sight: "Float[ArrayLike, '']", scale: "Float[ArrayLike, '']"):
        """Hold the line of sight's amplitude and the standard deviation of the scatter's real and imaginary part."""
        self.sight = scalar("Rician line of sight", sight, low=0.0)
        self.scale = scalar("Rician scale", scale, np.finfo(float).tiny)

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw a gain: the length of (sight + scale n1, scale n2), n1 and n2 of N(0, 1)."""
        parts = jax.random.normal(key, (2,), dtype=float) * self.scale
        return jnp.hypot(self.sight + parts[0], parts[1])

    def moment(self, order: int) -> float | jax.Array:
        """Return E[g^k] = scale^k 2^(k/2) Gamma(1 + k/2) L_(k/2)(-x), x = (sight / scale)^2 / 2, L Laguerre's."""
        shape = _evaluate_half_order_laguerre(order, ((self.sight / self.scale) ** 2) / 2)
        return plain((self.scale * np.sqrt(2)) ** order * gamma(1 + order / 2) * shape)

    def quantile(self, probability: Vector) -> np.ndarray:
        """Return the gains at which the distribution function has these values.

        (g / scale)^2 is noncentral chi-squared with 2 degrees of freedom and noncentrality (sight / scale)^2.
        """
        squared = scipy.special.chndtrix(probability, 2, (float(self.sight) / float(self.scale)) ** 2)
        return np.asarray(np.sqrt(squared) * float(self.scale))

    def log_density(self, g: jax.Array) -> jax.Array:
        """Return the logarithm of the gain's density (Rice's law), up to a constant.

        It is log(g) - (g - sight)^2 / (2 scale^2) + log(e^-x I_0(x)) with x = g sight / scale^2. `sight` is the gain of
        the direct path.
        """
        sight = jnp.asarray(self.sight)
        scale = jnp.asarray(self.scale)
        bessel = jax.scipy.special.i0e(g * sight / scale**2)
        return jnp.log(g) - jnp.square((g - sight) / scale) / 2 + jnp.log(bessel)

    def bulk(self) -> tuple[Scalar | float, Scalar | float]:
        """Return the interval of gains within 9 scales of the line of sight, at least 0: nearly all of the law."""
        reach = 9 * self.scale
        xp = library(self.sight, self.scale)  # NumPy, or JAX for traced parameters
        return xp.maximum(self.sight - reach, 0.0), self.sight + reach


def _evaluate_half_order_laguerre(twice_order: int, x: Scalar) -> Scalar:
    """Return the Laguerre function L_v(-x) = 1F1(-v; 1; -x) of order v = `twice_order` / 2 >= 0 at -x <= 0.

    The recursion is (v + 1) L_(v+1) = (2 v + 1 + x) L_v - v L_(v-1). L grows with v, so the difference loses no digits.
    Whole orders start from L_0 = 1. The others start from L_(-1/2)(-x) = e^(-x/2) I_0(x/2) and
    L_(1/2)(-x) = e^(-x/2) ((1 + x) I_0(x/2) + x I_1(x/2)). `previous` is L_(v-1), and `current` is L_v.
    """
    if twice_order % 2:
        bessel = scipy_for(x).special
        previous = bessel.i0e(x / 2)
        current, v = (1 + x) * previous + x * bessel.i1e(x / 2), 0.5
    else:
        previous, current, v = 0.0 * x, 1.0 + 0.0 * x, 0.0
    while v < twice_order / 2:
        next_value = ((2 * v + 1 + x) * current - v * previous) / (v + 1)
        previous, current, v = current, next_value, v + 1
    moment: Scalar = current
    return moment


class Nakagami(AbstractLaw):
    """Nakagami-m fading with `shape` m >= 1/2 and mean power `power` = E[g^2]."""

    shape: Scalar
    power: Scalar

    def __init__(self, shape: "Float[ArrayLike, '']", power: "Float[ArrayLike, '']" = 1.0):
        """Hold the shape m, at least 1/2, and the mean power E[g^2]."""
        self.shape = scalar("Nakagami shape", shape, low=0.5)
        self.power = scalar("Nakagami power", power, low=0.0)

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw the root of a gamma variable with shape m and mean `power`."""
        return jnp.sqrt(jax.random.gamma(key, jnp.asarray(self.shape), dtype=float) * self.power / self.shape)

    def moment(self, order: int) -> float | jax.Array:
        """Return E[g^k] = Gamma(m + k/2) / Gamma(m) (power / m)^(k/2), k = `order`, m = `shape` and power = E[g^2]."""
        gammaln = scipy_for(self.shape).special.gammaln
        ratio = library(self.shape).exp(gammaln(self.shape + order / 2) - gammaln(self.shape))
        return plain(ratio * (self.power / self.shape) ** (order / 2))

    def quantile(self, probability: Vector) -> np.ndarray:
        """Return the gains g at which the distribution function has these values; g^2 has a gamma law."""
        m, power = float(self.shape), float(self.power)
        squares = scipy.special.gammaincinv(m, probability) * power / m
        return np.asarray(np.sqrt(squares))

    def log_density(self, g: jax.Array) -> jax.Array:
        """Return (2 m - 1) log(g) - m g^2 / power, the logarithm of the density up to a constant; m is `shape`."""
        m = jnp.asarray(self.shape)
        return (2 * m - 1) * jnp.log(g) - m * jnp.square(g) / self.power

    def bulk(self) -> tuple[Scalar | float, Scalar | float]:
        """Return the interval from 0 to a gain that is exceeded with a probability of at most e^-36.

        m g^2 / power is a gamma variable of shape m. It exceeds m + sqrt(2 m t) + t with a probability of at most e^-t,
        and t is NATS, 36.
        """
        xp = library(self.shape, self.power)
        largest = self.shape + xp.sqrt(2 * NATS * self.shape) + NATS
        return 0.0, xp.sqrt(self.power * largest / self.shape)


class LogNormal(AbstractLaw):
    """Shadowing: log g is Gaussian with `log_mean` and `log_deviation`."""

    log_mean: Scalar
    log_deviation: Scalar

    def __init__(self, log_mean: "Float[ArrayLike, '']", log_deviation: "Float[ArrayLike, '']"):
        """Hold mean and standard deviation of log g."""
        self.log_mean = scalar("log-normal mean", log_mean)
        self.log_deviation = scalar("log-normal deviation", log_deviation, low=0.0)

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw a gain, exp(log_mean + log_deviation n) with n of N(0, 1)."""
        return jnp.exp(self.log_mean + self.log_deviation * jax.random.normal(key, dtype=float))

    def moment(self, order: int) -> float | jax.Array:
        """Return E[g^k] = exp(k mu + k^2 sigma^2 / 2), k = `order`, for log g of N(mu, sigma^2)."""
        exponent = order * self.log_mean + (order * self.log_deviation) ** 2 / 2
        return plain(library(exponent).exp(exponent))

    def quantile(self, probability: Vector) -> np.ndarray:
        """Return the gains exp(log_mean + log_deviation t) at these probabilities, t the quantiles of N(0, 1)."""
        return np.asarray(np.exp(float(self.log_mean) + float(self.log_deviation) * scipy.special.ndtri(probability)))

    @property
    def logarithmic(self) -> bool:
        """Always True: the gain is positive, and its logarithm is what is spread evenly."""
        return True

    def log_density(self, g: jax.Array) -> jax.Array:
        """Return -log(g) - (log(g) - log_mean)^2 / (2 log_deviation^2), the log density up to a constant."""
        return -jnp.log(g) - jnp.square((jnp.log(g) - self.log_mean) / self.log_deviation) / 2

    def bulk(self) -> tuple[Scalar | float, Scalar | float]:
        """Return the gains (low, high) at 9 deviations of log g below and above its mean: nearly all of the law."""
        xp = library(self.log_mean, self.log_deviation)
        reach = 9 * self.log_deviation
        return xp.exp(self.log_mean - reach), xp.exp(self.log_mean + reach)
