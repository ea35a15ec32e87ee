"""Laws of an additive noise vector: each samples itself and knows its joint moments E[n^a]."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag

from heliograph.numerics.check import array, covariance, fail, probabilities
from heliograph.random_affine.monomials import Exponents, exponents


class AbstractNoise(eqx.Module):
    """A law of a noise vector, independent over time and of everything else."""

    mean: eqx.AbstractVar[np.ndarray]
    covariance: eqx.AbstractVar[np.ndarray]

    @property
    def dimension(self) -> int:
        """Length of the noise vector."""
        return int(self.mean.shape[-1])

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw one vector; shape (dimension,)."""
        raise NotImplementedError

    def moment(self, powers: Exponents) -> float:
        """Return E[n_1^powers[0] n_2^powers[1] ...]."""
        raise NotImplementedError


class Gaussian(AbstractNoise):
    """Gaussian noise with the given covariance and mean (zero unless given)."""

    covariance: np.ndarray
    mean: np.ndarray
    factor: np.ndarray  # A with A A' = covariance

    def __init__(self, covariance_: Any, mean: Any = None):
        self.covariance = covariance("noise covariance", covariance_)
        n = self.covariance.shape[-1]
        self.mean = np.zeros(n) if mean is None else array("noise mean", mean, (n,))
        values, vectors = np.linalg.eigh(self.covariance)
        self.factor = vectors * np.sqrt(np.maximum(values, 0.0))

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw mean + A w with w standard normal."""
        return jnp.asarray(self.mean + self.factor @ jax.random.normal(key, self.mean.shape, dtype=float))

    def moment(self, powers: Exponents) -> float:
        """Return E[n^a] by E[n_i g(n)] = m_i E[g] + sum_j S_ij E[dg/dn_j] (Isserlis, Stein)."""

        @cache
        def expectation(a: Exponents) -> float:
            if sum(a) == 0:
                return 1.0
            i = next(index for index, power in enumerate(a) if power)
            rest = (*a[:i], a[i] - 1, *a[i + 1 :])
            total = float(self.mean[i]) * expectation(rest)
            for j, power in enumerate(rest):
                if power and self.covariance[i, j]:
                    lower = (*rest[:j], power - 1, *rest[j + 1 :])
                    total += float(self.covariance[i, j]) * power * expectation(lower)
            return total

        return expectation(tuple(powers))


class FiniteSupport(AbstractNoise):
    """Noise that takes the vectors `atoms` (atom, component) with `probabilities`."""

    atoms: np.ndarray
    probabilities: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray

    def __init__(self, atoms: Any, probabilities_: Any):
        self.atoms = array("noise atoms", atoms, (None, None))
        self.probabilities = probabilities("noise probabilities", probabilities_, len(self.atoms))
        self.mean = self.probabilities @ self.atoms
        centred = self.atoms - self.mean
        self.covariance = centred.T @ (self.probabilities[:, None] * centred)

    def sample(self, key: jax.Array) -> jax.Array:
        """Invert the distribution function at a uniform draw."""
        edges = jnp.cumsum(jnp.asarray(self.probabilities))[:-1]
        return jnp.asarray(self.atoms)[jnp.sum(jax.random.uniform(key, dtype=float) > edges)]

    def moment(self, powers: Exponents) -> float:
        """Return sum_s p_s prod_i atom_si^powers_i."""
        return float(self.probabilities @ np.prod(self.atoms ** np.array(powers), axis=1))


class Independent(AbstractNoise):
    """Independent noises one above the other: E[n^a] is the product of the parts' moments."""

    parts: tuple[AbstractNoise, ...]
    mean: np.ndarray
    covariance: np.ndarray

    def __init__(self, parts: Sequence[AbstractNoise]):
        self.parts = tuple(parts)
        if not self.parts:
            raise fail("independent noises", "at least one", "none")
        self.mean = np.concatenate([part.mean for part in self.parts])
        self.covariance = np.asarray(block_diag(*(part.covariance for part in self.parts)))

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw each part."""
        keys = jax.random.split(key, len(self.parts))
        return jnp.concatenate([part.sample(k) for part, k in zip(self.parts, keys, strict=True)])

    def moment(self, powers: Exponents) -> float:
        """Return prod_parts E[n_part^a_part]."""
        value, start = 1.0, 0
        for part in self.parts:
            own = tuple(powers[start : start + part.dimension])
            start += part.dimension
            value *= part.moment(own) if any(own) else 1.0
        return value


class Shaped(AbstractNoise):
    """n = B u: a noise u that enters through a known matrix B, as process noise does.

    Shapes: matrix (dimension, source.dimension).
    """

    matrix: np.ndarray
    source: AbstractNoise
    mean: np.ndarray
    covariance: np.ndarray

    def __init__(self, matrix: Any, source: AbstractNoise):
        self.matrix = array("noise matrix", matrix, (None, source.dimension))
        self.source = source
        self.mean = self.matrix @ source.mean
        self.covariance = self.matrix @ source.covariance @ self.matrix.T

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw B u."""
        return jnp.asarray(self.matrix) @ self.source.sample(key)

    def moment(self, powers: Exponents) -> float:
        """Return E[prod_i (sum_j B_ij u_j)^a_i], a polynomial in u whose terms' moments are the source's."""
        polynomial = {(0,) * self.source.dimension: 1.0}
        for i, power in enumerate(powers):
            for _ in range(power):
                polynomial = _times_linear(polynomial, self.matrix[i])
        return sum(c * (self.source.moment(a) if any(a) else 1.0) for a, c in polynomial.items())


def _times_linear(polynomial: dict[Exponents, float], row: np.ndarray) -> dict[Exponents, float]:
    """Coefficients of p(u) sum_j row_j u_j."""
    result: dict[Exponents, float] = {}
    for a, c in polynomial.items():
        for j in np.flatnonzero(row):
            raised = (*a[:j], a[j] + 1, *a[j + 1 :])
            result[raised] = result.get(raised, 0.0) + c * float(row[j])
    return result


def as_noise(name: str, value: Any, dimension: int) -> AbstractNoise:
    """Take a noise law as it is, or a covariance (or variance) as zero-mean Gaussian noise.

    Raises:
        ValueError: not a covariance, or a law of another dimension.
    """
    if not isinstance(value, AbstractNoise):
        return Gaussian(covariance(name, value, dimension))
    if value.dimension != dimension:
        raise fail(name, f"a noise of dimension {dimension}", f"dimension {value.dimension}")
    return value


def noise_moments(noise: AbstractNoise, order: int) -> dict[Exponents, float]:
    """All E[n^a] with |a| <= order."""
    return {
        powers: noise.moment(powers) for degree in range(order + 1) for powers in exponents(noise.dimension, degree)
    }
