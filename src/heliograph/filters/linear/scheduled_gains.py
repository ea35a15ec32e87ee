"""Filters with gains computed before any data, and the same recursion on-line for data with gaps."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import (
    WeightedColumns,
    factor_covariances,
    join_columns,
    rounding_of,
    triangularise,
)
from heliograph.factors.factored_gaussian import Gaussian, from_covariance, predict_affine
from heliograph.filters.base import AbstractFilter, AbstractSizedFilter, Step, corrects, estimates, predicts
from heliograph.filters.gaussian.signal_moments import condition_on_measurement
from heliograph.filters.innovation import gaussian_innovation
from heliograph.filters.linear.precomputed_filter import plan_filter
from heliograph.filters.smoother_step import SmootherStep, StepTrace, smoother_step_of
from heliograph.linear.system import Gains, LinearSystem, Schedule, Steps
from heliograph.model.estimate import Claim, Estimate, Innovation
from heliograph.model.over_time import OverTime, at
from heliograph.numerics.check import instance, names
from heliograph.numerics.float64 import compile_in_float64, in_float64
from heliograph.numerics.types import Array, ArrayLike, Bool, Float, Int


class ScheduleState(NamedTuple):
    """State s of the recursion with saved gains (N,), the estimate's mean (q,) and the expected measurement (m,).

    `complete`: whether every number that a gain uses has arrived so far. `stage` is the index of the covariance: 0 at
    the start, 2 k + 1 before and 2 k + 2 after the correction of step k.
    """

    value: Float[jax.Array, " N"]
    mean: Float[jax.Array, " q"]
    expected: Float[jax.Array, " m"]
    complete: Bool[jax.Array, ""]
    stage: Int[jax.Array, ""]


class ScheduledFilter(AbstractSizedFilter):
    """Run a schedule: s+ = F s + K z + c, xhat = L s + J z + d, a few products of a matrix and a vector per step.

    The prediction assumes that the expected measurement arrives, e = G s + g; a correction adds K (z - e) and J (z -
    e). The claimed covariance is the schedule's, and it is computed for complete data. A component that did not arrive
    counts as if it equalled its expectation, and from then on the covariance is NaN: it is not known any more, and the
    record says so; a component with zero gain cannot be missed (a planned silence). Where data have gaps, use
    `LinearSystemFilter`, which recomputes its gains. Before its first prediction a schedule estimates nothing (NaN).

    Args:
        schedule: gains and covariances for each step.
        states: names of the states; x0, x1, ... by default.

    Shapes: covariances (2 horizon + 1, q, q), before and after each correction; unused (horizon, m), components of no
    gain.
    """

    gains: OverTime
    unused: np.ndarray
    covariances: np.ndarray
    start: np.ndarray

    def __init__(self, schedule: Schedule, states: Sequence[str] | None = None):
        """Keep the schedule's gains and covariances.

        Without data a step runs as if z equalled its expected value, so the gains of predictions have that put in.
        """
        instance("schedule", schedule, Schedule, "a Schedule")
        gains = schedule.gains
        self.gains = OverTime(_gains_for_expected_measurement(gains))
        self.unused = np.all(gains.gain == 0, axis=1) & np.all(gains.direct == 0, axis=1)
        # Covariances by stage: NaN at the start, where none is claimed; then those before correction 0, after it, ...
        before_and_after = np.stack([gains.predicted, gains.covariance], axis=1)  # (horizon, 2, q, q)
        covariances = before_and_after.reshape(-1, *gains.covariance.shape[1:])
        self.covariances = np.concatenate([np.full_like(covariances[:1], np.nan), covariances])
        self.start, self.claim = schedule.start, schedule.claim
        self.states, self.inputs = names("state names", states, gains.direct.shape[1], "x"), ()
        self.received, self.kept = gains.direct.shape[2], schedule.kept

    @compile_on_call
    def init(self) -> ScheduleState:
        """Return the schedule's initial state.

        Estimate and expected measurement are NaN before the first step. No number was missing so far (`complete`), and
        the covariance has the index (`stage`) 0.
        """
        mean, expected = jnp.full(len(self.states), jnp.nan), jnp.full(self.received, jnp.nan)
        return ScheduleState(
            value=jnp.asarray(self.start),
            mean=mean,
            expected=expected,
            complete=jnp.asarray(True),
            stage=jnp.asarray(0),
        )

    @predicts
    def predict(self, state: ScheduleState, u: ArrayLike = (), k: Step = 0) -> ScheduleState:
        """Predict over step k as if its expected measurement e = G s + g arrived; a correction adds K (z - e).

        With e put in, the saved recursion is s+ = F s + c with the estimate L s + d: these are the `gains` here.
        """
        gains: Gains = at(self.gains, k)
        s = state.value
        return ScheduleState(
            value=gains.transition @ s + gains.offset,
            mean=gains.output @ s + gains.output_offset,
            expected=gains.expected @ s + gains.expected_offset,
            complete=state.complete,
            stage=jnp.asarray(2 * k + 1, dtype=state.stage.dtype),
        )

    @corrects
    def correct(self, state: ScheduleState, z: ArrayLike, k: Step = 0) -> tuple[ScheduleState, Innovation]:
        """Add the innovation e = z - E z, times the gains of step k: K e to the state, J e to the estimate.

        Once a number is missing that a gain uses, the saved covariances do not hold any more, and NaN is reported.
        `unused` marks the numbers that no gain uses.
        """
        gains: Gains = at(self.gains, k)
        z = jnp.asarray(z)
        present = ~jnp.isnan(z)
        innovation = jnp.where(present, z - state.expected, 0.0)
        after = ScheduleState(
            value=state.value + gains.gain @ innovation,
            mean=state.mean + gains.direct @ innovation,
            expected=state.expected,
            complete=state.complete & jnp.all(present | jnp.asarray(self.unused)[k]),
            stage=jnp.asarray(2 * k + 2, dtype=state.stage.dtype),
        )
        covariance = jnp.where(state.complete, gains.innovation, jnp.nan)
        return after, gaussian_innovation(z, state.expected, covariance)

    @estimates
    def estimate(self, state: ScheduleState) -> Estimate:
        """Return the estimate's mean, with the saved covariance, or NaN once a number that a gain uses was missing."""
        return self._estimate(state, state.stage)

    def after_step(self, state: ScheduleState, k: Step) -> Estimate:
        """Return the estimate after step k, with the covariance saved for step k: one for all runs stepped together."""
        return self._estimate(state, 2 * k + 2)

    def _estimate(self, state: ScheduleState, stage: Step) -> Estimate:
        """Return the mean, with the saved covariance of index `stage`, or NaN once a needed number was missing."""
        claimed = jnp.where(state.complete, jnp.asarray(self.covariances)[stage], jnp.nan)
        return Estimate(state.mean, claimed, self.claim)


