"""Noise laws with outliers: Student's and contaminated Gaussian noise, and the branches that a robust filter reads."""

from collections.abc import Sequence
from math import prod
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics import check
from heliograph.numerics.check import TINY, array, check_count, fail, rank, scalar
from heliograph.numerics.numpy_or_jax import is_traced, library, plain, scipy_for
from heliograph.numerics.types import ArrayLike, Float, PyTree
from heliograph.random_affine.laws.law import draw_index
from heliograph.random_affine.moments.mixture_components import GaussianBranches, NoiseWithoutOutliers
from heliograph.random_affine.moments.monomials import Exponents
from heliograph.random_affine.noises.noise import AbstractNoise, Gaussian, Matrix, Number, Square, Vector

PRECISIONS = 10.0 ** (-5 + 5.7 * np.arange(25) / 24)
"""Precisions, in units of the scale's, at which Student's law is read as a mixture of Gaussian ones."""
LEAST_SHARE = 1e-12  # least probability of each precision before normalisation, so that none is excluded

Stack = Float[jax.Array | np.ndarray, "branches n n"]


class StudentT(AbstractNoise):
    """Student's t noise: Gaussian noise of covariance `scale` / l with one l of the gamma law of mean 1 for the vector.

    l is chi-squared of `degrees` nu divided by nu. Its covariance is scale nu / (nu - 2), which exists above 2 degrees;
    a filter that needs it refuses fewer. Large nu is Gaussian noise.

    Shapes: scale (n, n), or a number for one component.

    Raises:
        ValueError: a scale that is no covariance, degrees that are not positive.
    Source: Lange, Little and Taylor, Robust statistical modeling using the t distribution (1989).
    """

    scale: Square
    degrees: Float[jax.Array | np.ndarray, ""]
    mean: Vector

    def __init__(self, scale: ArrayLike, degrees: ArrayLike):
        """Hold the scale matrix and the degrees of freedom nu; the mean is zero."""
        self.scale = check.covariance("scale of Student's law", scale, _size_of_number(scale))
        self.degrees = scalar("degrees of Student's law", degrees, low=TINY)
        self.mean = np.zeros(self.scale.shape[-1])

    @property  # type: ignore[misc]
    def covariance(self) -> Square:  # type: ignore[override]
        """Covariance of the noise: the scale times nu / (nu - 2), nu its degrees of freedom.

        Raises:
            ValueError: at most 2 degrees.
        """
        nu = self.degrees
        if not is_traced(nu) and nu <= 2:
            expected = "more than 2, below which it has no covariance (robust_filter with its score update needs none)"
            raise fail("degrees of Student's law", expected, f"{float(nu):g}")
        covariance: Square = self.scale * (nu / (nu - 2))
        return covariance

    @property
    def has_outliers(self) -> bool:
        """Always True: Student's law has heavy tails."""
        return True

    @property
    def is_symmetric(self) -> bool:
        """Always True: Student's law is symmetric about 0."""
        return True

    def branches(self) -> GaussianBranches:
        """Return Student's law of each component as a mixture of Gaussian branches, one for each of the PRECISIONS l.

        A branch has the logarithm of its probability, the mean 0, and the variance scale / l. Axes: component, branch.
        """
        xp, n = library(self.degrees, self.scale), self.dimension
        shape = (n, len(PRECISIONS))
        log_shares = xp.broadcast_to(_log_or_minus_infinity(gamma_mass_of_precisions(self.degrees)), shape)
        variances = xp.diagonal(self.scale)[:, None] / PRECISIONS
        return GaussianBranches(log_shares, np.zeros(shape), variances)

    def branches_through(self, matrix: Matrix) -> GaussianBranches:
        """Return the branches of B n, Student's noise of the scale B S B' and as many degrees; `matrix`: B."""
        return StudentT(matrix @ self.scale @ matrix.T, self.degrees).branches()

    def without_outliers(self) -> NoiseWithoutOutliers:
        """Return mean 0 and the scale as covariance, which Student's noise without its heavy tails has."""
        return NoiseWithoutOutliers(np.zeros(self.dimension), self.scale)

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw Student's noise: Gaussian noise of the scale, divided by sqrt(l), where l has a gamma law of mean 1."""
        noise_key, precision_key = jax.random.split(key)
        half = jnp.asarray(self.degrees, dtype=float) / 2
        precision = jax.random.gamma(precision_key, half, dtype=float) / half
        return Gaussian(self.scale).sample(noise_key) / jnp.sqrt(precision)

    def moment(self, powers: Exponents) -> Number:
        """Return E[n^a] = E[l^(-k)] times the Gaussian moment, k = |a| / 2 and E[l^(-k)] = prod_i nu / (nu - 2 i).

        The noise is Gaussian noise divided by sqrt(l), where nu l is chi-squared of nu degrees. Odd moments are 0.

        Raises:
            ValueError: an order of at least `degrees`, whose moment does not exist.
        """
        order, nu = sum(powers), self.degrees
        if order % 2:
            return 0.0
        if not is_traced(nu) and 0 < nu <= order:
            raise fail(f"degrees of Student's law in moments of order {order}", f"more than {order}", f"{float(nu):g}")
        inverse_precision_moment = prod((plain(nu / (nu - 2 * i)) for i in range(1, order // 2 + 1)), start=1.0)
        return inverse_precision_moment * Gaussian(self.scale).moment(powers)


class Contaminated(AbstractNoise):
    """Gaussian noise with outliers: covariance R, and with probability `share` mean `bias` and `outlier_covariance`.

    Outlying branches of several kinds have a list of shares, with as many covariances (or variances) and biases. The
    covariance of the whole is sum_j p_j (R_j + m_j m_j') - m m', its mean m = sum_j p_j m_j.

    `bounded`: the share is at most this one and the outliers' second moment at most this one (`at_most`), so that the
    covariance dominates and filters claim "upper" where they else claim "exact".

    Shapes: covariance, outlier_covariance (n, n) or a number; share a number; bias a number or (n,). Of several
    kinds: share (kinds,), outlier_covariance (kinds,) or (kinds, n, n), bias (kinds,) or (kinds, n).

    Raises:
        ValueError: a share outside [0, 1] (or several whose sum is), covariances that are none, shapes that do not fit.
    Source: Tukey, A survey of sampling from contaminated distributions (1960).
    """

    shares: Vector
    means: Matrix
    covariances: Stack
    mean: Vector
    covariance: Square
    bounded: bool = eqx.field(static=True)

    def __init__(self, covariance: ArrayLike, share: ArrayLike, outlier_covariance: ArrayLike, bias: ArrayLike = 0.0):
        """Hold the Gaussian branches of the mixture: first the noise without outliers, then each kind of outlier.

        shares p_j (branches,), means m_j (branches, n), covariances R_j (branches, n, n); and of the whole the mean
        m = sum_j p_j m_j and the covariance sum_j p_j (R_j + (m_j - m) (m_j - m)').
        """
        # Shares, covariances and biases of the kinds of outliers, one each.
        inlier = check.covariance("covariance of contaminated noise", covariance, _size_of_number(covariance))
        n = inlier.shape[-1]
        outlier_shares, are_several = _read_shares(share)
        kinds = len(outlier_shares)
        outliers = _read_matrices("covariance of the outliers", outlier_covariance, kinds, are_several)
        biases = _read_matrices("bias of the outliers", bias, kinds, are_several)
        xp = library(inlier, outlier_shares, outliers, biases)
        outlier_covariances = [check.covariance("covariance of the outliers", r, n) for r in outliers]
        centers = [xp.broadcast_to(array("bias of the outliers", b, (n,) if rank("bias", b) else ()), (n,))
                   for b in biases]  # fmt: skip
        # The first branch is the noise without outliers; mean and covariance are those of the mixture.
        self.shares = xp.concatenate([xp.stack([1 - sum(outlier_shares)]), xp.stack(outlier_shares)])
        self.means = xp.stack([xp.zeros(n), *centers])
        self.covariances = xp.stack([inlier, *outlier_covariances])
        self.mean = self.shares @ self.means
        deviations = self.means - self.mean
        between = deviations[:, :, None] * deviations[:, None]
        second = self.covariances + between
        self.covariance = xp.einsum("j,jab->ab", self.shares, second)
        self.bounded = False

    @classmethod
    def one_sided(cls, covariance: ArrayLike, share: ArrayLike, mean: ArrayLike, slices: int = 6) -> "Contaminated":
        """Return the Gaussian noise to which, with probability `share`, an exponential delay of this mean is added.

        The exponential law is cut into `slices` parts of equal probability, and each becomes a Gaussian of its mean and
        variance, so that filters see a mixture of Gaussians with the law's own mean and variance.

        Args:
            covariance: covariance of the Gaussian noise (m, m), or a variance.
            share: probability of a delay.
            mean: mean of the delay, a number or one for each component, of either sign.
            slices: number of parts.

        Raises:
            ValueError: a matrix that is no covariance, a share outside [0, 1], a mean of the wrong shape, no slice.
        """
        count = check_count("slices of an exponential bias", slices)
        inlier = check.covariance("covariance of contaminated noise", covariance, _size_of_number(covariance))
        n = inlier.shape[-1]
        factor = array("mean of the exponential bias", mean, (n,) if rank("mean", mean) else ())
        slice_means, slice_variances = _slice_exponential(count)
        xp = library(factor, inlier, share)
        direction = xp.broadcast_to(factor, (n,))
        slice_share = scalar("share of outliers", share, low=0.0, high=1.0) / count
        # A slice adds its mean to the noise, and its variance along `direction` to the covariance.
        covariances = [inlier + v * xp.outer(direction, direction) for v in slice_variances]
        return cls(
            inlier,
            xp.stack([slice_share] * count),
            xp.stack(covariances),
            xp.stack([m * direction for m in slice_means]),
        )

    @classmethod
    def at_most(cls, covariance: ArrayLike, share: ArrayLike, outlier_second_moment: ArrayLike) -> "Contaminated":
        """Return zero-mean noise known by bounds: at most this share of outliers, E[o o'] at most this matrix.

        With R = `covariance` (without outliers), G = `outlier_second_moment` and e = `share`, (1 - e) R + e G is above
        the covariance for every share up to e, since G >= R.

        Raises:
            ValueError: as for the class; a second moment of outliers that does not dominate the covariance.
        """
        law = cls(covariance, share, outlier_second_moment)
        if not is_traced(law.covariances):
            smallest = np.min(np.linalg.eigvalsh(law.covariances[1] - law.covariances[0]))
            if smallest < -1e-10 * np.max(np.abs(law.covariances[1])):
                raise fail("second moment of the outliers", "one that is at least the covariance of the others",
                           f"a difference with eigenvalue {smallest:.3g}")  # fmt: skip
        object.__setattr__(law, "bounded", True)
        return law

    @property
    def has_outliers(self) -> bool:
        """Always True: each vector is an outlier with a probability."""
        return True

    @property
    def is_symmetric(self) -> bool:
        """True if all branches, with and without outliers, have the mean 0."""
        return not np.any(np.asarray(self.means) != 0)

    def branches(self) -> GaussianBranches:
        """Return each component as a mixture of Gaussian branches about the noise's mean: without and with outliers.

        By component and branch: logarithm of the probability, mean and variance.
        """
        return self._list_branches(self.means - self.mean, self.covariances)

    def branches_through(self, matrix: Matrix) -> GaussianBranches:
        """Return the branches of each component of B n, about its mean: those of n, mapped; `matrix`: B."""
        return self._list_branches((self.means - self.mean) @ matrix.T, matrix @ self.covariances @ matrix.T)

    def _list_branches(self, means: Matrix, covariances: Stack) -> GaussianBranches:
        """Return each component's branches from their means (branches, n), about the mean of all, and covariances."""
        xp, n = library(self.shares), means.shape[1]
        log_shares = xp.broadcast_to(_log_or_minus_infinity(self.shares), (n, len(self.shares)))
        variances = xp.diagonal(covariances, axis1=1, axis2=2).T
        return GaussianBranches(log_shares, means.T, variances)

    def without_outliers(self) -> NoiseWithoutOutliers:
        """Return the mean and covariance of the first branch: the noise without outliers."""
        return NoiseWithoutOutliers(self.means[0] - self.mean, self.covariances[0])

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw a branch by the shares, without or with outliers, and return noise from its Gaussian law."""
        branch_key, noise_key = jax.random.split(key)
        branch = draw_index(self.shares, branch_key)
        laws = [Gaussian(covariance, mean) for covariance, mean in zip(self.covariances, self.means, strict=True)]
        samples = jnp.stack([law.sample(noise_key) for law in laws])
        return samples[branch]

    def moment(self, powers: Exponents) -> Number:
        """Return E[n^a] = sum_j p_j E_j[n^a], a mean over the Gaussian branches j; `powers` are the exponents a."""
        items = zip(self.shares, self.covariances, self.means, strict=True)
        return sum((plain(p) * Gaussian(r, m).moment(powers) for p, r, m in items), start=0.0)


def gamma_mass_of_precisions(degrees: ArrayLike) -> Vector:
    """Return the probabilities with which Gaussian laws of variance scale / l, l in PRECISIONS, make up Student's law.

    The precision l has a gamma law of mean 1: a chi-squared variable divided by its degrees of freedom. The probability
    of one of the PRECISIONS is the mass of l between the geometric means with its neighbours, raised to LEAST_SHARE if
    it is less; then all are divided by their sum.
    """
    xp: Any = library(degrees)
    half_degrees = xp.asarray(degrees) / 2
    edges = np.sqrt(PRECISIONS[1:] * PRECISIONS[:-1])
    mass_below = scipy_for(degrees).special.gammainc(xp.broadcast_to(half_degrees, edges.shape), edges * half_degrees)
    masses = xp.diff(xp.concatenate([np.zeros(1), mass_below, np.ones(1)]))
    masses = xp.maximum(masses, LEAST_SHARE)
    shares: Vector = masses / xp.sum(masses)
    return shares


def has_bounded_noise(*parts: PyTree) -> bool:
    """Return whether some noise in these parts of a network is known only by a bound of its covariance.

    Only `Contaminated` noise can be, with a bound of the share of outliers.
    """

    def is_law(leaf: object) -> bool:
        """Return whether a leaf is a noise law that may be a bound."""
        return isinstance(leaf, Contaminated)

    return any(leaf.bounded for leaf in jax.tree.leaves(parts, is_leaf=is_law) if is_law(leaf))


def _size_of_number(value: ArrayLike) -> int | None:
    """Return 1 for a number, which is a covariance (1, 1); None for a matrix, whose size is its own."""
    return None if rank("covariance", value) else 1


def _read_shares(share: ArrayLike) -> tuple[list[Number], bool]:
    """Return the probabilities of the kinds of outliers, and whether a list of them was given.

    A single number is one kind. The noise is without outliers with the probability that is left to 1.
    """
    if not rank("share of outliers", share):
        return [scalar("share of outliers", share, low=0.0, high=1.0)], False
    values = array("shares of outliers", share, ("kinds",))
    if not len(values):
        raise fail("shares of outliers", "at least one", "none")
    total = sum(scalar("share of outliers", value, low=0.0, high=1.0) for value in values)
    if not is_traced(total):
        scalar("sum of the shares of outliers", total, low=0.0, high=1.0 + 1e-12)  # raises where it is above 1
    return list(values), True


def _read_matrices(name: str, value: ArrayLike, count: int, several: bool) -> list[ArrayLike]:
    """Return one mean or covariance for each kind of outlier; raise ValueError if their number is wrong.

    `several` says whether a list of kinds was given. A number then stands for every kind.
    """
    if not several:
        return [value]
    if not rank(name, value):
        return [value] * count
    values: list[ArrayLike] = list(cast(Sequence[ArrayLike], value))
    if len(values) != count:
        raise fail(name, f"one for each of the {count} shares", len(values))
    return values


def _slice_exponential(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance of the exponential law of mean 1 in each of `count` slices of equal probability.

    The survival function S goes from 1 to 0, and t = -log S. The moments are the integrals of t and t^2 over a slice of
    S, times count.
    """
    survival = 1 - np.arange(count + 1) / count  # at the slices' ends; at 0 the logarithm is multiplied by 0
    time = -np.log(np.where(survival > 0, survival, 1.0))
    mean = count * -np.diff(survival * (time + 1))
    mean_square = count * -np.diff(survival * (time**2 + 2 * time + 2))
    return mean, mean_square - mean**2


def _log_or_minus_infinity(value: Vector) -> Vector:
    """Return the logarithms of NumPy or JAX (traced) numbers; that of zero is -inf, without a warning."""
    if is_traced(value):
        return jnp.log(value)
    with np.errstate(divide="ignore"):
        logarithm: Vector = np.log(np.maximum(value, 0.0))
    return logarithm
