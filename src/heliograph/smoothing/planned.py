"""Precomputed smoother: with all matrices known before any data, only vectors are left to compute for each run."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.model.estimate import Estimate
from heliograph.numerics.check import array, check_horizon, fail, instance
from heliograph.numerics.float64 import compiled
from heliograph.numerics.module import Module
from heliograph.numerics.readable import readable
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.smoothing.backward_pass import planned_with_past, quiet_steps, stepped
from heliograph.smoothing.modes import AbstractSmoothing


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
        """Smoothed means of one run's z (horizon, received), written for `hg.simulation.over_runs` and `jax.vmap`."""

        _, steps = stepped(self.filter, jnp.asarray(z), self.inputs, self.filter.init(), np.asarray(0))
        return self.smoothing.means(steps)


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
    planned = _planned(filter, u)
    if planned is None:
        raise fail("filter", "one whose gains depend on no data", type(filter).__name__)
    return PlannedSmoother(planned, smoothing, u, _estimate(filter, smoothing, u))


@compiled
def _planned(item: AbstractFilter, u: Array) -> AbstractFilter | None:
    planned = planned_with_past(item, u)
    return None if planned is item else planned


@compiled
def _estimate(item: AbstractFilter, smoothing: AbstractSmoothing, u: Array) -> Estimate:
    return smoothing.sweep(quiet_steps(item, u))
