"""Gaussians of which some directions are unknown: the limit of P + kappa P_inf, by factors of two levels.

One unit lower L, each of whose columns has an infinite weight (d_inf) or a finite one (d). Beside an infinite weight a
finite one vanishes in the limit, so that this is exact. An operation is the one of `factored_gaussian.py` where no
column is infinite.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, below_diagonal, decorrelate, unit_lower
from heliograph.factors.factored_gaussian import Gaussian
from heliograph.factors.pivots import reciprocal_or_zero
from heliograph.factors.repeated_measurements import triangularise_noise
from heliograph.factors.state_given_next import BackwardGain
from heliograph.numerics.gaussian_density import LOG_TURN
from heliograph.numerics.trace_settings import writes_for_derivatives
from heliograph.numerics.types import Float

FALLEN = 1e-12  # a row's square in the infinite columns below this share of its first value is rounding
DEAF = 1e-9  # if |h'L_j| is below this share of |h|'|L_j|, the measurement h'x does not depend on direction j


class Diffuse(NamedTuple):
    """Mean m and covariance L (diag(d) + kappa diag(d_inf)) L' in the limit of a large kappa.

    Of each column one of the two is zero. Shapes: mean, variances d, infinite d_inf (n,), lower (n (n - 1) / 2,).
    """

    mean: Float[jax.Array, "*time n"]
    lower: Float[jax.Array, "*time entries"]
    variances: Float[jax.Array, "*time n"]
    infinite: Float[jax.Array, "*time n"]

    @property
    def root(self) -> jax.Array:
        """Lower triangular factor L (n, n) with ones on its diagonal."""
        return jnp.asarray(unit_lower(self.lower))

    @property
    def unknown(self) -> jax.Array:
        """Return which components have an infinite variance (n,): those with an entry of L in an unknown direction."""
        return jnp.any((self.root != 0) & (self.infinite > 0), axis=1)

    @property
    def covariance(self) -> jax.Array:
        """Covariance (n, n); an unknown component has infinity on the diagonal and 0 in the rest of its row."""
        root = self.root
        return mark_unknown((root * self.variances) @ root.T, self.unknown)


def mark_unknown(covariance: jax.Array, unknown: jax.Array) -> jax.Array:
    """Return the covariance (m, m) with infinity on the diagonal and 0 elsewhere in rows of `unknown` components."""
    infinite = jnp.diag(jnp.where(unknown, jnp.inf, 0.0))
    return jnp.where(unknown[:, None] | unknown, infinite, covariance)


def project_diffuse(x: Diffuse, matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the covariance of H x (m, m) from the known directions of x, and a flag (m,) for each component.

    The flag is True where the component depends on an unknown direction of x. Such a direction has infinite variance,
    and so has the component.
    """
    slopes = _find_slopes(matrix, x)
    depends_on_unknown = jnp.any((slopes != 0) & (x.infinite > 0), axis=1)
    return (slopes * x.variances) @ slopes.T, depends_on_unknown


def _find_slopes(matrix: jax.Array, x: Diffuse) -> jax.Array:
    """Return the slopes H L (m, n) of H x, for x = m + L xi.

    A slope in an unknown direction j that is only rounding is set to 0: else H x would have an infinite variance. It
    counts as rounding if |(H L)_ij| <= DEAF (|H| |L|)_ij, a small share of the terms of its sum.
    """
    slopes, size_of_terms = matrix @ x.root, jnp.abs(matrix) @ jnp.abs(x.root)
    return jnp.where((x.infinite > 0) & (jnp.abs(slopes) <= DEAF * size_of_terms), 0.0, slopes)


class FiniteAndInfiniteWeights(NamedTuple):
    """Variances of the sources in whose directions columns point, (c,) each: for each source one of the two is 0.

    A source of weight `finite` w has the variance w; one of weight `infinite` w has kappa w, with kappa to infinity.
    """

    finite: jax.Array
    infinite: jax.Array