def _gains_for_expected_measurement(gains: Gains) -> Gains:
    """Return the gains of steps without data, in which z is replaced by its expected value G s + g.

    The saved recursion is s+ = F s + K z + c, with the estimate L s + J z + d. Without z it becomes
    s+ = (F + K G) s + (c + K g), with the estimate (L + J G) s + (d + J g).
    """
    return gains._replace(
        transition=gains.transition + gains.gain @ gains.expected,
        offset=gains.offset + np.einsum("tim,tm->ti", gains.gain, gains.expected_offset),
        output=gains.output + gains.direct @ gains.expected,
        output_offset=gains.output_offset + np.einsum("tim,tm->ti", gains.direct, gains.expected_offset),
    )


class LinearSystemFilter(AbstractSizedFilter):
    """The best linear filter of a linear system, with its covariance propagated: exact also for data with gaps.

    A component of z that did not arrive is left out of the step, as if that channel were off. Which components arrive
    must not depend on their values.

    Args:
        system: matrices and noise covariances of each step.
        claim: what the covariance is; "exact" by default.
        states: names of the states; x0, x1, ... by default.
    """

    steps: OverTime
    noises: OverTime
    mean: np.ndarray
    covariance: np.ndarray
    projection: np.ndarray

    def __init__(self, system: LinearSystem, claim: Claim = "exact", states: Sequence[str] | None = None):
        """Keep the matrices of each step, factors of the noises, the law of the first state, and the projection.

        The system is y+ = A y + a + w, z = C y + c + v; the plant's states are `projection` y. Of its noises factors
        are computed, to which the rounding of state and measurement is added.
        """
        instance("system", system, LinearSystem, "a LinearSystem")
        self.steps, self.noises = OverTime(system.steps), OverTime(_factor_noises(system))
        self.mean, self.covariance, self.projection = system.mean, system.covariance, system.projection
        self.claim, self.inputs = claim, ()
        self.states = names("state names", states, len(system.projection), "x")
        self.received, self.kept = system.steps.offset.shape[-1], system.kept

    @in_float64
    def init(self) -> Gaussian:
        """Return the Gaussian of the system's state y before the first step."""
        return from_covariance(self.mean, self.covariance)

    @predicts
    def predict(self, state: Gaussian, u: ArrayLike = (), k: Step = 0) -> Gaussian:
        """Predict the system's state over y+ = A y + a + w: mean A m + a, covariance A P A' + Cov w."""
        step: Steps = at(self.steps, k)
        return predict_affine(state, step.transition, step.drift, at(self.noises, k).process)

    @corrects
    def correct(self, state: Gaussian, z: ArrayLike, k: Step = 0) -> tuple[Gaussian, Innovation]:
        """Condition the system's state y = m + L xi on the components of z = C y + c + v that arrived.

        `slopes` are C L, those of z in xi.
        """
        step: Steps = at(self.steps, k)
        z, noise = jnp.asarray(z), at(self.noises, k).measurement
        expected = step.output @ state.mean + step.offset
        slopes = jnp.asarray(step.output @ state.root)
        return condition_on_measurement(state, slopes, noise, z, expected)

    @estimates
    def estimate(self, state: Gaussian) -> Estimate:
        """Return the mean and covariance of the plant's states, by the projection."""
        projection = jnp.asarray(self.projection)
        return Estimate(projection @ state.mean, projection @ state.covariance @ projection.T, self.claim)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step: the regression of the state y before the step on the predicted state.

        With y = m + L xi the prediction is A m + a + A L xi + w: slopes A L in xi, and the noise w.
        """
        slopes = at(self.steps, step.k).transition @ step.before.root
        noise = at(self.noises, step.k).process
        return smoother_step_of(step, (slopes, noise), self.claim, projection=self.projection)

    def planned(self, inputs: Float[Array, "horizon inputs"]) -> AbstractFilter:
        """Return the filter with gains and covariances of each step computed in advance, for complete data."""
        return plan_filter(self, inputs, self.projection)


class SystemNoises(NamedTuple):
    """Factors of Cov w (`process`) and Cov v (`measurement`) of a step y+ = A y + a + w, z = C y + c + v.

    The covariance of the rounding of y is added to the first, that of z to the second.
    """

    process: WeightedColumns
    measurement: WeightedColumns


@in_float64
def _factor_noises(system: LinearSystem) -> SystemNoises:
    """Return the factors of both noises at each step, with the rounding of the state and of the measurement.

    Measurements may repeat each other, and their difference is then only rounding. Without the rounding as a noise,
    this difference would seem to measure the state without noise.
    """
    steps = system.steps
    state_moments, received_moments = _second_moments_of_steps(system)

    def factor(covariances: np.ndarray, second_moments: np.ndarray, errors: np.ndarray) -> WeightedColumns:
        """Return the factors of noises (time, n, n), with the rounding of numbers of second moments (time, n)."""
        rounding = second_moments + np.diagonal(covariances, axis1=1, axis2=2)
        return _factor_with_rounding(factor_covariances(covariances), rounding, errors)

    process = factor(np.asarray(steps.process), state_moments, np.zeros(state_moments.shape))
    return SystemNoises(process, factor(np.asarray(steps.noise), received_moments, system.received_rounding))


@compile_in_float64
def _factor_with_rounding(noise: WeightedColumns, second_moments: Array, rounding_errors: Array) -> WeightedColumns:
    """Return factors L diag(d) L' of each step's noise covariance, to which two diagonal covariances are added.

    They are the rounding of numbers with these second moments, and `rounding_errors`, that of the noise's variances
    themselves. Shapes: noise (steps, n, columns), the others (steps, n).
    """

    def factor_step(noise: WeightedColumns, second_moments: jax.Array, rounding_errors: jax.Array) -> WeightedColumns:
        """Return the factors of a step's noise plus two diagonal covariances: rounding of numbers and of variances."""
        columns_of_errors = WeightedColumns(np.eye(len(rounding_errors)), rounding_errors)
        return triangularise(join_columns(noise, rounding_of(second_moments), columns_of_errors))

    factor_steps: Callable[..., WeightedColumns] = jax.vmap(factor_step)
    return factor_steps(noise, second_moments, rounding_errors)


