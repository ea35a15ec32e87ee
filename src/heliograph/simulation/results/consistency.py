"""Consistency of estimates and innovations on plain arrays: squared errors in units of what is claimed of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from heliograph.engine.choice import compile_on_call
from heliograph.model.plant import AnyPlant, read_manifold
from heliograph.model.sensor import AnySensor, angles_of_outputs
from heliograph.numerics.angles.angle import wrap_angles
from heliograph.numerics.check import array, check_count, fail, rank, scalar, standard_deviations
from heliograph.numerics.confidence_intervals import correlate_over_steps
from heliograph.numerics.linalg import squared_distance
from heliograph.numerics.module import readable
from heliograph.numerics.types import Array, ArrayLike, Bool, Float

ASYMMETRY = 1e-6  # of two standard deviations: covariances come from other programs, too, and from files
DIMENSION_WORDS = "the degrees of freedom: a positive number, or one of each value"


@readable
@dataclass(frozen=True)
class Consistency:
    """Comparison of NEES or NIS values with what a true claim implies.

    Args:
        mean: mean of the values that are not NaN.
        expected: its expectation where the claim is true: the mean number of degrees of freedom.
        interval: (low, high) that holds the mean with the confidence where the claim is true and values are
            independent.
        means: mean over the runs at each step (steps,); the values themselves of one run.
        intervals: (low, high) of each step's mean over the runs (steps, 2), whose independence does not rest on the
            steps'.
        autocorrelation: of the values over 1, 2, ... steps (lags,): near 0 for the NIS of a filter that uses all that
            it receives; the NEES of one run is always correlated, and its interval then too narrow. NaN where no two
            values are so far apart, or all are equal.
        autocorrelation_bound: half-width of the interval about 0 that holds each of them with the confidence.
    """

    mean: float
    expected: float
    interval: tuple[float, float]
    means: Float[np.ndarray, " steps"]
    intervals: Float[np.ndarray, "steps 2"]
    autocorrelation: Float[np.ndarray, " lags"]
    autocorrelation_bound: float

    @property
    def consistent(self) -> bool:
        """True where the mean is within its interval."""
        return self.interval[0] <= self.mean <= self.interval[1]


def nees(
    truth: Float[ArrayLike, "*steps n"],
    mean: Float[ArrayLike, "*steps n"],
    covariance: Float[ArrayLike, "*steps n n"],
    angles: "Sequence[int] | AnyPlant" = (),
) -> Float[np.ndarray, "*steps"]:
    """Return the normalised estimation error squared (NEES), e' P^-1 e with e = truth - mean: one number a step.

    Its expectation is n if P = E[e e']. If e is also Gaussian, it is chi-squared with n degrees of freedom
    (`hg.consistency`). A component of variance 0 in P adds 1 if its error is 0, and makes the result infinite if not.

    Args:
        truth: true states, NaN for components that are not known. The others are judged, by their part of P.
        mean: estimates, NaN where there is none.
        covariance: claimed covariances P of the errors, one (n, n) for all steps or one a step.
        angles: indices of the states that are angles in radians, whose errors are between -pi and pi. A plant may be
            given instead; errors of its attitudes are then rotation vectors. None are angles by default.

    Raises:
        ValueError: shapes that do not fit, numbers that are not finite, a matrix that is no covariance, angles that are
            no indices in the state.

    Source: Bar-Shalom, Li and Kirubarajan, Estimation with applications to tracking and navigation (2001), section 5.4.
    """
    axes = max(rank("truth", truth), 1)
    x = array("truth", truth, (None,) * axes, missing=True)
    estimates = array("mean", mean, x.shape, missing=True)
    errors = read_manifold(angles, x.shape[-1]).difference(x, estimates)
    covariances = _broadcast_covariance_to_steps(covariance, x)
    return _compute_normalised_square(errors, covariances, size=x)


def nis(
    innovation: Float[ArrayLike, "*steps m"],
    covariance: Float[ArrayLike, "*steps m m"],
    angles: "Sequence[int] | AnySensor" = (),
) -> Float[np.ndarray, "*steps"]:
    """Return the normalised innovation squared (NIS), e' S^-1 e of an innovation e: one number a step, without a truth.

    Its expectation is the number of components that arrived. It is NaN if none arrived. A gate (a test whether a
    measurement belongs to the target) compares it with a quantile of the chi-squared law.

    Args:
        innovation: z - E[z | earlier z], NaN for what did not arrive: `filter.run(z).innovations`.
        covariance: its covariance, one (m, m) or one a step: `filter.run(z).innovation_covariances`.
        angles: which components are angles in radians, by place, or the sensor whose outputs they are; none by default,
            as a filter's own innovations are between -pi and pi already.

    Raises:
        ValueError: shapes that do not fit, infinite numbers, a matrix that is no covariance, angles that are no indices
            in the innovation.

    Source: Bar-Shalom, Li and Kirubarajan, Estimation with applications to tracking and navigation (2001), section 5.4.
    """
    # e (steps, m) with angles between -pi and pi; S repeated for each step; e' S^-1 e over the components that arrived.
    axes = max(rank("innovation", innovation), 1)
    e = array("innovation", innovation, (None,) * axes, missing=True)
    wrapped = wrap_angles(e, angles_of_outputs(angles, e.shape[-1]))
    covariances = _broadcast_covariance_to_steps(covariance, e)
    # Size 0: e is given, not computed here as a difference of large numbers, so that it has no rounding of these.
    return _compute_normalised_square(wrapped, covariances, size=np.zeros_like(e))


def _broadcast_covariance_to_steps(
    covariance: ArrayLike, x: Float[np.ndarray, "*steps n"]
) -> Float[np.ndarray, "*steps n n"]:
    """Return the covariance of each step; a single matrix is repeated for all steps.

    Raises:
        ValueError: a matrix that is not symmetric.
    """
    n = x.shape[-1]
    shape = (n, n) if rank("covariance", covariance) == 2 else (*x.shape, n)
    matrices = array("covariance", covariance, shape, missing=True)
    deviations = standard_deviations(matrices)
    asymmetry = np.abs(matrices - np.swapaxes(matrices, -1, -2))
    if np.any(asymmetry > ASYMMETRY * deviations[..., :, None] * deviations[..., None, :]):
        largest = np.nanmax(asymmetry)
        raise fail("covariance", "symmetric matrices", f"entries that differ by {largest:.3g} across the diagonal")
    return np.broadcast_to(matrices, (*x.shape, n))


def _compute_normalised_square(
    x: Float[np.ndarray, "*steps n"], covariance: Float[np.ndarray, "*steps n n"], size: Float[np.ndarray, "*steps n"]
) -> Float[np.ndarray, "*steps"]:
    """Return x' P^-1 x of each step over the components of x that are not NaN, or NaN if all are.

    For errors of a filter it is the normalised squared error, whose mean is n if the covariance P is right. All steps
    are computed at once.

    Args:
        x: errors or innovations (..., n), NaN where a component is missing.
        covariance: P of each step (..., n, n).
        size: size of the numbers whose difference x is (..., n); it bounds the rounding error of x.

    Raises:
        ValueError: a covariance with a negative eigenvalue.
    """
    # Replace a missing component by 0 with variance 1 and no correlation, which adds 0^2 / 1 to the square.
    present, n = ~np.isnan(x), x.shape[-1]
    both_present = present[..., :, None] & present[..., None, :]
    with_missing = np.where(both_present, covariance, np.eye(n) * ~present[..., None, :])
    errors, sizes = np.where(present, x, 0.0), np.nan_to_num(size)
    # Join all leading axes into one, so that matrices stand one after another.
    squares = _square_distances(with_missing.reshape(-1, n, n), errors.reshape(-1, n), sizes.reshape(-1, n))
    squares_by_step = np.asarray(squares).reshape(x.shape[:-1])
    # The square of an indefinite matrix is NaN, which would count as missing: refuse it, and name the step.
    is_known = np.isfinite(with_missing).all(axis=(-1, -2))
    indefinite = np.argwhere(np.isnan(squares_by_step) & is_known)
    if len(indefinite):
        step = tuple(int(place) for place in indefinite[0])
        smallest = np.linalg.eigvalsh(with_missing[step])[0]
        where = f" at {', '.join(map(str, step))}" if step else ""
        raise fail(f"covariance{where}", "a positive semidefinite matrix", f"smallest eigenvalue {smallest:.3g}")
    return np.asarray(np.where(present.any(axis=-1), squares_by_step, np.nan))


@compile_on_call
def _square_distances(a: Array, x: Array, size: Array) -> Array:
    """Return x' A^-1 x of each row; `size`: numbers of which x is a difference, by which its rounding is judged."""
    return jax.vmap(squared_distance)(jnp.asarray(a), jnp.asarray(x), jnp.asarray(size))


def consistency(
    values: Float[ArrayLike, "*runs steps"],
    dimension: Float[ArrayLike, "*steps"],
    confidence: float = 0.95,
    lags: int = 10,
) -> Consistency:
    """Compare NEES or NIS values with the chi-squared law that a true claim implies.

    Angles count where errors are squared, which `angles` of `hg.nees` and `hg.nis` says; a value is a number already.

    Values of N steps and runs with nu degrees of freedom each: N times their mean has a chi-squared law with N nu
    degrees where they are independent.

    Args:
        values: NEES or NIS (steps,) of one run, or (runs, steps); NaN counts as missing.
        dimension: degrees of freedom of each value: the number of states for NEES, of received components for NIS, one
            number or an array like `values`.
        confidence: probability of each interval; 0.95 by default.
        lags: number of lags of the autocorrelation; 10 by default, fewer where there are too few steps.

    Raises:
        ValueError: another shape, no values, a dimension that is not positive, a confidence outside (0, 1).

    Source: Bar-Shalom, Li and Kirubarajan, Estimation with applications to tracking and navigation (2001), section 5.4.
    """
    entries = array("values", values, (None,) * (2 if rank("values", values) == 2 else 1), missing=True)
    rows = np.atleast_2d(entries)  # (runs, steps)
    level = float(scalar("confidence", confidence, low=0.0, high=1.0))
    if not 0 < level < 1:
        raise fail("confidence", "a number between 0 and 1", confidence)
    present = ~np.isnan(rows)
    degrees = _broadcast_degrees(dimension, present)
    if not present.any():
        raise fail("values", "at least one that is not NaN", f"shape {entries.shape}")
    # Means and intervals: of all values, and of each step over the runs.
    filled = np.where(present, rows, 0.0)  # missing values add nothing to the sums
    count = present.sum(axis=0)  # by step
    by_step = np.divide(filled.sum(axis=0), count, out=np.full(len(count), np.nan), where=count > 0)
    quantiles = np.array([(1 - level) / 2, (1 + level) / 2])
    ends = _bound_mean(degrees.sum(), present.sum(), quantiles)
    ends_by_step = np.stack([_bound_mean(d, c, quantiles) for d, c in zip(degrees.sum(axis=0), count, strict=True)])
    # Correlation over the steps of deviations from the mean of all.
    deviations = rows - filled.sum() / present.sum()
    correlation, error = correlate_over_steps(deviations, min(check_count("lags", lags), len(count) - 1))
    return Consistency(
        mean=float(filled.sum() / present.sum()),
        expected=float(degrees.sum() / present.sum()),
        interval=(float(ends[0]), float(ends[1])),
        means=by_step,
        intervals=ends_by_step,
        autocorrelation=correlation,
        autocorrelation_bound=float(scipy.special.ndtri(quantiles[1])) * error,
    )


def _broadcast_degrees(
    dimension: ArrayLike, present: Bool[np.ndarray, "runs steps"]
) -> Float[np.ndarray, "runs steps"]:
    """Return the degrees of freedom of each value, as an array like `present`; 0 where no value is present.

    Raises:
        ValueError: another shape, or degrees that are not positive.
    """
    try:
        degrees = np.broadcast_to(np.asarray(dimension, dtype=np.float64), present.shape)
    except (TypeError, ValueError):
        raise fail("dimension", DIMENSION_WORDS, repr(dimension)[:60]) from None
    if not (np.isfinite(degrees[present]).all() and (degrees[present] > 0).all()):
        raise fail("dimension", DIMENSION_WORDS, repr(dimension)[:60])
    return np.where(present, degrees, 0.0)


def _bound_mean(degrees: float, count: int, quantiles: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    """Return quantiles of the mean of `count` chi-squared values with so many degrees of freedom in all."""
    return np.asarray(2 * scipy.special.gammaincinv(degrees / 2, quantiles) / count) if count else np.full(2, np.nan)