def triangularise_both_levels(
    rows: jax.Array, weights: FiniteAndInfiniteWeights, count: int, whole: jax.Array | None = None
) -> tuple[jax.Array, FiniteAndInfiniteWeights, jax.Array]:
    """Factor A diag(w) A' = L diag(d) L' by Gram-Schmidt on the rows of A, where some weights w are infinite.

    Column k of A is a direction of variance w_k, or of kappa w_k with kappa to infinity (an infinite column). Row after
    row, let a be row j and s = sum of w a^2 over the infinite columns. If s is more than rounding, d_inf,j = s and
    L_ij = sum w (row i) a / s over these columns alone. Else their entries of a are set to 0, and d_j and L_ij are the
    same sums over the finite columns. Then each row i below becomes row i - L_ij a.

    Args:
        rows: (rows, c).
        weights: finite and infinite weights of the columns (c,) each; one of the two is 0.
        count: how many rows are made orthogonal.
        whole: squares (rows,) of the rows in the infinite columns before anything was subtracted, which rounding is a
            share of; by default those of `rows`.

    Returns:
        L (rows, count), the weights (count,) of its columns, and the rows less their projections.
    """
    whole = rows**2 @ weights.infinite if whole is None else whole
    columns, finite, infinite, numbers = [], [], [], np.arange(len(rows))
    for j in range(count):
        # s over the infinite columns: up to the share FALLEN (1e-12) of its value before any subtraction, it is
        # rounding, and the row depends on no infinite column any more.
        infinite_s = rows[j] ** 2 @ weights.infinite
        is_infinite = infinite_s > FALLEN * whole[j]
        row = jnp.where((weights.infinite > 0) & ~is_infinite, 0.0, rows[j])
        finite_s = row**2 @ weights.finite
        # Column j of L: L_ij = (row i, row j) / s, over the columns that count for row j.
        weighted = jnp.where(is_infinite, weights.infinite, weights.finite) * row
        along = rows @ weighted * reciprocal_or_zero(jnp.where(is_infinite, infinite_s, finite_s))
        column = jnp.where(numbers == j, 1.0, jnp.where(numbers > j, along, 0.0))
        columns.append(column)
        finite.append(jnp.where(is_infinite, 0.0, finite_s))
        infinite.append(jnp.where(is_infinite, infinite_s, 0.0))
        rows = jnp.where((numbers > j)[:, None], rows - column[:, None] * row, rows)
    return jnp.stack(columns, axis=1), FiniteAndInfiniteWeights(jnp.stack(finite), jnp.stack(infinite)), rows


def start_diffuse(mean: jax.Array, known: WeightedColumns, unknown: np.ndarray) -> Diffuse:
    """Return the law of a state of which nothing is known in some components: their variance is infinite.

    The result holds the factors of the covariance L (diag(d) + kappa diag(d_inf)) L' for kappa to infinity.

    Args:
        mean: of the state (n,).
        known: columns W (n, c) and weights w (c,) of the covariance W diag(w) W' of the known components.
        unknown: which components are unknown (n,), as flags or as 0 and 1.
    """
    n = len(mean)
    # x - mean = [I | W] sources: source e_i of infinite variance for each unknown component i (0 for a known one), and
    # the sources of the known covariance W diag(w) W', of finite variances w.
    rows = jnp.concatenate([jnp.eye(n), jnp.asarray(known.matrix)], axis=1)
    finite = jnp.concatenate([jnp.zeros(n), jnp.asarray(known.weights)])
    infinite = jnp.concatenate([jnp.asarray(unknown, float), jnp.zeros(known.matrix.shape[1])])
    weights = FiniteAndInfiniteWeights(finite, infinite)
    lower, levels, _ = triangularise_both_levels(rows, weights, n)  # L, and (d, d_inf)
    return Diffuse(jnp.asarray(mean), below_diagonal(lower), *levels)


def predict_diffuse(x: Diffuse, matrix: jax.Array, offset: jax.Array, noise: WeightedColumns) -> Diffuse:
    """Predict x over x+ = F x + b + w: F is `matrix`, b the `offset`, `noise` columns of Cov w.

    The covariance of x has a finite part and an infinite one (of unknown directions). Both are predicted: for
    x = m + L xi, x+ - E x+ = [F L | N] (xi, omega), whose rows are made orthogonal by Gram-Schmidt.
    """
    rows, weights = _append_noise_columns(_find_slopes(matrix, x), x, noise)  # [F L | N], variances of (xi, omega)
    lower, levels, _ = triangularise_both_levels(rows, weights, len(x.mean))
    return Diffuse(matrix @ x.mean + offset, below_diagonal(lower), *levels)


