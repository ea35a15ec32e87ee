"""Smoothed estimates of a filter over rows of data: the Rauch-Tung-Striebel smoother."""

from dataclasses import dataclass

import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.rows import data_of
from heliograph.model.estimate import Claim
from heliograph.numerics.check import fail, instance
from heliograph.numerics.readable import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.smoothing.backward_pass import stepped
from heliograph.smoothing.modes import FixedInterval


@readable
@dataclass(frozen=True)
class Smoothed:
    """Estimates of every state given all rows of data.

    Args:
        means: (steps, n).
        covariances: what is claimed of their errors (steps, n, n).
        claim: what the covariances are: "exact", "upper", "nominal" or "none".
    """

    means: Float[np.ndarray, "steps n"]
    covariances: Float[np.ndarray, "steps n n"]
    claim: Claim


def rts_smoother(
    filter: AbstractFilter,
    z: Float[ArrayLike, "steps received"],
    u: Float[ArrayLike, "steps inputs"] | None = None,
) -> Smoothed:
    """Rauch-Tung-Striebel smoother: estimates of every state given all rows, by a pass back over those of a filter.

    The estimates of `filter.run(z, u)` given the later rows too. It warns where the innovations say that the filter is
    not consistent. Of a whole network: `hg.run(..., smooth=hg.smoothing.FixedInterval())`.

    Args:
        filter: a filter that can be smoothed; any that keeps a covariance.
        z: measurements (steps, received), or (steps,) of one number; NaN for what did not arrive.
        u: inputs (steps, inputs), the one that led to each row; by default a filter without inputs is assumed.

    Raises:
        ValueError: data of another size than the filter's, no rows, a filter that cannot be smoothed.

    Source: Rauch, Tung and Striebel, Maximum likelihood estimates of linear dynamic systems (1965); Bryson and Frazier
        (1963) for the form that divides by no covariance.
    """
    instance("filter", filter, AbstractFilter, "a filter, such as kalman_filter(...)")
    rows, inputs = data_of(filter, z, u)
    if not len(rows):
        raise fail("measurements", "at least one row", "none")
    _, steps = stepped(filter, rows, inputs, filter.init(), np.asarray(0))
    estimate = FixedInterval().estimates(steps)
    return Smoothed(np.asarray(estimate.mean), np.asarray(estimate.covariance), estimate.claim)
