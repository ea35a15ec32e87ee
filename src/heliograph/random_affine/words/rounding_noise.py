"""Noise of a measurement that is rounded to steps: the sensor's own, and the error of rounding, by the dither."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, join_columns
from heliograph.numerics.check import fail
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Float, PyTree
from heliograph.random_affine.moments.mixture_components import GaussianBranches, NoiseWithoutOutliers, SignalNoise
from heliograph.random_affine.moments.monomials import Exponents
from heliograph.random_affine.noises.noise import AbstractNoise, Gaussian, Number, Square, Vector

TERMS = 32  # terms of the series of E f(1 - f) that are summed; a bound of the others is added
DITHERLESS = 1 - 1e-9  # variance of Gaussian noise, in squared steps, from which on rounding needs no other dither


class RoundingError(NamedTuple):
    """Variances of q - y (less a dither that is taken off) and of q - y itself, in steps squared."""

    error: float
    whole: float


LARGEST = {  # by dither, the largest variances that the rounding error may have, whatever y is
    "none": RoundingError(1 / 12, 1 / 12),  # of a y whose density is flat over a step
    "triangular": RoundingError(1 / 4, 1 / 4),
    "stochastic": RoundingError(1 / 4, 1 / 4),
    "subtracted": RoundingError(1 / 12, 1 / 4),
}


class RoundedNoise(AbstractNoise):
    """Noise v + e of a measurement y that is rounded to steps of D: v the sensor's, e the error of rounding.

    Of the signal y - `centre`: its mean is E v - centre. By the dither, with f the place of y between two steps,
    "triangular" Var e = D^2/4; "stochastic" D^2 E f(1 - f), at most D^2/4; "subtracted" D^2/12, and with the dither
    D^2 E f(1 - f); "none" D^2/12, which holds where v is Gaussian with a deviation of a step or more.

    Args:
        source: law of v.
        step: D of each component.
        half: half the range, so that y = centre - half lies on a step.
        centre: taken off y.
        dither: how y was dithered.
        gaussian: True if y is Gaussian, so that E f(1 - f) is known by its moments; False if D^2/4 bounds it.
        matters: True if the second moment of the rounded signal enters what is claimed, as behind a random gain.
    """

    source: AbstractNoise
    step: Vector
    half: Vector
    centre: Vector
    dither: str = eqx.field(static=True)
    gaussian: bool = eqx.field(static=True)
    matters: bool = eqx.field(static=True)

    def __init__(
        self,
        source: AbstractNoise,
        step: Vector,
        half: Vector,
        centre: Vector,
        dither: str,
        gaussian: bool = False,
        matters: bool = False,
    ):
        """Hold the law of the sensor's noise v (`source`) and the rounding of its measurement y.

        By component: the `step` D, `half` the range of the steps, and their `centre`. `dither` names what is added to y
        before rounding. `gaussian`: y is Gaussian, so that its moments give the variance of the rounding error.
        `matters`: the claim on the covariance depends on the second moment of the rounded signal.
        """
        self.source, self.step, self.half, self.centre = source, step, half, centre
        self.dither, self.gaussian, self.matters = dither, gaussian, matters

    @property  # type: ignore[misc]
    def mean(self) -> Vector:  # type: ignore[override]
        """Mean E[v] - c of the noise in q - c, q the rounded measurement and c the centre of the steps."""
        mean: Vector = self.source.mean - self.centre
        return mean

    @property  # type: ignore[misc]
    def covariance(self) -> Square:  # type: ignore[override]
        """Cov(v) + k diag(D^2), where k D^2 is the largest variance that the rounding error e may have for any y.

        v is the sensor's noise, D the step, and k = LARGEST[dither].error, which is 1/12 or 1/4 by the dither.
        """
        covariance: Square = self.source.covariance + LARGEST[self.dither].error * self._squares()
        return covariance

    @property
    def columns(self) -> WeightedColumns:
        """Covariance as weighted columns: those of the sensor's noise v, then those of the rounding error e."""
        return self._with_error(LARGEST[self.dither].error * self.step**2)

    @property
    def has_outliers(self) -> bool:
        """True if the law of the sensor's noise v has outliers; the rounding error, within a step, has none."""
        return self.source.has_outliers

    @property
    def is_exact(self) -> bool:
        """True if the covariance of the noise is exact: the rounding error e has mean 0 for every y, and known moments.

        By the dither, D the step and f the fraction of a step by which y lies above the next step below:
        - "triangular": Var e = D^2/4 for every y.
        - "stochastic": Var e = D^2 E f(1 - f), which is known if y is Gaussian (`gaussian`).
        - "subtracted": Var e = D^2/12 for every y. The second moment of the rounded signal, dither included, has
          D^2 E f(1 - f). Where the claim depends on it (`matters`), as behind a random gain, y must be Gaussian.
        - "none": Var e = D^2/12 if the noise v is Gaussian and wide enough to act as a dither.
        """
        match self.dither:
            case "triangular":
                return True
            case "stochastic":
                return self.gaussian
            case "subtracted":
                return self.gaussian or not self.matters
        return self._dithers_itself

    @property
    def is_bounded(self) -> bool:
        """True if the covariance of the noise is an upper bound and not exact.

        The rounding error e then has mean 0 for every y, and `covariance` has the largest variance that e may have.
        """
        return not self.is_exact and self.dither in ("stochastic", "subtracted")

    @property
    def _dithers_itself(self) -> bool:
        """True if the sensor's noise v is Gaussian with a deviation of a step or more in every direction."""
        if not isinstance(self.source, Gaussian):
            return False
        step = np.asarray(self.step)
        # The covariance in units of steps. DITHERLESS is 1 less rounding.
        unit = np.asarray(self.source.covariance) / (step[..., :, None] * step[..., None, :])
        return bool(np.all(np.linalg.eigvalsh(unit)[..., 0] >= DITHERLESS))

    def given_signal(self, mean: Vector, variances: Vector) -> SignalNoise:
        """Return the noise v + e of a rounded measurement, v the sensor's noise, for a signal of these moments.

        Two covariances are returned. That of what a receiver does not know, as `columns`: a dither that it subtracts
        does not count. And that of all that is added to the signal, as `covariance`: this includes the dither.

        If y is Gaussian, the dither and e together have the variance D^2 E f(1 - f), D the step and f the fraction of a
        step by which y lies above the next step below. Else the largest variance for any y is taken.

        Args:
            mean: mean of the signal (dimension,).
            variances: variances of the signal (dimension,), without the noise v.
        """
        largest = LARGEST[self.dither]  # variances in squared steps: `error` without a subtracted dither, `whole` with
        if self.dither not in ("stochastic", "subtracted") or not self.gaussian:
            covariance = self.source.covariance + largest.whole * self._squares()
            return SignalNoise(self.columns, covariance)
        whole = self._bound_rounding(mean, variances + jnp.diagonal(jnp.asarray(self.source.covariance)))
        error = largest.error if self.dither == "subtracted" else whole
        covariance = jnp.asarray(self.source.covariance) + jnp.diag(whole * jnp.asarray(self.step) ** 2)
        return SignalNoise(self._with_error(error * self.step**2), covariance)

    def _bound_rounding(self, mean: Vector, variances: Vector) -> jax.Array:
        """Return an upper bound of E f (1 - f), with f in [0, 1] the place of y ~ N(m, s^2) between two words.

        Words are D apart, and dithered rounding has the variance D^2 f (1 - f). With the lowest word `low`,
        E f (1 - f) = 1/6 - sum_k exp(-2 pi^2 k^2 s^2 / D^2) cos(2 pi k (m - low) / D) / (pi k)^2. The series is cut
        after K = TERMS terms, and a bound of its tail is added, by sum_{k > K} 1 / (pi k)^2 <= 1 / (pi^2 K).
        """
        k = np.arange(1, TERMS + 1)[:, None]
        relative_variance = jnp.asarray(variances) / jnp.asarray(self.step) ** 2
        place = (jnp.asarray(mean) + jnp.asarray(self.half)) / jnp.asarray(self.step)
        place = place - jnp.floor(place)
        damped = jnp.exp(-2 * np.pi**2 * k**2 * relative_variance) / (np.pi * k) ** 2
        tail = jnp.exp(-2 * np.pi**2 * TERMS**2 * relative_variance) / (np.pi**2 * TERMS)
        bound = 1 / 6 - jnp.sum(damped * jnp.cos(2 * np.pi * k * place), axis=0) + tail
        return jnp.clip(bound, 0.0, 0.25)

    def _squares(self) -> Square:
        """Return diag(D^2), the squares of the steps D of rounding on a diagonal."""
        xp = library(self.step)
        squares: Square = xp.asarray(self.step)[..., :, None] ** 2 * np.eye(self.dimension)
        return squares

    @property
    def dimension(self) -> int:
        """Length of v."""
        return self.source.dimension

    def _with_error(self, variances: Vector) -> WeightedColumns:
        """Return the columns of v, then those of independent rounding errors of these variances."""
        return join_columns(self.source.columns, WeightedColumns(np.eye(self.dimension), variances))

    def branches(self) -> GaussianBranches:
        """Return each component of v + e as a mixture of Gaussian branches about its mean.

        They are those of the sensor's noise v, each with the largest variance of the rounding error e added.
        """
        branches = self.source.branches()
        error_variance = LARGEST[self.dither].error * self.step**2
        return branches._replace(variance=branches.variance + error_variance[:, None])

    def without_outliers(self) -> NoiseWithoutOutliers:
        """Return mean and covariance of v + e if the sensor's noise v is no outlier; e has its largest variance."""
        inlier = self.source.without_outliers()
        return inlier._replace(covariance=inlier.covariance + LARGEST[self.dither].error * self._squares())

    def report(self, y: jax.Array) -> jax.Array:
        """Return each component of the measurement y (dimension,) rounded to the nearest step, which is reported.

        Steps are low, low + D, low + 2 D, ..., D = `step`, where the lowest is low = centre - half.
        """
        low = jnp.asarray(self.centre) - jnp.asarray(self.half)
        return low + jnp.asarray(self.step) * jnp.floor((y - low) / jnp.asarray(self.step) + 0.5)

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw v - centre, v the sensor's noise: the sensor or encoder rounds y itself, so that e is not drawn."""
        return self.source.sample(key) - jnp.asarray(self.centre)

    def moment(self, powers: Exponents) -> Number:
        """Return the mean or second moment of the components that the powers select.

        Raises:
            ValueError: a third or higher moment, which would depend on the signal.
        """
        if sum(powers) > 2:
            raise fail("noise of a rounded measurement", "a filter of means and covariances (linear_filter)", "another")
        components = [i for i, power in enumerate(powers) for _ in range(power)]
        means = [self.mean[i] for i in components]
        if len(components) < 2:
            return means[0] if means else 1.0
        return means[0] * means[1] + self.covariance[components[0], components[1]]


def find_rounded_noises(*models: PyTree) -> Sequence[RoundedNoise]:
    """Return every `RoundedNoise` inside these models, at any depth."""
    leaves = jax.tree.leaves(models, is_leaf=lambda leaf: isinstance(leaf, RoundedNoise))
    return [leaf for leaf in leaves if isinstance(leaf, RoundedNoise)]


def round_without_dither(noise: AbstractNoise, resolution: Float[np.ndarray, " m"]) -> RoundedNoise:
    """Return the noise of a sensor that reports the nearest multiple of its resolution (m,) to its measurement."""
    zero = np.zeros(noise.dimension)
    return RoundedNoise(noise, resolution, zero, zero, "none")
