"""The atom of the algebra: one random gain times a matrix, plus noise."""

from functools import cache
from itertools import product
from math import comb, prod
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import array
from heliograph.random_affine.base import AbstractRandomAffine, Moments
from heliograph.random_affine.law import AbstractLaw, Constant
from heliograph.random_affine.monomials import (
    Exponents,
    count,
    exponents,
    position,
    refuse_if_too_large,
    symmetric_power,
)
from heliograph.random_affine.noise import AbstractNoise, Gaussian, as_noise


class GainAndNoise(AbstractRandomAffine):
    """z = g A y + n: a scalar random gain g, a known matrix A and noise n, all independent."""

    gain: AbstractLaw
    matrix: np.ndarray
    noise: AbstractNoise

    def __init__(self, gain: AbstractLaw, matrix: Any, noise: Any):
        self.gain = gain
        self.matrix = array("gain matrix", matrix, (None, None))
        self.noise = as_noise("channel noise", noise, self.matrix.shape[0])

    @property
    def outputs(self) -> int:
        """Length of z."""
        return int(self.matrix.shape[-2])

    @property
    def inputs(self) -> int:
        """Length of y."""
        return int(self.matrix.shape[-1])

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw [[g A, n], [0, 1]]."""
        gain_key, noise_key = jax.random.split(key)
        top = jnp.concatenate(
            [self.gain.sample(gain_key) * jnp.asarray(self.matrix), self.noise.sample(noise_key)[:, None]],
            axis=1,
        )
        return jnp.concatenate([top, jnp.eye(1, self.inputs + 1, self.inputs)], axis=0)

    def moments(self, order: int) -> Moments:
        """E[prod_i (g (A y)_i + n_i)^a_i] = sum_{b <= a} C(a, b) E[g^|b|] (A y)^b E[n^(a-b)]."""
        rows, columns = count(self.outputs + 1, order), count(self.inputs + 1, order)
        refuse_if_too_large(rows, columns, f"moments of order {order}")
        homogeneous = np.zeros((self.outputs + 1, self.inputs + 1))
        homogeneous[:-1, :-1], homogeneous[-1, -1] = self.matrix, 1.0
        deterministic = symmetric_power(homogeneous, order)  # rows (A y)^b, made homogeneous with 1
        places = position(self.outputs + 1, order)
        gain_moment = cache(self.gain.moment)
        noise_moment = cache(self.noise.moment)
        matrix = np.zeros((rows, columns))
        for row, powers in enumerate(exponents(self.outputs + 1, order)):
            a = powers[:-1]
            for b in product(*(range(x + 1) for x in a)):
                weight = _binomial(a, b) * noise_moment(tuple(x - y for x, y in zip(a, b, strict=True)))
                if weight:
                    weight *= gain_moment(sum(b))
                    matrix[row] += weight * deterministic[places[(*b, order - sum(b))]]
        return Moments(matrix, self.outputs, self.inputs, order)

    def extremes(self) -> tuple[AbstractRandomAffine, ...]:
        """One map for each extreme law of the gain."""
        return tuple(GainAndNoise(law, self.matrix, self.noise) for law in self.gain.extremes())

    def mean_gain(self) -> AbstractRandomAffine:
        """E[g] A y + n."""
        return GainAndNoise(self.gain.mean_law(), self.matrix, self.noise)


def _binomial(a: Exponents, b: Exponents) -> int:
    return prod(comb(x, y) for x, y in zip(a, b, strict=True))


def known(matrix: Any, offset: Any = None) -> GainAndNoise:
    """The deterministic map z = A y + b.

    Raises:
        ValueError: shapes that do not fit, or numbers that are not finite.
    """
    a = array("matrix", matrix, (None, None))
    b = np.zeros(a.shape[0]) if offset is None else array("offset", offset, (a.shape[0],))
    return GainAndNoise(Constant(1.0), a, Gaussian(np.zeros((a.shape[0], a.shape[0])), b))
