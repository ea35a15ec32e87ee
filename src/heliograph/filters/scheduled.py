"""Filters whose gains were computed before any data, and the same recursion on-line for data with gaps."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.gaussian import Belief
from heliograph.linear.recursion import RANK_TOLERANCE
from heliograph.linear.schedule import Gains, Schedule
from heliograph.linear.system import LinearSystem, Steps
from heliograph.model.estimate import Claim, Estimate
from heliograph.model.over_time import OverTime, at
from heliograph.numerics.float64 import compiled, in_float64
from heliograph.numerics.linalg import symmetrize


class ScheduleState(NamedTuple):
    """The schedule's state (N,), and whether everything has arrived so far."""

    value: jax.Array
    complete: jax.Array


class ScheduledFilter(AbstractFilter):
    """Run a schedule: s+ = F s + K z + c, xhat = L s + J z + d. A step costs a few products of a matrix and a vector.

    The claimed covariance is the schedule's, and it is computed for complete data. A component that did not arrive
    counts as what the filter expected, and from then on the bound is NaN: no covariance is known any more, and the
    record says so. What the gains of a step do not use cannot be missed. Where data have gaps, use
    `LinearSystemFilter`, which recomputes its gains.
    """

    gains: OverTime
    start: np.ndarray
    claim: Claim = eqx.field(static=True)

    def __init__(self, schedule: Schedule):
        self.gains, self.start, self.claim = OverTime(schedule.gains), schedule.start, schedule.claim

    @in_float64
    def init(self) -> ScheduleState:
        """The schedule's start."""
        return ScheduleState(jnp.asarray(self.start), jnp.asarray(True))

    @compiled
    def step(self, state: ScheduleState, z: Any, u: Any = (), k: Any = 0) -> tuple[ScheduleState, Estimate]:
        """Apply the gains of step k; the input is not used."""
        g: Gains = at(self.gains, k)
        z = jnp.asarray(z, dtype=float)
        s, present = state.value, ~jnp.isnan(z)
        heard = jnp.where(present, z, g.expected @ s + g.expected_offset)
        unused = jnp.all(g.gain == 0, axis=0) & jnp.all(g.direct == 0, axis=0)  # a planned silence is no gap
        complete = state.complete & jnp.all(present | unused)
        estimate = g.output @ s + g.direct @ heard + g.output_offset
        following = g.transition @ s + g.gain @ heard + g.offset
        bound = jnp.where(complete, g.covariance, jnp.nan)
        return ScheduleState(following, complete), Estimate(estimate, bound, self.claim)


class LinearSystemFilter(AbstractFilter):
    """The best linear filter of a linear system, with its covariance carried along: exact also for data with gaps.

    A component of z that did not arrive is left out of the step, as if that channel were off. Which components arrive
    must not depend on their values.
    """

    steps: OverTime
    mean: np.ndarray
    covariance: np.ndarray
    want: np.ndarray
    claim: Claim = eqx.field(static=True)

    def __init__(self, system: LinearSystem, claim: Claim = "exact"):
        self.steps = OverTime(system.steps)
        self.mean, self.covariance, self.want = system.mean, system.covariance, system.want
        self.claim = claim

    @in_float64
    def init(self) -> Belief:
        """The system's start."""
        return Belief(jnp.asarray(self.mean), jnp.asarray(self.covariance))

    @compiled
    def step(self, state: Belief, z: Any, u: Any = (), k: Any = 0) -> tuple[Belief, Estimate]:
        """Predict, then use what arrived of z; the input is not used."""
        s: Steps = at(self.steps, k)
        z = jnp.asarray(z, dtype=float)
        present = ~jnp.isnan(z)
        mean = s.transition @ state.mean + s.drift
        spread = s.transition @ state.covariance @ s.transition.T + s.process
        cross = jnp.where(present[:, None], s.output @ spread, 0.0)
        innovation = jnp.where(present, z - s.output @ mean - s.offset, 0.0)
        both = present[:, None] & present
        gain = _solve(jnp.where(both, s.output @ spread @ s.output.T + s.noise, 0.0), cross).T
        after = Belief(mean + gain @ innovation, symmetrize(spread - gain @ cross))
        want = jnp.asarray(self.want)
        return after, Estimate(want @ after.mean, want @ after.covariance @ want.T, self.claim)


def _solve(innovation: jax.Array, cross: jax.Array) -> jax.Array:
    """O^+ C as in heliograph.linear.recursion; rows of zeros (absent components) are skipped."""
    deviation = jnp.sqrt(jnp.maximum(jnp.diagonal(innovation), 0.0))
    scale = jnp.where(deviation > 0, 1 / jnp.where(deviation > 0, deviation, 1.0), 0.0)
    values, vectors = jnp.linalg.eigh(scale[:, None] * innovation * scale)
    used = values > RANK_TOLERANCE * values[-1]
    inverse = jnp.where(used, 1 / jnp.where(used, values, 1.0), 0.0)
    root = scale[:, None] * vectors
    return jnp.asarray((root * inverse) @ (root.T @ cross))
