"""Laws of an additive noise vector: each samples itself and knows its joint moments E[n^a]."""

from collections.abc import Sequence
from functools import cache, singledispatch
from itertools import islice

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.factors.covariance_factors import WeightedColumns, columns_of, columns_with_derivatives
from heliograph.factors.pivots import square_root
from heliograph.numerics import check
from heliograph.numerics.check import array, fail, items, show_value
from heliograph.numerics.module import Module, readable, unwritten
from heliograph.numerics.numpy_or_jax import block_diagonal, is_traced, is_zero, library, plain, stack_parts
from heliograph.numerics.trace_settings import writes_for_derivatives
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.laws.law import draw_index
from heliograph.random_affine.moments.mixture_components import (
    GaussianBranches,
    NoiseAtom,
    NoiseWithoutOutliers,
    SignalNoise,
    combine_atoms,
    stack_branches,
)
from heliograph.random_affine.moments.monomials import Exponents, list_exponents
from heliograph.random_affine.noises.factor_of_covariance import (
    FACTOR_TOLERANCE,
    WeightsOfFactor,
    factor_by_eigenvectors,
)

Number = float | jax.Array
Vector = Float[jax.Array | np.ndarray, " n"]
Matrix = Float[jax.Array | np.ndarray, "n m"]
Square = Float[jax.Array | np.ndarray, "n n"]


