"""Noise that enters through a known matrix, n = B u, with the moments and the branches that B leaves of those of u."""

import jax
import jax.numpy as jnp

from heliograph.factors.covariance_factors import WeightedColumns
from heliograph.numerics.check import array, instance
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.moments.mixture_components import GaussianBranches, NoiseAtom, NoiseWithoutOutliers
from heliograph.random_affine.moments.monomials import Exponents, multiply_by_linear_form
from heliograph.random_affine.noises.noise import AbstractNoise, Matrix, Number, Square, Vector


class Shaped(AbstractNoise):
    """Noise n = B u: a noise u that enters through a known matrix B, as process noise does.

    Args:
        matrix: B (dimension, source.dimension).
        source: law of u.
    """

    matrix: Matrix
    source: AbstractNoise
    mean: Vector
    covariance: Square

    def __init__(self, matrix: "Float[ArrayLike, 'dimension source']", source: AbstractNoise):
        """Hold B and the law of u; mean and covariance are B E[u] and B Cov[u] B'."""
        instance("source of a shaped noise", source, AbstractNoise, "a law of a noise vector")
        self.matrix = array("noise matrix", matrix, (None, source.dimension))
        self.source = source
        self.mean = self.matrix @ source.mean
        self.covariance = self.matrix @ source.covariance @ self.matrix.T

    @property
    def columns(self) -> WeightedColumns:
        """Covariance of n = B u as columns B W with weights w, where W diag(w) W' is the covariance of the source u."""
        return self.source.columns.through(self.matrix)

    @property
    def has_outliers(self) -> bool:
        """True if the law of the source u has outliers: then so has n = B u."""
        return self.source.has_outliers

    @property
    def is_symmetric(self) -> bool:
        """True if the law of the source u is known to be symmetric about its mean: then so is that of n = B u."""
        return self.source.is_symmetric

    def branches(self) -> GaussianBranches:
        """Return each component of B u as a mixture of Gaussian branches about its mean."""
        return self.source.branches_through(self.matrix)

    def branches_through(self, matrix: Matrix) -> GaussianBranches:
        """Return each component of A n = A B u, `matrix` A, as a mixture of Gaussian branches about its mean."""
        return self.source.branches_through(matrix @ self.matrix)

    def without_outliers(self) -> NoiseWithoutOutliers:
        """Return mean, relative to that of n, and covariance of n = B u, if the source u has no outlier."""
        mean, covariance = self.source.without_outliers()
        return NoiseWithoutOutliers(self.matrix @ mean, self.matrix @ covariance @ self.matrix.T)

    def list_atoms(self) -> list[NoiseAtom]:
        """Return the atoms of n = B u: for an atom u = c + N(0, R) of probability p, n = B c + N(0, B R B')."""
        B = self.matrix
        return [NoiseAtom(p, B @ c, B @ R @ B.T) for p, c, R in self.source.list_atoms()]

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw n = B u from a draw of the source u."""
        return jnp.asarray(self.matrix) @ self.source.sample(key)

    def moment(self, powers: Exponents) -> Number:
        """Return E[n^a] = E[prod_i (sum_j B_ij u_j)^a_i]: the mean of a polynomial in the source u, term by term."""
        polynomial: dict[Exponents, Number] = {(0,) * self.source.dimension: 1.0}
        for i, power in enumerate(powers):
            for _ in range(power):
                polynomial = multiply_by_linear_form(polynomial, self.matrix[i])
        moment = self.source.moment
        return sum(coefficient * (moment(a) if any(a) else 1.0) for a, coefficient in polynomial.items())