def _append_noise_columns(
    slopes: jax.Array, x: Diffuse, noise: WeightedColumns
) -> tuple[jax.Array, FiniteAndInfiniteWeights]:
    """Return the rows [slopes | N] of x+ = m+ + slopes xi + N omega, with the weights of their columns.

    xi are the uncorrelated errors of x. Their weights are the variances of x, finite or infinite. omega are the
    uncorrelated parts of the noise, with finite weights. N diag(weights) N' is the noise's covariance.
    """
    rows = jnp.concatenate([slopes, jnp.asarray(noise.matrix)], axis=1)
    noise_weights = jnp.asarray(noise.weights)
    finite = jnp.concatenate([x.variances, noise_weights])
    infinite = jnp.concatenate([x.infinite, jnp.zeros(len(noise_weights))])
    return rows, FiniteAndInfiniteWeights(finite, infinite)


class MeasurementLikelihood(NamedTuple):
    """Log-likelihood () of a measurement, and which of its components depend on an unknown direction (m,)."""

    log_likelihood: jax.Array
    unknown: jax.Array


def observe_diffuse(
    x: Diffuse, matrix: jax.Array, innovation: jax.Array, noise: WeightedColumns
) -> tuple[Diffuse, MeasurementLikelihood]:
    """Condition x on z = H x + v; return its law given z, and the likelihood of z.

    The covariance of x is P + kappa P_inf in the limit of a large kappa: directions of P_inf are unknown. A component
    of z that shows an unknown direction has the infinite variance kappa s_inf and adds -1/2 log s_inf to the
    log-likelihood; any other, with the innovation e of variance s, adds log N(e; 0, s). Their sum is the log of the
    integral of p(z | delta) over the position delta in the unknown directions.

    Args:
        x: mean, and factors of both covariances, L diag(d) L' and L diag(d_inf) L'.
        matrix: H (m, n).
        innovation: z - H m - E v (m,), m the mean of x; NaN where a component did not arrive.
        noise: Cov v.
    """
    present = ~jnp.isnan(innovation)
    # Components with uncorrelated noises: (H, innovation) times the inverse of the noise's unit lower factor. A
    # component that did not arrive becomes a row of zeros with the noise variance 1, which carries no information.
    factors = triangularise_noise(WeightedColumns(jnp.where(present[:, None], noise.matrix, 0.0), noise.weights))
    state, rows, noises = _decorrelate_measurement(x, matrix, jnp.where(present, innovation, 0.0), factors, present)
    # `correction` is the change of the mean by the components so far.
    correction, log_likelihood, shows_unknown = jnp.zeros_like(state.mean), jnp.asarray(0.0), []
    for i in range(len(innovation)):
        # `s` is s_inf if the component shows an unknown direction (`shows`), else the variance of its innovation.
        h = rows[i, :-1]
        state, gain, s, shows = _observe_scalar(state, h, noises[i])
        e = rows[i, -1] - h @ correction  # innovation of component i given those before it
        correction = correction + gain * e
        log_density = jnp.where(shows, -jnp.log(s) / 2, -(e**2 / s + jnp.log(s) + LOG_TURN) / 2)
        log_likelihood = log_likelihood + jnp.where(present[i], log_density, 0.0)
        shows_unknown.append(shows & present[i])
    n = len(x.mean)
    mean = x.mean + correction[:n]
    posterior = Diffuse(mean, state.lower[: len(x.lower)], state.variances[:n], state.infinite[:n])
    return posterior, MeasurementLikelihood(log_likelihood, jnp.stack(shows_unknown))


def _decorrelate_measurement(
    x: Diffuse, matrix: jax.Array, innovation: jax.Array, noise: WeightedColumns, present: jax.Array
) -> tuple[Diffuse, jax.Array, jax.Array]:
    """Return the state, rows (h, e) of scalar measurements e = h'x + v, and the variances (m,) of v, uncorrelated.

    A measurement e = H x + v with Cov v = N diag(r) N' becomes m scalar ones, to be used one after another: N^-1 e has
    uncorrelated noises of variances r. Where the program is differentiated, the noises become states of their own,
    measured without a noise: N^-1 would spread derivatives that are as large as a noise is small.

    Args:
        x: the state: a Gaussian whose variances `infinite` stand for what is not known yet.
        matrix: H (m, n).
        innovation: e (m,), 0 of what is missing.
        noise: N (m, m), unit lower triangular, and its weights r (m,).
        present: which components arrived (m,); the others get rows of zeros and the noise 1.
    """
    variances = jnp.where(present, noise.weights, 1.0)
    rows = jnp.where(present[:, None], jnp.concatenate([matrix, innovation[:, None]], axis=1), 0.0)
    if not writes_for_derivatives():
        return x, decorrelate(noise.matrix, rows), variances
    # The state (x, v): its factor is blockdiag(L, N), its variances are those of x and r. Rows are (H, I, e).
    n, m = len(x.mean), len(innovation)
    root = jnp.zeros((n + m, n + m)).at[:n, :n].set(x.root).at[n:, n:].set(noise.matrix)
    none, of_noise = jnp.zeros(m), jnp.where(present[:, None], jnp.eye(m), 0.0)
    state = Diffuse(
        jnp.concatenate([x.mean, none]),
        below_diagonal(root),
        jnp.concatenate([x.variances, jnp.where(present, noise.weights, 0.0)]),
        jnp.concatenate([x.infinite, none]),
    )
    rows = jnp.concatenate([rows[:, :-1], of_noise, rows[:, -1:]], axis=1)
    return state, rows, jnp.where(present, 0.0, 1.0)


