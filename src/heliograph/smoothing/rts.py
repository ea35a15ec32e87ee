"""Smoothed estimates of a filter over rows of data, and the same with all matrices known before any data."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.filters.base import AbstractFilter
from heliograph.filters.rows.run_over_data import check_data
from heliograph.model.estimate import Claim, Estimate
from heliograph.numerics.check import array, check_horizon, fail, instance
from heliograph.numerics.module import Module, readable
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.smoothing.chunked_smoother import smooth_in_chunks
from heliograph.smoothing.fixed_interval_lag_point import AbstractSmoothing, FixedInterval, warn_if_inconsistent
from heliograph.smoothing.forward_and_backward_pass import (
    data_free_smoother_steps,
    filter_rows_with_smoother_steps,
    plan_with_smoother_steps,
)


@readable
@dataclass(frozen=True)
class Smoothed:
    """Estimates of every state given all rows of data.

    Args:
        means: (steps, n).
        covariances: claimed covariances of their errors (steps, n, n).
        claim: what the covariances are: "exact", "upper", "nominal" or "none".
        modes: probabilities of the modes given all rows (steps, M); None of a filter that weighs none.
    """

    means: Float[np.ndarray, "steps n"]
    covariances: Float[np.ndarray, "steps n n"]
    claim: Claim
    modes: Float[np.ndarray, "steps M"] | None = None


def rts_smoother(
    filter: AbstractFilter,
    z: Float[ArrayLike, "steps received"],
    u: Float[ArrayLike, "steps inputs"] | None = None,
) -> Smoothed:
    """Rauch-Tung-Striebel smoother: estimates of every state given all rows, by a pass back over those of a filter.

    The estimates are those of `filter.run(z, u)`, given the later rows too; many rows are smoothed in chunks side by
    side. It warns if the innovations show that the filter is not consistent. A whole network is smoothed by
    `hg.run(..., smooth=hg.smoothing.FixedInterval())`.

    Args:
        filter: a filter that can be smoothed; any that keeps a covariance.
        z: measurements (steps, received), or (steps,) of one number; NaN for what did not arrive.
        u: inputs (steps, inputs), the one that led to each row; by default a filter without inputs is assumed.

    Raises:
        ValueError: data of another size than the filter's, no rows, a filter that cannot be smoothed.

    Source: Rauch, Tung and Striebel, Maximum likelihood estimates of linear dynamic systems (1965).
    """
    instance("filter", filter, AbstractFilter, "a filter, such as kalman_filter(...)")
    rows, inputs = check_data(filter, z, u)
    if not len(rows):
        raise fail("measurements", "at least one row", "none")
    # Many rows of a linear filter in chunks side by side; else one pass of the filter, then one pass back.
    in_chunks = smooth_in_chunks(filter, rows, inputs)
    if in_chunks is not None:
        warn_if_inconsistent("smoothing", in_chunks.sums)
        estimate = in_chunks.estimate
    else:
        _, steps = filter_rows_with_smoother_steps(filter, rows, inputs, filter.init(), np.asarray(0))
        estimate = FixedInterval().estimates(steps)
    modes = None if estimate.modes is None else np.asarray(estimate.modes)
    return Smoothed(np.asarray(estimate.mean), np.asarray(estimate.covariance), estimate.claim, modes)


@readable
class PlannedSmoother(Module):
    """Precomputed smoother of a linear filter: its covariances, and a map from z to smoothed means.

    For complete data: where a component is missing all means are NaN. Built by `planned_smoother`.

    Args:
        filter: the planned filter, with its smoother steps.
        smoothing: which states are estimated from which data.
        inputs: inputs of the plant (horizon, inputs).
        estimate: means (time, n) for measurements that are zero, and the covariances (time, n, n) of all data.
    """

    filter: AbstractFilter
    smoothing: AbstractSmoothing
    inputs: Float[Array, "horizon inputs"]
    estimate: Estimate

    def means(self, z: ArrayLike) -> Float[jax.Array, "time n"]:
        """Return smoothed means of a run's z (horizon, received), also in `hg.simulation.over_runs` and `jax.vmap`."""
        return _smoothed_means(self, array("measurements", z, (len(self.inputs), self.filter.received), missing=True))


def planned_smoother(
    filter: AbstractFilter,
    horizon: int,
    smoothing: AbstractSmoothing,
    inputs: Float[ArrayLike, "horizon inputs"] | None = None,
) -> PlannedSmoother:
    """Precompute the smoother of a linear filter over `horizon` steps of complete data, once for all runs.

    Args:
        filter: a filter whose gains do not depend on data.
        horizon: number of steps.
        smoothing: which states are estimated from which data, such as `FixedInterval()`.
        inputs: inputs of the plant (horizon, inputs); by default a filter without inputs is assumed.

    Raises:
        ValueError: a filter whose gains depend on data or that cannot be smoothed, inputs that are not the filter's.
    """
    instance("filter", filter, AbstractFilter, "a filter")
    instance("smoothing", smoothing, AbstractSmoothing, "one such as FixedInterval()")
    smoothing.check(check_horizon(horizon))
    u = array("inputs", np.zeros((horizon, 0)) if inputs is None else inputs, (horizon, len(filter.inputs)))
    planned = _plan_or_none(filter, u)
    if planned is None:
        raise fail("filter", "one whose gains depend on no data", type(filter).__name__)
    return PlannedSmoother(planned, smoothing, u, _smoothed_covariances(filter, smoothing, u))


@compile_on_call
def _smoothed_means(planned: PlannedSmoother, z: Array) -> jax.Array:
    """Return the smoothed means (time, n) of one run's measurements z (horizon, received).

    The planned filter has all covariances and gains, so that its pass over z computes only means.
    """
    first_step, start = np.asarray(0), planned.filter.init()
    _, steps = filter_rows_with_smoother_steps(planned.filter, z, planned.inputs, start, first_step)
    return planned.smoothing.means(jax.tree.map(jnp.asarray, steps))


@compile_on_call
def _plan_or_none(filter: AbstractFilter, u: Array) -> AbstractFilter | None:
    """Return the filter with gains and smoother steps precomputed for inputs u (horizon, inputs) and complete data.

    None where its gains depend on data.
    """
    planned = plan_with_smoother_steps(filter, u)
    return None if planned is filter else planned


@compile_on_call
def _smoothed_covariances(filter: AbstractFilter, smoothing: AbstractSmoothing, u: Array) -> Estimate:
    """Return the smoothed estimates for z = 0.

    Their covariances hold for any complete data, since the filter's gains depend on none. `u`: (horizon, inputs).
    """
    return smoothing.sweep(data_free_smoother_steps(filter, u))
