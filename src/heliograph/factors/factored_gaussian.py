"""A Gaussian by its mean and the factors L diag(d) L' of its covariance, and the operations that filters are made of.

With x = m + L xi, xi uncorrelated with variances d, everything is said by slopes in xi: of F x they are F L, of a
measurement H x they are H L. Sums of independent terms are columns side by side (`covariance_factors.py`). No operation
takes the difference of two variances, and none has a branch: a component of variance zero has a reciprocal of zero.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from heliograph.factors.covariance_factors import (
    WeightedColumns,
    add_columns_to_factors,
    below_diagonal,
    decorrelate,
    eliminate,
    factor_known_covariance,
    join_columns,
    triangularise,
    unit_lower,
    zero_covariance,
)
from heliograph.factors.noise_columns import measure_beside_noises, measure_uncorrelated
from heliograph.factors.pivots import reciprocal_or_one, reciprocal_or_zero, rounding_of_pivots
from heliograph.factors.repeated_measurements import rounding_of_slopes, triangularise_noise
from heliograph.factors.scalar_update import (
    update_by_parts,
    update_by_row,
    update_root_columns,
)
from heliograph.numerics.gaussian_density import LOG_TURN
from heliograph.numerics.linalg import OFF_SUPPORT, OFF_VALUE, PIVOT_TOLERANCE, rounding, symmetric, where
from heliograph.numerics.numpy_or_jax import is_traced, library
from heliograph.numerics.trace_settings import writes_for_derivatives, writes_short_programs
from heliograph.numerics.types import Array, Float


class Gaussian(NamedTuple):
    """Mean m and covariance L diag(d) L'.

    Shapes: mean (n,), lower (n (n - 1) / 2,) the entries of L below its diagonal row by row, variances d (n,); leading
    axes for several.
    """

    mean: Float[jax.Array, "... n"]
    lower: Float[jax.Array, "... entries"]
    variances: Float[jax.Array, "... n"]

    @property
    def root(self) -> Any:
        """L (..., n, n), NumPy's or JAX's as the entries are."""
        return unit_lower(self.lower)

    @property
    def columns(self) -> WeightedColumns:
        """Covariance as the columns of L with weights d."""
        return WeightedColumns(self.root, self.variances)

    @property
    def covariance(self) -> Any:
        """The covariance L diag(d) L' (..., n, n), exactly symmetric since its upper triangle is mirrored."""
        xp = library(self)
        root, variances = (xp.asarray(factor) for factor in (self.root, self.variances))
        product = (root * variances[..., None, :]) @ xp.swapaxes(root, -1, -2)
        upper = np.triu(np.ones(product.shape[-2:], bool))
        choose: Any = np.where if xp is np else where  # of known numbers, and of traced ones
        return choose(upper, product, xp.swapaxes(product, -1, -2))


def from_columns(mean: jax.Array, columns: WeightedColumns) -> Gaussian:
    """Return the Gaussian of this mean (n,) and the covariance W diag(w) W' given by its columns W and weights w.

    The rows of W are made orthogonal (Gram-Schmidt), and W diag(w) W' is never formed: exact to eps^2.
    """
    factors = triangularise(columns)
    return Gaussian(mean, below_diagonal(factors.matrix), factors.weights)


def from_summed_covariance(mean: jax.Array, *covariances: WeightedColumns) -> Gaussian:
    """Return the Gaussian whose covariance is the sum of these, each given by its columns W diag(w) W'.

    The sum is formed as a matrix and factored by elimination: faster than making rows orthogonal, and less exact.
    """
    covariance = covariances[0].covariance
    for columns in covariances[1:]:
        covariance = covariance + columns.covariance
    return from_covariance_by_elimination(mean, covariance)


def from_covariance_by_elimination(mean: jax.Array, covariance: jax.Array) -> Gaussian:
    """Return the Gaussian of this mean (n,) and covariance P (n, n), factored by elimination.

    Rounding may make a pivot too small or negative: each is raised to at least n eps P_jj. P must have been computed as
    a sum of squares, so that no more than rounding is wrong with it.
    """
    factors = eliminate(covariance, rounding_of_pivots(covariance))
    return Gaussian(mean, below_diagonal(factors.matrix), factors.weights)


def from_covariance(mean: Array, covariance: Array) -> Gaussian:
    """Return the Gaussian of a covariance matrix that a user gave, with each variance exact to n eps of itself.

    A NumPy matrix is known, and is factored at once by NumPy. Any other is factored by elimination in JAX.
    """
    if isinstance(covariance, np.ndarray):
        factors: Any = (mean if is_traced(mean) else np.asarray(mean), *factor_known_covariance(covariance))
        return Gaussian(*factors)
    columns = eliminate(jnp.asarray(covariance), rounding_of_pivots(covariance))
    return Gaussian(jnp.asarray(mean), below_diagonal(columns.matrix), columns.weights)


