"""Derivatives of the innovations of a linear filter in several free numbers, by those of its covariance.

Those of a step in one number are in `step_by_covariances.py`. A fit of four variances of thirteen states takes 84,000
operations a row by the factors, and 14,500 by the covariances.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.linear.linear_filter_state import LinearBelief, MomentsBeforeData
from heliograph.filters.linear.step_by_covariances import (
    FactoredStep,
    ModelMatrices,
    StateMoments,
    StepMoments,
    find_model_matrices,
    find_moments_at_start,
    step_by_covariances,
)
from heliograph.filters.rows.gaussians_in_states import MomentSlopes
from heliograph.numerics.types import Array


class EstimateWithDerivatives(NamedTuple):
    """The Gaussian of an estimate, and the derivatives of its mean and covariance in each of the p free numbers.

    Behind a random gain also mean and covariance of the state before any data, with their derivatives: the innovation's
    covariance depends on them. Behind a known gain these two are None.
    """

    gaussian: Gaussian
    slopes: tuple[MomentSlopes, ...]
    before_data: MomentsBeforeData | None = None
    slopes_before_data: tuple[MomentsBeforeData, ...] | None = None


class DifferentiatedInnovation(NamedTuple):
    """Innovation e (m,), its covariance S (m, m), their derivatives (p, ...), and what arrived (m,).

    e is NaN where nothing arrived, with derivatives of zero. `lost`: whether the estimate is no number.
    """

    e: jax.Array
    S: jax.Array
    de: jax.Array
    ds: jax.Array
    present: jax.Array
    lost: jax.Array


def differentiate_start(make: Callable[[Array], Any], x: Array, known_gain: bool) -> EstimateWithDerivatives:
    """Return the estimate before the first step, with its derivatives in each free number.

    It starts the recursion that differentiates the log-likelihood along with the filter. Behind a random gain the
    covariance of the innovation depends on E[x x'] before any data, so these moments are carried with their
    derivatives, too.

    Args:
        make: function from the free numbers to the filter, a `LinearFilter` with `has_score_recursion`.
        x: the free numbers (p,).
        known_gain: whether the gain is known, so that no moment before data matters.
    """

    def find_moments(x: Array) -> StateMoments:
        """Return mean (n,) and covariance (n, n) of the first state, in the filter made with the free numbers x."""
        return find_moments_at_start(make(x))

    # Derivative of (mean, covariance) in each free number: a Jacobian-vector product along each axis.
    slopes = tuple(MomentSlopes(*jax.jvp(find_moments, (x,), (axis,))[1]) for axis in np.eye(len(x)))
    start = jax.tree.map(jnp.asarray, make(x).init())
    # At the start no data have come: the moments before data are those of the estimate, and so are their slopes.
    if known_gain:
        return EstimateWithDerivatives(start.gaussian, slopes)
    return EstimateWithDerivatives(
        gaussian=start.gaussian,
        slopes=slopes,
        before_data=MomentsBeforeData(start.state_mean, start.state_covariance),
        slopes_before_data=tuple(MomentsBeforeData(*slope) for slope in slopes),
    )


def differentiate_step(
    make: Callable[[Array], Any], x: Array, before: EstimateWithDerivatives, row: tuple[Array, Array], k: Array
) -> tuple[EstimateWithDerivatives, DifferentiatedInnovation]:
    """Return estimate and innovation of a row (z, u), both with their derivatives in each free number.

    Args:
        make: the filter by the free numbers, a `LinearFilter` with `has_score_recursion`.
        x: the free numbers (p,).
        before: the estimate before the row.
        row: measurement (m,), NaN for what did not arrive, and input.
        k: the row's number.
    """
    z, u = row
    filter, present = make(x), ~jnp.isnan(z)
    # For each free number: (the step's matrices, moments before data), the same in each pair, and their derivatives.
    pairs = [
        jax.jvp(lambda x, moments: find_model_matrices(make(x), moments, u, k), (x, before.before_data), (axis, slope))
        for axis, slope in zip(np.eye(len(x)), before.slopes_before_data or [None] * len(x), strict=True)
    ]
    (matrices, moments), _ = pairs[0]  # the values: F, b, Q, H, c, R; moments before data after the step
    # Behind a known gain no moment before data matters: those at the start stand for all.
    start = filter.init() if before.before_data is None else LinearBelief(before.gaussian, *before.before_data)
    prior = filter.predict(start._replace(gaussian=before.gaussian), u, k)
    after, innovation = filter.correct(prior, z, k)
    value, covariance = jnp.asarray(innovation.value), jnp.asarray(innovation.covariance)
    factored = FactoredStep(prior=prior.gaussian, after=after.gaussian, e=value, S=covariance)

    def step(matrices: ModelMatrices, moments: StateMoments) -> StepMoments:
        """Return the state's moments after the row, and its innovation, with the values of `factored`."""
        return step_by_covariances(matrices, moments, jnp.asarray(z), factored)

    of_estimate = StateMoments(before.gaussian.mean, before.gaussian.covariance)
    slopes = [
        jax.jvp(step, (matrices, of_estimate), (d, StateMoments(*one)))[1]
        for (_, (d, _)), one in zip(pairs, before.slopes, strict=True)
    ]
    lost = jnp.any(jnp.isnan(after.gaussian.mean))
    innovation_with_slopes = DifferentiatedInnovation(
        e=value,
        S=covariance,
        de=jnp.stack([one.e for one in slopes]),
        ds=jnp.stack([one.S for one in slopes]),
        present=present,
        lost=lost,
    )
    slopes_before_data = None if moments is None else tuple(slope for _, (_, slope) in pairs)
    slopes_after = tuple(MomentSlopes(*one.after) for one in slopes)
    return EstimateWithDerivatives(after.gaussian, slopes_after, moments, slopes_before_data), innovation_with_slopes