class _Column(NamedTuple):
    """A direction L_j (n,) of x = m + L xi, and the variance of xi_j: d_j, or kappa d_inf,j; one of the two is 0."""

    vector: jax.Array
    d: jax.Array
    d_inf: jax.Array


class _MeasuredSums(NamedTuple):
    """Sums for a scalar z = h'x + v over the columns k of L that were measured, with f_k = h'L_k.

    s = Var v + sum f_k^2 d_k and s_inf = sum f_k^2 d_inf,k are the finite and the infinite part of Var z, and `cross`
    (n,) is Cov(x, z). Once s_inf > 0, finite parts are nothing beside it: s stays, and `cross` is the infinite part.
    """

    s: jax.Array
    s_inf: jax.Array
    cross: jax.Array


def _observe_scalar(x: Diffuse, h: jax.Array, noise: jax.Array) -> tuple[Diffuse, jax.Array, jax.Array, jax.Array]:
    """Condition x on one number z = h'x + v, Var v = `noise`, where some directions of x are unknown.

    The covariance of x is L diag(d + kappa d_inf) L', kappa -> infinity: column j of L is an unknown direction where
    d_inf,j > 0, and then d_j = 0. Bierman's update goes over the columns of L from the last to the first.

    Returns:
        x given z, its mean as it was; the gain (n,) by which the innovation moves the mean; the variance of z, or its
        infinite part where z shows an unknown direction; and whether it shows one.

    Source: Bierman, Factorization methods for discrete sequential estimation (1977), for finite and infinite parts.
    """
    n, root = len(x.mean), x.root
    vectors = [root[:, j] for j in range(n)]
    columns = [_Column(*column) for column in zip(vectors, x.variances, x.infinite, strict=True)]
    sums = _MeasuredSums(s=noise, s_inf=jnp.zeros_like(noise), cross=jnp.zeros(n))
    for j in reversed(range(n)):
        columns[j], sums = _measure_along_column(columns[j], h, sums)
    observed = Diffuse(
        mean=x.mean,
        lower=below_diagonal(jnp.stack([column.vector for column in columns], axis=1)),
        variances=jnp.stack([column.d for column in columns]),
        infinite=jnp.stack([column.d_inf for column in columns]),
    )
    shows_unknown = sums.s_inf > 0
    variance = jnp.where(shows_unknown, sums.s_inf, sums.s)
    gain = sums.cross * reciprocal_or_zero(variance)
    return observed, gain, variance, shows_unknown