def predict_affine(x: Gaussian, matrix: Any, offset: Array, noise: WeightedColumns) -> Gaussian:
    """Predict x over x+ = F x + b + w: mean F m + b, covariance F L diag(d) (F L)' + Cov w.

    x has the mean m and covariance L diag(d) L'. F is `matrix`, b is `offset`, and `noise` holds columns of Cov w.
    """
    of_state = WeightedColumns(matrix @ x.root, x.variances)
    return from_columns(jnp.asarray(matrix @ x.mean + offset), join_columns(of_state, noise))


class Image(NamedTuple):
    """f(x) of x = m + L xi by its second moments: f(x) = mean + S xi + c, where c is uncorrelated with xi.

    `explained` is the covariance S diag(d) S'. Column j of its matrix is S_j unit_j, the change of f while xi_j changes
    by `unit`_j: a transform by points finds these differences directly. `curvature` is Cov c.

    Shapes: mean (p,), explained (p, n), unit (n,), curvature (p, columns).
    """

    mean: Float[jax.Array, " p"]
    explained: WeightedColumns
    unit: Float[Array, " n"]
    curvature: WeightedColumns

    @property
    def slopes(self) -> jax.Array:
        """Slopes S = df/dxi (p, n): columns of `explained` over `unit`; 0 where unit_j is 0, as xi_j is known then."""
        return jnp.asarray(self.explained.matrix * reciprocal_or_zero(jnp.asarray(self.unit)))

    @property
    def columns(self) -> WeightedColumns:
        """Covariance of f(x): the columns of S diag(d) S' and of Cov c side by side."""
        return join_columns(self.explained, self.curvature)


def image_by_slopes(mean: jax.Array, slopes: jax.Array, x: Gaussian, curvature: WeightedColumns | None = None) -> Image:
    """Return the moments of f(x) = mean + slopes xi + c for x = m + L xi, as an `Image`.

    Slopes are in xi itself, so that the image's unit of each xi_j is 1. Shapes: mean (p,), slopes (p, n).

    Args:
        mean: E f(x).
        slopes: df/dxi; of an affine f(x) = F x + b they are F L.
        x: the Gaussian of x, with the variances of xi.
        curvature: columns of Cov c, the part of f that is uncorrelated with xi; None if f is affine.
    """
    curvature = zero_covariance(len(mean)) if curvature is None else curvature
    return Image(mean, WeightedColumns(slopes, x.variances), np.ones(len(x.mean)), curvature)


def append_rows(x: Gaussian, mean: jax.Array, slopes: jax.Array, noise: WeightedColumns) -> Gaussian:
    """Return the law of (x, t) with t = mean + slopes xi + v: its factors are [[L, 0], [slopes, N]] and (d, r).

    x = m + L xi, with uncorrelated xi of variances d. `noise` holds the factors N diag(r) N' of Cov v. Shapes: mean
    (m,), slopes (m, n), noise (m, m).
    """
    top = jnp.pad(x.root, ((0, 0), (0, len(mean))))
    root = jnp.concatenate([top, jnp.concatenate([slopes, noise.matrix], axis=1)])
    variances = jnp.concatenate([x.variances, noise.weights])
    return Gaussian(jnp.concatenate([x.mean, mean]), below_diagonal(root), variances)