@readable
class AbstractNoise(Module):
    """Law of a noise vector n, independent over time and of everything else.

    Its parameters are numbers, or traced by JAX: then so are its moments.

    Args:
        mean: E[n] (dimension,).
        covariance: Cov n (dimension, dimension).
    """

    mean: eqx.AbstractVar[Vector]
    covariance: eqx.AbstractVar[Square]
    formulas = "mean", "covariance", "moment", "list_atoms", "branches", "without_outliers"

    @property
    def dimension(self) -> int:
        """Length of the noise vector n."""
        return int(self.mean.shape[-1])

    @property
    def columns(self) -> WeightedColumns:
        """Covariance as a sum of squares W diag(w) W': by the root that is drawn from, where there is one."""
        return columns_of(self.covariance)

    @property
    def has_outliers(self) -> bool:
        """True if the law is one with outliers, such as Student's t; by default it is not."""
        return False

    @property
    def is_symmetric(self) -> bool:
        """True if the law is known to be symmetric about its mean."""
        return False

    def branches(self) -> GaussianBranches:
        """Return each component's law as a mixture of Gaussians ("branches"), whose means are relative to E[n].

        By default it is one branch: N(0, variance), exact for Gaussian noise.
        """
        variances = library(self.covariance).diagonal(self.covariance)[:, None]
        return GaussianBranches(np.zeros((self.dimension, 1)), np.zeros((self.dimension, 1)), variances)

    def branches_through(self, matrix: Matrix) -> GaussianBranches:
        """Return each component of B n as a mixture of Gaussian branches about its mean; by default it is one branch.

        `matrix` is B (rows, dimension).
        """
        variances = library(matrix, self.covariance).diagonal(matrix @ self.covariance @ matrix.T)[:, None]
        return GaussianBranches(np.zeros((len(matrix), 1)), np.zeros((len(matrix), 1)), variances)

    def without_outliers(self) -> NoiseWithoutOutliers:
        """Return the mean, relative to that of the whole, and covariance of the noise without its outliers."""
        return NoiseWithoutOutliers(np.zeros(self.dimension), self.covariance)

    def report(self, y: jax.Array) -> jax.Array:
        """Return what is reported of a measurement with this noise: by default the measurement itself."""
        return y

    def given_signal(self, mean: Vector, variances: Vector) -> SignalNoise:
        """Return the noise added to a signal y of this mean and these variances (dimension,), without the noise.

        The noise of a rounded measurement depends on the signal. By default the noise does not.
        """
        return SignalNoise(self.columns, self.covariance)

    def list_atoms(self) -> list[NoiseAtom]:
        """Return the noise as a mixture of atoms c + N(0, R) with probabilities; by default raise ValueError."""
        raise fail("mixture filter", "noises of finite support or Gaussian", type(self).__name__)

    def split(self, groups: Sequence[Sequence[int]]) -> "list[AbstractNoise] | None":
        """Split into the noises of groups of components, None unless the groups are independent and complete."""
        complete = [i for group in groups for i in group] == list(range(self.dimension))
        return self._split(groups) if complete and not is_traced(self) else None

    def _split(self, groups: Sequence[Sequence[int]]) -> "list[AbstractNoise] | None":
        """Return the noise of each group, where groups have all components; None (the default) if not independent."""
        return None

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw one noise vector n of shape (dimension,)."""
        raise unwritten(self, "sample")

    def moment(self, powers: Exponents) -> Number:
        """Return E[n_1^powers[0] n_2^powers[1] ...]."""
        raise unwritten(self, "moment")


class Gaussian(AbstractNoise):
    """Gaussian noise with the given covariance and mean (zero unless given).

    It holds a factor of the covariance beside it, which is computed anew if another covariance is put into the object.

    Shapes: covariance (n, n), mean (n,).
    """

    covariance: Square
    mean: Vector
    factor: Square  # A diag(w) A' is the covariance: of eigenvectors, with w = 1; where it is traced, L and d of L D L'
    weights: Vector = WeightsOfFactor(factor_by_eigenvectors, FACTOR_TOLERANCE)  # type: ignore[assignment]

    def __init__(self, covariance: ArrayLike, mean: ArrayLike | None = None):
        """Hold covariance and mean, and a factor A with weights w of the covariance, A diag(w) A', to draw from.

        Known numbers are factored by eigenvectors, w = 1; a covariance that JAX traces as L diag(d) L'.
        """
        self.covariance = check.covariance("noise covariance", covariance)
        n = self.covariance.shape[-1]
        self.mean = np.zeros(n) if mean is None else array("noise mean", mean, (n,))
        if is_traced(self.covariance):  # eigenvectors have no derivative where eigenvalues are equal
            self.factor, self.weights = columns_of(self.covariance)
            return
        self.factor = factor_by_eigenvectors(np.asarray(self.covariance))
        self.weights = np.ones(n)

    @property
    def columns(self) -> WeightedColumns:
        """Covariance A diag(w) A' as columns A with weights w."""
        # A traced covariance was put in place of that of numbers (`eqx.tree_at`): the factor is of another one. And the
        # factor of a traced covariance lacks its derivatives where it is zero.
        if is_traced(self.covariance) and (writes_for_derivatives() or not is_traced(self.factor)):
            return columns_with_derivatives(self.covariance)
        return WeightedColumns(self.factor, self.weights)

    @property
    def is_symmetric(self) -> bool:
        """Always True: a Gaussian law is symmetric about its mean."""
        return True

    def list_atoms(self) -> list[NoiseAtom]:
        """Return one atom, the mean, with the covariance about it."""
        return [NoiseAtom(1.0, self.mean, self.covariance)]

    def _split(self, groups: Sequence[Sequence[int]]) -> list[AbstractNoise] | None:
        """Return the noise of each group of components, or None if two groups are correlated."""
        group_of_component = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
        are_apart = group_of_component[:, None] != group_of_component
        if np.any(np.asarray(self.covariance)[are_apart]):
            return None
        return [Gaussian(self.covariance[np.ix_(group, group)], self.mean[np.asarray(group)]) for group in groups]

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw mean + A e with e normal of variances w."""
        A, w = self.columns
        e = square_root(jnp.asarray(w)) * jax.random.normal(key, self.mean.shape, dtype=float)
        return jnp.asarray(self.mean + A @ e)

    def moment(self, powers: Exponents) -> Number:
        """Return E[n^a] = E[n_1^a_1 n_2^a_2 ...], a = `powers`, of n ~ N(m, S).

        It is found by Stein's identity E[n_i g(n)] = m_i E[g] + sum_j S_ij E[dg/dn_j], which lowers the degree.
        """

        @cache
        def expectation(a: Exponents) -> Number:
            """Return E[n^a] = E[n_i g(n)] = m_i E[g] + sum_j S_ij E[dg/dn_j], for the first i with a_i > 0.

            This is Stein's identity for Gaussian n of mean m and covariance S.
            """
            if sum(a) == 0:
                return 1.0
            i = next(index for index, power in enumerate(a) if power)
            exponents_of_g = (*a[:i], a[i] - 1, *a[i + 1 :])
            total = plain(self.mean[i]) * expectation(exponents_of_g)
            for j, power in enumerate(exponents_of_g):
                if power and not is_zero(self.covariance[i, j]):
                    # dg/dn_j is `power` times the monomial with one power of n_j less.
                    lowered = (*exponents_of_g[:j], power - 1, *exponents_of_g[j + 1 :])
                    total += plain(self.covariance[i, j]) * power * expectation(lowered)
            return total

        return expectation(tuple(powers))


class FiniteSupport(AbstractNoise):
    """Noise with finitely many values.

    Args:
        atoms: the values (atom, component).
        probabilities: their probabilities (atom,).
    """

    atoms: Matrix
    probabilities: Vector
    mean: Vector
    covariance: Square

    def __init__(self, atoms: "Float[ArrayLike, 'atom component']", probabilities: "Float[ArrayLike, ' atom']"):
        """Hold the values and their probabilities; mean and covariance follow."""
        self.atoms = array("noise atoms", atoms, ("atoms", "components"))
        self.probabilities = check.probabilities("noise probabilities", probabilities, len(self.atoms))
        self.mean = self.probabilities @ self.atoms
        deviations = self.atoms - self.mean
        self.covariance = deviations.T @ (self.probabilities[:, None] * deviations)

    def list_atoms(self) -> list[NoiseAtom]:
        """Return the values with their probabilities, each a point: of covariance 0 about it."""
        zero = np.zeros((self.dimension, self.dimension))
        return [NoiseAtom(plain(p), value, zero) for p, value in zip(self.probabilities, self.atoms, strict=True)]

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw one of the values, by inverting the distribution function at a uniform draw."""
        return jnp.asarray(self.atoms)[draw_index(self.probabilities, key)]

    def moment(self, powers: Exponents) -> Number:
        """Return sum_s p_s prod_i atom_si^powers_i."""
        return plain(self.probabilities @ library(self.atoms).prod(self.atoms ** np.array(powers), axis=1))


