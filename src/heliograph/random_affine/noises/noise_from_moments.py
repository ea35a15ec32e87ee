"""Noises of which the moments are known, or a sample, and any noise law without its mean.

Moments about the mean keep the digits that raw moments far from zero lose.
"""

import warnings
from functools import singledispatch
from itertools import product
from math import ceil, comb, prod

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import array, check_count, fail, rank
from heliograph.numerics.numpy_or_jax import is_traced, plain
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.moments.monomials import Exponents, list_exponents
from heliograph.random_affine.noises.noise import (
    AbstractNoise,
    FiniteSupport,
    Gaussian,
    Independent,
    Number,
    Square,
    Vector,
)
from heliograph.random_affine.noises.shaped_noise import Shaped

MOMENT_TOLERANCE = 1e-10  # of moments scaled to unit second moment: rounding of the numbers given
MOMENT_ERROR = 0.1  # standard error of an estimated moment, relative to its largest possible size, that is tolerated


class NoiseMoments(AbstractNoise):
    """Scalar noise of which only E[n], E[n^2], ... are known, from a data sheet or from measurements.

    It designs filters but cannot be sampled: many laws share these moments. Several components: `Independent`,
    and `Shaped` for those that are mixed.

    Shapes: moments (order,).

    Raises:
        ValueError: fewer than two moments; moments that no distribution has, with the inequality that fails.
    """

    moments: Vector
    mean: Vector
    covariance: Square

    def __init__(self, moments: "Float[ArrayLike, ' order']"):
        """Hold E[n], E[n^2], ..., mean and variance; raise ValueError unless some distribution has these moments."""
        self.moments = array("noise moments", moments, (None,))
        if len(self.moments) < 2:
            raise fail("noise moments", "at least E[n] and E[n^2]", f"{len(self.moments)} of them")
        if not is_traced(self.moments):
            check_moments(np.asarray(self.moments))
        self.mean = self.moments[:1]
        self.covariance = (self.moments[1] - self.moments[0] ** 2).reshape(1, 1)

    def sample(self, key: jax.Array) -> jax.Array:
        """Refuse: the law itself is unknown."""
        raise fail("simulating a noise known by its moments only", "a law that can be sampled", "NoiseMoments")

    def moment(self, powers: Exponents) -> Number:
        """Return the given E[n^order]; `powers` is (order,), since the noise has one component."""
        (order,) = powers
        if order == 0:
            return 1.0
        if order > len(self.moments):
            raise fail("noise moments", f"moments up to order {order}", f"{len(self.moments)} of them")
        return plain(self.moments[order - 1])