def _second_moments_of_steps(system: LinearSystem) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds of second moments at each step, of the next state (time, N) and of the measurement (time, m).

    The rounding of a filter's sums is added to its noises, in proportion to these bounds. The rounding of A x + a is
    proportional to the size of its terms. So the bound for x+ = A x + a + w is (|A| root + |a|)^2, with root_i =
    sqrt(E[x_i^2]) before any data, and alike for z = C x + c + v with the next x. An unstable system's moments grow
    without limit; they are kept so small that their squares are finite.
    """
    steps, mean, covariance = system.steps, system.mean, system.covariance
    largest_moment = float(np.finfo(float).max) ** 0.5  # its square is finite
    largest_mean = largest_moment**0.5

    def bound(matrix: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Return (|A| root + |a|)^2 for the present moments of x."""
        root = np.sqrt(mean**2 + np.diagonal(covariance))
        squared: np.ndarray = np.minimum(np.abs(matrix) @ root + np.abs(offset), largest_mean) ** 2
        return squared

    state_moments, received_moments = [], []
    for k in range(len(steps.transition)):
        # Mean and covariance before any data: E x+ = A E x + a, P+ = A P A' + Q; then the bound of z is of x+.
        A, a = steps.transition[k], steps.drift[k]
        state_moments.append(bound(A, a))
        mean = np.clip(A @ mean + a, -largest_mean, largest_mean)
        covariance = np.clip(A @ covariance @ A.T + steps.process[k], -largest_moment, largest_moment)
        received_moments.append(bound(steps.output[k], steps.offset[k]))
    return np.stack(state_moments), np.stack(received_moments)
