"""Pairs (real, imaginary) of a complex baseband signal, turned by a random phase."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.check import scalar
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.hop import known
from heliograph.random_affine.moments.monomials import JointMoments, list_exponents, symmetric_power
from heliograph.random_affine.moments.signal_path import ChannelPosition, Visit

# Matrix that takes (a, b, 1) to (w, v, 1) with w = a + i b and its conjugate v = a - i b.
TO_COMPLEX = np.array([[1, 1j, 0], [1, -1j, 0], [0, 0, 1]])


class Rotation(AbstractRandomAffine):
    """Pair (real, imaginary) turned by a phase phi of N(0, deviation^2): w -> exp(i phi) w for w = a + i b.

    What is left of a phase that transmitters compensate; from a deviation of 9 rad on it is any phase, to rounding.
    In w and its conjugate v the map is diagonal, E[exp(i phi)^p exp(-i phi)^q] = exp(-(p - q)^2 deviation^2 / 2).

    Args:
        deviation: standard deviation of the phase in rad.

    Raises:
        ValueError: a negative deviation.
    """

    deviation: Float[jax.Array | np.ndarray, ""]

    def __init__(self, deviation: "Float[ArrayLike, '']"):
        """Hold the standard deviation of the phase in rad."""
        self.deviation = scalar("deviation of a phase", deviation, low=0.0)

    @property
    def outputs(self) -> int:
        """Length of z: always two, real and imaginary part."""
        return 2

    @property
    def inputs(self) -> int:
        """Length of y: always two, real and imaginary part."""
        return 2

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw H = [[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]] of a random angle phi, normal with `deviation`."""
        phi = self.deviation * jax.random.normal(key, dtype=float)
        c, s = jnp.cos(phi), jnp.sin(phi)
        zero = 0 * c
        return jnp.stack([jnp.stack([c, -s, zero]), jnp.stack([s, c, zero]), jnp.array([0.0, 0.0, 1.0])])

    @cache_by_object
    def moments(self, order: int) -> JointMoments:
        """Return E[Sym^k(H)] = Sym^k(C)^-1 diag(exp(-(p - q)^2 deviation^2 / 2)) Sym^k(C), k = `order`.

        Sym^k(H) maps the monomials of (y, 1) of degree k to those of (z, 1). C takes (y_1, y_2) to w = y_1 + i y_2 and
        its conjugate v. A turn by phi multiplies w^p v^q by exp(i (p - q) phi), whose mean is the factor on the
        diagonal.
        """
        turns = np.array([p - q for p, q, _ in list_exponents(3, order)])
        factors = library(self.deviation).exp(-(turns**2) * self.deviation**2 / 2)
        to_complex = symmetric_power(TO_COMPLEX, order)
        from_complex = symmetric_power(np.linalg.inv(TO_COMPLEX), order)
        matrix = (np.asarray(from_complex) * factors) @ to_complex
        return JointMoments(matrix.real, outputs=2, inputs=2, order=order)

    def visit_hops(self, visit: Visit, position: ChannelPosition) -> tuple[AbstractRandomAffine, ChannelPosition]:
        """Return the map and the position unchanged: a rotation has no transmitter."""
        return self, position

    def mean_gain(self) -> AbstractRandomAffine:
        """Return the map z = exp(-deviation^2 / 2) y of the mean gain E[H]."""
        return known(self.moments(1).mean[:-1, :-1])