def check_moments(moments: np.ndarray) -> None:
    """Raise ValueError unless some distribution on the line has E[n^k] = moments[k - 1].

    Users state the moments of a noise n, and mistyped ones belong to no law. Every even moment must reach what the
    lower ones imply: with V = (1, n, ..., n^(j-1)) and H = E[V V'], E[n^2j] >= h' H^-1 h for h = E[V n^j]. For j = 2
    and zero mean: m4 >= m2^2 + m3^2 / m2. Where H is singular (a law on finitely many points, its atoms) h must lie in
    its range.
    """
    sequence = np.concatenate([[1.0], moments])
    # m[k] = E[n^k] in units of root(E[n^2])^k, so that one tolerance serves all orders. Orders from the first one on
    # whose unit overflows or underflows in double precision are not checked.
    scale = max(float(sequence[2]) ** 0.5, np.finfo(float).tiny) if sequence[2] > 0 else 1.0
    size = scale ** np.arange(len(sequence))
    representable = np.cumprod((size > np.finfo(float).tiny) & np.isfinite(size), dtype=bool)
    m = sequence[representable] / size[representable]
    # Range condition: h = E[V n^j] lies in the range of H = E[V V'].
    for j in range(1, len(m) // 2 + 1):
        H = np.array([[m[a + b] for b in range(j)] for a in range(j)])
        h = np.array([m[a + j] for a in range(j) if a + j < len(m)])
        if len(h) < j:  # higher moments are not given
            return
        solution = np.linalg.lstsq(H, h, rcond=MOMENT_TOLERANCE)[0]  # H^-1 h, or H^+ h where H is singular
        gap = np.max(np.abs(H @ solution - h))
        if gap > np.sqrt(MOMENT_TOLERANCE) * np.max(np.abs(h), initial=1.0):
            expected = "a law of the atoms that the lower moments imply"
            raise fail("noise moments", expected, f"E[n^{2 * j - 1}] = {moments[2 * j - 2]:.10g}, which no law has")
        # Schur complement: E[n^2j] >= h' H^-1 h.
        if 2 * j < len(m) and m[2 * j] < h @ solution - MOMENT_TOLERANCE * max(abs(m[2 * j]), 1.0):
            least = float(h @ solution) * scale ** (2 * j)
            raise fail("noise moments", f"E[n^{2 * j}] of at least {least:.10g}, which the lower moments imply",
                       f"{moments[2 * j - 1]:.10g}, which no distribution has")  # fmt: skip


def recorded_noise(samples: "Float[ArrayLike, 'samples *components']", order: int) -> FiniteSupport:
    """Return the empirical law of recorded samples: its moments are the sample's.

    Warns where the sample is too small for `order`: where the standard error of some E[n^a], |a| <= order, exceeds
    MOMENT_ERROR of its largest possible size prod_i (E|n_i|^|a|)^(a_i / |a|) (Hölder). A sample says nothing of shocks
    rarer than one in its length.

    Args:
        samples: recorded noise (samples, components) or (samples,).
        order: the highest moment that will be read (a filter of degree d reads 2 d).

    Raises:
        ValueError: fewer than two samples, an order below 1, numbers that are not finite.
    """
    # Samples as (samples, components).
    is_scalar = rank("noise samples", samples) == 1
    values = array("noise samples", samples, (None,) if is_scalar else (None, None))
    values = values[:, None] if is_scalar else values
    if len(values) < 2:
        raise fail("noise samples", "at least two", len(values))
    check_count("order of the noise moments", order)
    # Over all exponents a = (a_1, ...) with |a| = sum a_i up to `order`: the moment that is known worst, relative to
    # its largest possible size, and its order.
    absolute = np.abs(values)
    worst, worst_order = 0.0, 1
    for powers in (a for k in range(1, order + 1) for a in list_exponents(values.shape[1], k)):
        degree = sum(powers)
        # Standard error of the mean of n^a, and Hölder's bound of its size.
        error = np.std(np.prod(values ** np.array(powers), axis=1)) / np.sqrt(len(values))
        size = np.prod(np.mean(absolute**degree, axis=0) ** (np.array(powers) / degree))
        if size > 0 and error / size > worst:
            worst, worst_order = float(error / size), degree
    if worst > MOMENT_ERROR:  # the error falls as 1 / root of the number of samples
        needed = ceil(len(values) * (worst / MOMENT_ERROR) ** 2)
        warnings.warn(
            f"recorded noise: a moment of order {worst_order} is known to {100 * worst:.0f} % only; about "
            f"{needed:,} samples instead of {len(values):,} would give {100 * MOMENT_ERROR:.0f} %, or use a filter of "
            "lower degree",
            stacklevel=2,
        )
    return FiniteSupport(values, np.full(len(values), 1 / len(values)))


class CentredNoise(AbstractNoise):
    """Noise n - E[n] of a law of any kind: its moments are sums of the law's own."""

    source: AbstractNoise
    mean: Vector
    covariance: Square

    def __init__(self, source: AbstractNoise):
        """Hold the law of n; n - E[n] has mean 0 and the same covariance."""
        self.source, self.covariance = source, source.covariance
        self.mean = np.zeros(source.dimension)

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw n from its law, and return n - E[n]."""
        return self.source.sample(key) - jnp.asarray(self.source.mean)

    def moment(self, powers: Exponents) -> Number:
        """Return the central moment E prod_i (n_i - E n_i)^a_i of the noise `source` n, with the `powers` a.

        It is sum_{b <= a} prod_i C(a_i, b_i) (-E n_i)^(a_i - b_i) E[n^b].
        """
        total: Number = 0.0
        for b in product(*(range(a + 1) for a in powers)):
            factors = [
                comb(a_i, b_i) * plain((-self.source.mean[i]) ** (a_i - b_i))
                for i, (a_i, b_i) in enumerate(zip(powers, b, strict=True))
            ]
            total += prod(factors) * (self.source.moment(b) if any(b) else 1.0)
        return total


@singledispatch
def about_mean(law: AbstractNoise) -> AbstractNoise:
    """Return the law of n - E[n]; of the known kinds one of the same kind, so that nothing is subtracted twice."""
    return CentredNoise(law)


@about_mean.register
def _(law: Gaussian) -> AbstractNoise:
    """Return Gaussian noise of mean zero."""
    return Gaussian(law.covariance)


@about_mean.register
def _(law: FiniteSupport) -> AbstractNoise:
    """Return the noise with its values less their mean."""
    return FiniteSupport(law.atoms - law.mean, law.probabilities)


@about_mean.register
def _(law: Independent) -> AbstractNoise:
    """Return the parts, each about its mean."""
    return Independent([about_mean(component) for component in law.parts])


@about_mean.register
def _(law: Shaped) -> AbstractNoise:
    """Return B (u - E u) of a noise B u."""
    return Shaped(law.matrix, about_mean(law.source))
