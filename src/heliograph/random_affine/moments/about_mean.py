"""A noise law without its mean: moments about the mean keep the digits that raw moments far from zero lose."""

from functools import singledispatch
from itertools import product
from math import comb, prod

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.traced import plain
from heliograph.random_affine.moments.monomials import Exponents
from heliograph.random_affine.noise import (
    AbstractNoise,
    FiniteSupport,
    Gaussian,
    Independent,
    Number,
    Shaped,
    Square,
    Vector,
)


class AboutMean(AbstractNoise):
    """n - E[n] for a law of any kind: its moments are sums of the law's own."""

    source: AbstractNoise
    mean: Vector
    covariance: Square

    def __init__(self, source: AbstractNoise):
        self.source, self.covariance = source, source.covariance
        self.mean = np.zeros(source.dimension)

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw n - E[n]."""
        return self.source.sample(key) - jnp.asarray(self.source.mean)

    def moment(self, powers: Exponents) -> Number:
        """Return sum_b prod_i C(a_i, b_i) (-E n_i)^(a_i - b_i) E[n^b]."""
        total: Number = 0.0
        for b in product(*(range(a + 1) for a in powers)):
            weights = [
                comb(a, lower) * plain((-self.source.mean[i]) ** (a - lower))
                for i, (a, lower) in enumerate(zip(powers, b, strict=True))
            ]
            total += prod(weights) * (self.source.moment(b) if any(b) else 1.0)
        return total


@singledispatch
def about_mean(law: AbstractNoise) -> AbstractNoise:
    """The law of n - E[n]; of the known kinds one of the same kind, so that nothing is subtracted twice."""
    return AboutMean(law)


@about_mean.register
def _(law: Gaussian) -> AbstractNoise:
    return Gaussian(law.covariance)


@about_mean.register
def _(law: FiniteSupport) -> AbstractNoise:
    return FiniteSupport(law.atoms - law.mean, law.probabilities)


@about_mean.register
def _(law: Independent) -> AbstractNoise:
    return Independent([about_mean(part) for part in law.parts])


@about_mean.register
def _(law: Shaped) -> AbstractNoise:
    return Shaped(law.matrix, about_mean(law.source))