def take_leading(x: Gaussian, n: int) -> Gaussian:
    """Return the Gaussian of the first n components alone, whose factors are the first n rows and columns of L.

    The entries of L below the diagonal are stored row by row, so that those of the first rows come first.
    """
    return Gaussian(x.mean[..., :n], x.lower[..., : n * (n - 1) // 2], x.variances[..., :n])


def sum_unexplained(image: Image, noise: WeightedColumns) -> WeightedColumns:
    """Return n columns of Cov(c + w), where f(x) + w = mean + S xi + c + w has the linear part S xi in x = m + L xi.

    It is the part of Cov(f(x) + w) that the slopes S do not explain. `image` has columns of Cov c (its curvature), and
    `noise` the factors of Cov w. Of a function without curvature it is the noise alone.
    """
    return from_summed_covariance(image.mean, image.curvature, noise).columns if len(image.curvature.weights) else noise


def add_noise_to_image(image: Image, noise: WeightedColumns) -> Gaussian:
    """Return the Gaussian of f(x) + w: mean of f(x), covariance slopes diag(d) slopes' + curvature + Cov w.

    `image` has the mean, the columns of the slopes (`explained`) and the columns that f's curvature adds. `noise` holds
    factors of Cov w, with L unit lower. Columns are made orthogonal and never summed to a matrix: where x is strongly
    correlated, the sum would round away the differences that a precise measurement can see.
    """
    if writes_short_programs():
        factors = add_columns_to_factors(noise, image.columns)
        return Gaussian(image.mean, below_diagonal(factors.matrix), factors.weights)
    return from_columns(image.mean, join_columns(image.explained, sum_unexplained(image, noise)))


class Innovations(NamedTuple):
    """Innovations of a measurement's components, each given those before it: uncorrelated; 0 of what did not arrive.

    value (m,), variance (m,), and whole (m,): the variance of the component by itself.
    """

    value: Float[jax.Array, " m"]
    variance: Float[jax.Array, " m"]
    whole: Float[jax.Array, " m"]

    @property
    def determined(self) -> jax.Array:
        """Return which components (m,) those before them determine: their innovation has no variance but rounding."""
        return self.variance <= rounding(PIVOT_TOLERANCE, self.variance) * self.whole

    def log_density(self, present: jax.Array, size: jax.Array) -> jax.Array:
        """Return log N of what arrived: sum_j -(e_j^2 / s_j + log 2 pi s_j) / 2.

        e (`value`) are the innovations and s (`variance`) their variances, each given those before it. `present` (m,)
        says what arrived. If those before j determine component j, s_j is 0 up to rounding. It then adds 0 if it agrees
        with them, and -inf if not. `size` (m,) is the size of the terms whose difference is the innovation.
        """
        determined = self.determined
        variance = where(determined, 1.0, self.variance)
        density = -(self.value**2 * (1 / variance) + jnp.log(variance) + LOG_TURN) / 2
        # It agrees up to rounding: shares of its deviation by itself (`whole` is the variance), and of the terms.
        tolerance = OFF_SUPPORT * jnp.sqrt(self.whole) + OFF_VALUE * size
        log_agreement = where(lax.abs(self.value) <= tolerance, lax.full_like(self.value, 0.0), -jnp.inf)
        return jnp.sum(where(present, where(determined, log_agreement, density), 0.0))


def condition_on_observation(
    x: Gaussian, slopes: jax.Array, innovation: jax.Array, noise: WeightedColumns, present: jax.Array | None = None
) -> tuple[Gaussian, Innovations]:
    """Condition x = m + L xi on z = E z + slopes xi + v, given z - E z.

    Component after component of N^-1 z, where Cov v = N diag(r) N': their noises are uncorrelated. Shapes: slopes
    (m, n), innovation (m,), noise (m, columns), present (m,): which components arrived, by default those whose
    innovation is a number.
    """
    n = len(x.mean)
    present = ~jnp.isnan(innovation) if present is None else present
    # Cov v = N diag(r) N'. A component that did not arrive is a row of zeros with the noise variance 1.
    factors = triangularise_noise(WeightedColumns(where(present[:, None], noise.matrix, 0.0), noise.weights))
    rows = jnp.concatenate([slopes, where(present, innovation, 0.0)[:, None]], axis=1)
    rows = where(present[:, None], rows, 0.0)
    whole = rows[:, :n] ** 2 @ x.variances + factors.matrix**2 @ factors.weights
    rounding_variance = rounding_of_slopes(n, factors.matrix, whole)
    measure = measure_beside_noises if writes_for_derivatives() else measure_uncorrelated
    root, d, means, values, variances = measure(x.root, x.variances, x.mean, rows, factors, present, rounding_variance)
    return Gaussian(means[:n], below_diagonal(root[:n]), d), Innovations(values, variances, whole)


def gain_of(x: Gaussian, slopes: jax.Array, noise: WeightedColumns) -> jax.Array:
    """Return Kalman's gain K (n, m) of a measurement z = E z + slopes xi + v of x = m + L xi.

    `x` has the mean m, the factor L (`root`) and the variances d of xi; `slopes` is (m, n). `noise` has the factors
    N diag(r) N' of Cov v, N unit lower triangular. The components of N^-1 z have uncorrelated noises, and are measured
    one after another. Their innovations e, each given those before it, satisfy N^-1 (z - E z) = V e with a unit lower
    triangular V. If component j moves the mean by k_j e_j, K (z - E z) = [k_1 ... k_m] e: K = [k_1 ... k_m] V^-1 N^-1.
    """
    n, rows = len(x.mean), decorrelate(noise.matrix, slopes)
    weights = jnp.asarray(noise.weights)
    rounding_variance = rounding_of_slopes(n, noise.matrix, slopes**2 @ x.variances + noise.matrix**2 @ weights)

    def measure_part(
        i: int | jax.Array, root: jax.Array, d: jax.Array, rounding: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Measure component i, of noise `weights[i]`: return the rows and variances after it, and its gain.

        `root` has the components' rows below the n of the state, and so has the gain.
        """
        root, d, gain, _ = update_by_row(root, d, root[n + i], weights[i], rounding)
        return root, d, gain

    *_, gains = update_by_parts(measure_part, jnp.concatenate([x.root, rows]), x.variances, rounding_variance)
    # Rows above n of the gains are k_j. Below, column j says how e_j enters the components after it: column j of V.
    innovation_factor = unit_lower(below_diagonal(gains[n:]))
    return gains[:n] @ decorrelate(innovation_factor, decorrelate(noise.matrix, jnp.eye(len(rows))))


def correct_by_gain(
    x: Gaussian, slopes: jax.Array, noise: WeightedColumns, gain: jax.Array, innovation: jax.Array
) -> Gaussian:
    """Correct x = m + L xi by any gain K of e = slopes xi + v: mean m + K e, error (L - K slopes) xi - K v.

    The covariance is (L - K slopes) diag(d) (L - K slopes)' + K Cov(v) K', a sum of squares (Joseph's form) that is
    right for any gain K, also one that is not Kalman's.

    Args:
        x: the prior of n states, with Cov xi = diag(d).
        slopes: of the measurement in xi (m, n).
        noise: columns of Cov v.
        gain: K (n, m).
        innovation: e (m,).
    """
    error = WeightedColumns(x.root - gain @ slopes, x.variances)
    return from_columns(x.mean + gain @ innovation, join_columns(error, noise.through(gain)))


def impose_moments_of_combination(x: Gaussian, row: jax.Array, shift: jax.Array, ratio: jax.Array) -> Gaussian:
    """Give t = E t + row xi, a combination of x = m + L xi, another mean and variance, and correct x by it.

    The mean of t moves by `shift`. Its variance V = row diag(d) row' becomes `ratio` times V. The law of x given t
    stays, so x gets the mean m + K shift and the covariance P - (1 - ratio) K V K', with K = Cov(x, t) / V.

    The factors follow from s_j = ratio sum_{k < j} f_k^2 d_k + sum_{k >= j} f_k^2 d_k, with f = row:
    d_j+ = d_j s_{j+1} / s_j and L_j+ = L_j - (1 - ratio) (f_j / s_{j+1}) sum_{k > j} d_k f_k L_k. All s_j are sums of
    positive terms, for a ratio below 1 and above. Where V is 0, x stays as it is.

    Shapes: row (n,), shift and ratio () and ratio >= 0.

    Source: Agee and Turner, Triangular decomposition of a positive definite matrix plus a symmetric dyad (1972), with
    the sums of an observation of ratio r / (V + r).
    """
    product = x.variances * row
    power = row * product
    sums_before = jnp.append(0.0, lax.cumsum(power))
    s = ratio * sums_before + jnp.append(lax.cumsum(power, reverse=True), 0.0)
    root, variances, gain_times_variance = update_root_columns(x.root, x.variances, product, (1 - ratio) * row, s)
    return Gaussian(x.mean + gain_times_variance * (reciprocal_or_one(s[0]) * shift), below_diagonal(root), variances)


def moments_of_mixture(
    means: Float[jax.Array, "parts n"], covariances: Float[jax.Array, "parts n n"], weights: Float[jax.Array, " parts"]
) -> tuple[jax.Array, jax.Array]:
    """Return the mean m = sum_i w_i m_i (n,) and covariance sum_i w_i (P_i + (m_i - m)(m_i - m)') (n, n) of a mixture.

    Means are counted from the first one, so that equal means, however large, have differences of exactly 0. The weights
    w sum to 1.
    """
    about_first = means - means[0]
    shift = weights @ about_first
    within = jnp.reshape(weights @ covariances.reshape(len(weights), -1), covariances.shape[1:])
    between = WeightedColumns((about_first - shift).T, weights).covariance
    return means[0] + shift, symmetric(within + between)


def merge_mixture(parts: Gaussian, weights: Float[jax.Array, " parts"]) -> Gaussian:
    """Return the one Gaussian that has the mean and covariance of a mixture of Gaussians.

    `parts` are the Gaussians of the mixture, with a leading axis, and `weights` their probabilities, of sum 1.
    """
    return from_covariance_by_elimination(*moments_of_mixture(parts.mean, parts.covariance, weights))