def _measure_along_column(column: _Column, h: jax.Array, sums: _MeasuredSums) -> tuple[_Column, _MeasuredSums]:
    """Take column j of L into the measurement z = h'x + v; return it given z, and the sums with its terms.

    With f = h'L_j, and `sums` s, s_inf, cross over the columns behind it, Bierman's step for a known direction is
    L_j -= (f / s) cross, s' = s + f^2 d_j, cross' = cross + d_j f L_j, d_j *= s / s'. For an unknown direction that z
    shows it is the same with d_inf,j and s_inf. The first such direction becomes known: its variance is s / f^2.
    """
    vector, d, d_inf = column
    s, s_inf, cross = sums
    f, size_of_terms = h @ vector, jnp.abs(h) @ jnp.abs(vector)
    is_unknown, is_shown = d_inf > 0, jnp.abs(f) > DEAF * size_of_terms  # an f of less is rounding
    shows_unknown = is_unknown & is_shown
    is_first_unknown = shows_unknown & (s_inf == 0)
    # (f / s) cross, where s_inf stands for s as soon as z shows an unknown direction.
    leading_s = jnp.where(s_inf > 0, s_inf, s)
    taken = jnp.where(is_unknown & ~is_shown, 0.0, f * reciprocal_or_zero(leading_s) * cross)
    # An entry of an unknown direction of which only rounding is left is 0: it would get an infinite variance.
    rounding = DEAF * (jnp.abs(vector) + jnp.abs(taken))
    is_left = ~is_unknown | is_first_unknown | (jnp.abs(vector - taken) > rounding)
    vector_given_z = jnp.where(is_left, vector - taken, 0.0)
    # The sums with column j.
    next_s = s + jnp.where(is_unknown, 0.0, f**2 * d)
    next_s_inf = s_inf + jnp.where(shows_unknown, f**2 * d_inf, 0.0)
    finite_part = jnp.where(is_unknown | (s_inf > 0), 0.0, d * f)
    next_cross = jnp.where(is_first_unknown, 0.0, cross) + vector * jnp.where(shows_unknown, d_inf * f, finite_part)
    # d_j s / s', of either part. As long as s' is 0, z shows nothing.
    shrunk = jnp.where((s_inf > 0) | (next_s == 0), d, d * s * reciprocal_or_zero(next_s))
    d_given_z = jnp.where(is_unknown, jnp.where(is_first_unknown, s * reciprocal_or_zero(f**2), 0.0), shrunk)
    shrunk_inf = jnp.where(shows_unknown, d_inf * s_inf * reciprocal_or_zero(next_s_inf), d_inf)
    given_z = _Column(vector_given_z, d_given_z, jnp.where(is_first_unknown, 0.0, shrunk_inf))
    return given_z, _MeasuredSums(s=jnp.where(s_inf > 0, s, next_s), s_inf=next_s_inf, cross=next_cross)


def condition_on_next_diffuse(x: Diffuse, matrix: jax.Array, ahead: jax.Array, noise: WeightedColumns) -> BackwardGain:
    """Return the regression of x on the next state x+ = F x + b + w, where x may have unknown directions.

    A smoother goes back by it. The covariance of x has two levels: unknown directions have infinite variances, all
    others finite ones. A direction of x that stays unknown given x+ gets the variance NaN, and so do the estimates that
    use it.

    Args:
        x: the state before the step: mean m, factor L_x, and the finite and infinite variances of its columns.
        matrix: F.
        ahead: mean of x+, F m + b.
        noise: N and weights d of Cov w = N diag(d) N'.

    Returns:
        x = m + K e + rest for x+ = ahead + L e with uncorrelated e: m with the factors of Cov(rest), K, ahead and L.

    Source: Rauch, Tung and Striebel, Maximum likelihood estimates of linear dynamic systems (1965).
    """
    # Let xi and omega be the uncorrelated sources of x and w: x = m + L_x xi, w = N omega. Then
    # x+ = ahead + [F L_x | N] (xi, omega), and x = m + [L_x | 0] (xi, omega).
    n = len(x.mean)
    next_rows, weights = _append_noise_columns(_find_slopes(matrix, x), x, noise)
    rows = jnp.concatenate([x.root, jnp.zeros((n, next_rows.shape[1] - n))], axis=1)
    # x+ - ahead = L e with uncorrelated e: L is lower[:n]. The regression x = m + K e + rest has K = lower[n:], and the
    # rows of the rest are remainder[n:], orthogonal to those of x+.
    lower, _, remainder = triangularise_both_levels(jnp.concatenate([next_rows, rows]), weights, n)
    # Factors of the covariance of the rest, Cov(x given x+).
    conditional, levels, _ = triangularise_both_levels(remainder[n:], weights, n, whole=rows**2 @ weights.infinite)
    law = Gaussian(x.mean, below_diagonal(conditional), jnp.where(levels.infinite > 0, jnp.nan, levels.finite))
    return BackwardGain(law, lower[n:], ahead, below_diagonal(lower[:n]))


def as_gaussian(x: Diffuse) -> Gaussian:
    """Return x as an ordinary Gaussian, whose variance is NaN in each direction that is unknown.

    For code that knows no infinite variances: what depends on an unknown direction is then NaN too.
    """
    return Gaussian(x.mean, x.lower, jnp.where(x.infinite > 0, jnp.nan, x.variances))