class Independent(AbstractNoise):
    """Independent noises one above the other: E[n^a] is the product of the parts' moments."""

    parts: tuple[AbstractNoise, ...]
    mean: Vector
    covariance: Square

    def __init__(self, parts: Sequence[AbstractNoise]):
        """Hold the independent noises; their means are concatenated, their covariances are the diagonal blocks."""
        self.parts = tuple(items("independent noises", parts, "laws"))
        if not self.parts:
            raise fail("independent noises", "at least one", "none")
        if no_noises := [noise for noise in self.parts if not isinstance(noise, AbstractNoise)]:
            raise fail("independent noises", "laws of a noise vector", show_value(no_noises[0]))
        means = [noise.mean for noise in self.parts]
        covariances = [noise.covariance for noise in self.parts]
        self.mean = library(means).concatenate(means)
        self.covariance = block_diagonal(covariances)

    @property
    def columns(self) -> WeightedColumns:
        """Columns A and weights w with covariance A diag(w) A': those of the parts, one after another."""
        columns_by_noise = [noise.columns for noise in self.parts]
        matrices = [columns.matrix for columns in columns_by_noise]
        weights = library(columns_by_noise).concatenate([columns.weights for columns in columns_by_noise])
        return WeightedColumns(block_diagonal(matrices), weights)

    @property
    def has_outliers(self) -> bool:
        """True if the law of one of the independent parts has outliers."""
        return any(component.has_outliers for component in self.parts)

    @property
    def is_symmetric(self) -> bool:
        """True if the laws of all independent parts are known to be symmetric about their means."""
        return all(component.is_symmetric for component in self.parts)

    def branches(self) -> GaussianBranches:
        """Return each component as a mixture of Gaussian branches about its mean: those of the independent parts."""
        return stack_branches([component.branches() for component in self.parts])

    def branches_through(self, matrix: Matrix) -> GaussianBranches:
        """Return each component of B n, `matrix` B (rows, dimension), as a mixture of Gaussian branches about its mean.

        n = (n_1, n_2, ...) are the independent parts. A branch of row i of B n is a combination of one branch of each
        number B_ip n_p, B_ip the entries of B for part p.
        """
        ends = np.cumsum([component.dimension for component in self.parts])[:-1]
        blocks = library(matrix).split(matrix, ends, axis=1)
        return stack_branches([self._add_branches([block[[i]] for block in blocks]) for i in range(len(matrix))])

    def _add_branches(self, rows: Sequence[Matrix]) -> GaussianBranches:
        """Return the number sum_p row_p n_p, of independent noises n_p, as a mixture of Gaussian branches.

        A branch of a sum has the product of the probabilities of two branches, and the sums of their means and of their
        variances. So all three arrays of `GaussianBranches`, the first of logarithms, are added in pairs.

        Args:
            rows: row_p (1, size of part p) for each part. Parts with a row of zeros are left out.
        """
        zero = np.zeros((1, 1))
        total = GaussianBranches(log_share=zero, mean=zero, variance=zero)  # of the sum of no noise: 0 for certain
        for component, row in zip(self.parts, rows, strict=True):
            if not is_zero(row):
                branches = component.branches_through(row)
                sums_of_pairs = (a[:, :, None] + b[:, None] for a, b in zip(total, branches, strict=True))
                total = GaussianBranches(*(pairs.reshape(1, -1) for pairs in sums_of_pairs))
        return total

    def without_outliers(self) -> NoiseWithoutOutliers:
        """Return mean and covariance of the independent parts without their outliers, one above the other."""
        inliers = [noise.without_outliers() for noise in self.parts]
        mean = library(inliers).concatenate([inlier.mean for inlier in inliers])
        return NoiseWithoutOutliers(mean, block_diagonal([inlier.covariance for inlier in inliers]))

    def list_atoms(self) -> list[NoiseAtom]:
        """Return all combinations of one atom of each part, with the product of their probabilities."""
        return combine_atoms([component.list_atoms() for component in self.parts], NoiseAtom.above)

    def _split(self, groups: Sequence[Sequence[int]]) -> list[AbstractNoise] | None:
        """Return the noise of each group of components, or None if a part has components in two groups."""
        # Which part each component belongs to, and the parts that have a component in each group.
        noise_of_component = np.repeat(np.arange(len(self.parts)), [noise.dimension for noise in self.parts])
        numbers_by_group = [dict.fromkeys(noise_of_component[list(group)].tolist()) for group in groups]
        noises_by_group = [[self.parts[i] for i in numbers] for numbers in numbers_by_group]
        dimensions = [sum(noise.dimension for noise in noises) for noises in noises_by_group]
        are_whole = dimensions == [len(group) for group in groups]
        return [Independent(noises) for noises in noises_by_group] if are_whole else None

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw each independent part, and return them one after another (dimension,)."""
        keys = jax.random.split(key, len(self.parts))
        return jnp.concatenate([component.sample(k) for component, k in zip(self.parts, keys, strict=True)])

    def report(self, y: jax.Array) -> jax.Array:
        """Return the reported values of a measurement y, such as rounded ones; each noise reports its own part of y."""
        ends = np.cumsum([noise.dimension for noise in self.parts])[:-1]
        pairs = zip(self.parts, jnp.split(y, ends), strict=True)
        return jnp.concatenate([noise.report(y_of_noise) for noise, y_of_noise in pairs])

    def moment(self, powers: Exponents) -> Number:
        """Return E[n^a], the product of E[n_j^a_j] over the independent noises n_j; `powers` are the exponents a."""
        product: Number = 1.0
        next_powers = iter(powers)
        for noise in self.parts:
            exponents = tuple(islice(next_powers, noise.dimension))
            product *= noise.moment(exponents) if any(exponents) else 1.0
        return product


NoiseLike = TypeAliasType("NoiseLike", AbstractNoise | ArrayLike)  # a law, a covariance, or a variance


def as_noise(name: str, value: NoiseLike, dimension: int) -> AbstractNoise:
    """Return a noise law as it is, and for a covariance or variance the Gaussian noise of mean zero.

    `name` says in errors what the noise is.
    """
    if isinstance(value, eqx.Module) and not isinstance(value, AbstractNoise):
        expected = "a variance, a covariance or a law of a noise vector (Gaussian, FiniteSupport, Independent, Shaped)"
        raise fail(name, expected, type(value).__name__)
    if not isinstance(value, AbstractNoise):
        return Gaussian(check.covariance(name, value, dimension))
    if value.dimension != dimension:
        raise fail(name, f"a noise of dimension {dimension}", f"dimension {value.dimension}")
    return value


def count_components(value: NoiseLike) -> int | None:
    """Return the number of components of a noise law or covariance; None for a number, which fits any size."""
    if isinstance(value, AbstractNoise):
        return value.dimension
    try:
        shape = np.shape(value) if not is_traced(value) else jnp.asarray(value).shape
    except ValueError:  # rows of different lengths
        raise fail("noise", "a variance, a covariance or a law", show_value(value)) from None
    return shape[0] if shape else None


@singledispatch
def noise_moment_vector(noise: AbstractNoise, order: int) -> Vector:
    """Return all moments E[n^a] with |a| <= `order` of a noise law, (C(dimension + order, order),).

    They are in the order of the monomials n^a 1^(order - |a|) in `list_exponents`.
    """
    moment = noise.moment  # looked up once: attribute access of a module is slow
    return stack_parts([moment(powers[:-1]) for powers in list_exponents(noise.dimension + 1, order)])
