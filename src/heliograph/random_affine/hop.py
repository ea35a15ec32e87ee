"""The atom of a channel: one random gain times a known matrix, plus noise."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.check import array, fail, show_value
from heliograph.numerics.traced import library, scatter, stack_parts
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.law import AbstractLaw, Constant
from heliograph.random_affine.moments.monomials import (
    Moments,
    count_monomials,
    degrees,
    refuse_if_too_large,
    sum_plan,
    symmetric_power,
)
from heliograph.random_affine.noise import AbstractNoise, Gaussian, Matrix, Vector, as_noise, noise_vector


class AbstractHop(AbstractRandomAffine):
    """Random affine map z = g A y + n of a known matrix A and a noise n, whatever the law of its gain g is."""

    matrix: eqx.AbstractVar[Matrix]
    noise: eqx.AbstractVar[AbstractNoise]

    @property
    def outputs(self) -> int:
        """Length of z."""
        return int(self.matrix.shape[-2])

    @property
    def inputs(self) -> int:
        """Length of y."""
        return int(self.matrix.shape[-1])


class GainAndNoise(AbstractHop):
    """Random affine map z = g A y + n with a scalar random gain g, a known matrix A and noise n, all independent.

    Args:
        law: law of the gain g; `Constant` for a known number.
        matrix: A (m, p).
        noise: law of n with m components, its covariance (m, m), or a variance that all components have.

    Raises:
        ValueError: a gain that is no law, shapes that do not fit, numbers that are not finite.
    """

    law: AbstractLaw
    matrix: Matrix
    noise: AbstractNoise

    def __init__(
        self, law: AbstractLaw, matrix: "Float[ArrayLike, 'm p']", noise: "AbstractNoise | Float[ArrayLike, '*m']"
    ):
        if not isinstance(law, AbstractLaw):
            raise fail("gain of a hop", "a law (Constant for a number)", show_value(law))
        self.law = law
        self.matrix = array("gain matrix", matrix, ("outputs", "inputs"))
        self.noise = as_noise("channel noise", noise, self.matrix.shape[0])

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw [[g A, n], [0, 1]]."""
        gain_key, noise_key = jax.random.split(key)
        top = jnp.concatenate(
            [self.law.sample(gain_key) * jnp.asarray(self.matrix), self.noise.sample(noise_key)[:, None]],
            axis=1,
        )
        return jnp.concatenate([top, np.eye(1, self.inputs + 1, self.inputs)], axis=0)

    @property
    def remembers(self) -> bool:
        """Always False: draws are independent over time."""
        return False

    @cache_by_object
    def moments(self, order: int) -> Moments:
        """Return sum_k E[g^k] B_k, with B_k the `gain_coefficients`."""
        gains = gain_moments(self.law, order)
        basis = self.gain_coefficients(order)
        return Moments(library(gains, basis).tensordot(gains, basis, axes=1), self.outputs, self.inputs, order)

    @cache_by_object
    def gain_coefficients(self, order: int) -> Float[jax.Array | np.ndarray, "order+1 rows columns"]:
        """Return B_k: E[prod_i (g (A y)_i + n_i)^a_i] = sum_{b <= a} C(a, b) E[g^|b|] (A y)^b E[n^(a-b)], |b| = k."""
        rows, columns = count_monomials(self.outputs + 1, order), count_monomials(self.inputs + 1, order)
        refuse_if_too_large(rows, columns, f"moments of order {order}")
        deterministic = symmetric_power(affine_matrix(self.matrix), order)  # rows (A y)^b, made homogeneous with 1
        row, column, rest, ways = sum_plan(self.outputs, order)
        terms = (ways * noise_vector(self.noise, order)[rest])[:, None] * deterministic[column]
        return scatter((order + 1, rows, columns), (degrees(self.outputs, order)[column], row), terms)

    def extremes(self) -> tuple[AbstractRandomAffine, ...]:
        """Return one map for each extreme law of the gain."""
        return tuple(GainAndNoise(law, self.matrix, self.noise) for law in self.law.extremes())

    def corner_count(self) -> int:
        """Number of extreme laws of the gain."""
        return len(self.law.corner_moments(0))

    def corner_moments(self, order: int) -> Float[jax.Array | np.ndarray, "corner rows columns"]:
        """Return the moments with E[g^k] of each extreme law."""
        gains, basis = self.law.corner_moments(order), self.gain_coefficients(order)
        moment_map: jax.Array | np.ndarray = library(gains, basis).tensordot(gains, basis, axes=1)
        return moment_map

    def mean_gain(self) -> AbstractRandomAffine:
        """Return the map E[g] A y + n."""
        return GainAndNoise(self.law.mean_law(), self.matrix, self.noise)


def affine_matrix(matrix: Matrix) -> Matrix:
    """[[A, 0], [0, 1]], which maps (y, 1) to (A y, 1)."""
    outputs, inputs = matrix.shape
    right, below = np.zeros((outputs, 1)), np.eye(1, inputs + 1, inputs)
    xp = library(matrix)
    extended: Matrix = xp.concatenate([xp.concatenate([matrix, right], axis=1), below])
    return extended


def gain_moments(law: AbstractLaw, order: int) -> Vector:
    """Return E[g^k] for k = 0, ..., order."""
    moment = law.moment  # of a module, whose methods are slow to look up
    return stack_parts([moment(k) for k in range(order + 1)])


def known(matrix: "Float[ArrayLike, 'm p']", offset: "Float[ArrayLike, ' m'] | None" = None) -> GainAndNoise:
    """Return the deterministic map z = A y + b.

    Args:
        matrix: A (m, p).
        offset: b (m,), zero unless given.

    Raises:
        ValueError: shapes that do not fit, or numbers that are not finite.
    """
    a = array("matrix", matrix, ("outputs", "inputs"))
    b = np.zeros(a.shape[0]) if offset is None else array("offset", offset, (a.shape[0],))
    return GainAndNoise(Constant(1.0), a, Gaussian(np.zeros((a.shape[0], a.shape[0])), b))
