"""Linear filters whose gains and covariances are computed for each step before any data; a run only moves the mean."""

from dataclasses import replace
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp

from heliograph.engine.choice import compute_once
from heliograph.engine.size_thresholds import SHORT
from heliograph.filters.base import AbstractFilter, AbstractSizedFilter, Step, corrects, estimates, make_sizes, predicts
from heliograph.filters.innovation import gaussian_innovation
from heliograph.filters.smoother_step import SmootherStep, StepTrace, gaussian_of, with_gaussian
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import OverTime, at
from heliograph.numerics.check import array
from heliograph.numerics.float64 import in_float64, quickly_compiled
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.trace_settings import write_for_derivatives
from heliograph.numerics.types import Array, ArrayLike, Float, Int, PyTree


class LinearStep(NamedTuple):
    """One step of a linear filter: m- = F m + f, m = m- + K (z - C m- - c), with innovation covariance S.

    Shapes: transition F (N, N), drift f (N,), gain K (N, m), output C (m, N), offset c (m,), innovation S (m, m); of
    several filters with a leading axis.
    """

    transition: jax.Array
    drift: jax.Array
    gain: jax.Array
    output: jax.Array
    offset: jax.Array
    innovation: jax.Array

    def predict(self, mean: Float[Array, " N"]) -> Float[jax.Array, " N"]:
        """Return the predicted mean m- = F m + f."""
        return jnp.asarray(self.transition @ mean + self.drift)

    def expect(self, mean: Float[Array, " N"]) -> Float[jax.Array, " m"]:
        """Return the expected measurement C m- + c, from the predicted mean m-."""
        return jnp.asarray(self.output @ mean + self.offset)

    def correct(self, mean: Float[Array, " N"], innovation: Float[jax.Array, " m"]) -> Float[jax.Array, " N"]:
        """Return the corrected mean m = m- + K e, from the predicted mean m- and the innovation e."""
        return jnp.asarray(mean + self.gain @ innovation)

    def error_transition(self) -> Float[jax.Array, "*node N N"]:
        """Return I - K C (N, N), which takes the error of the predicted mean to that of the corrected one."""
        return jnp.asarray(jnp.eye(self.gain.shape[-2]) - self.gain @ self.output)


class PlannedMean(NamedTuple):
    """Mean (N,), and the index of its covariance: 0 at the start, 2 k + 1 before and 2 k + 2 after correction k."""

    mean: Float[jax.Array, " N"]
    stage: Int[jax.Array, ""]


class PlannedFilter(AbstractSizedFilter):
    """A filter whose gains and covariances are known for each step; a run only computes the mean.

    Valid for the inputs that it was planned for, and for complete data: a missing component makes the mean NaN. Built
    by `planned` of a filter whose gains do not depend on data.

    `past`: the smoother steps of each step, whose covariances and gains hold for all data; None if the filter is not
    smoothed.

    Shapes: covariances (2 horizon + 1, n, n), at the start, then before and after each correction; start (N,), the
    first mean; projection (n, N), with xhat = projection m, or None if m is the estimate.
    """

    steps: OverTime
    covariances: Array
    start: Array
    projection: Array | None
    past: OverTime | None = None

    @property
    def is_linear(self) -> bool:
        """True if the mean m that it carries is the estimate itself, not a larger state of which that is a projection.

        A linear filter's estimate is its state's mean; code that replaces means in a state relies on that.
        """
        return self.projection is None

    @in_float64
    def init(self) -> PlannedMean:
        """Return the initial mean, with the index 0 of its covariance."""
        return PlannedMean(jnp.asarray(self.start), jnp.asarray(0))

    @predicts
    def predict(self, state: PlannedMean, u: ArrayLike = (), k: Step = 0) -> PlannedMean:
        """Return F m + f. The filter was planned for its inputs, which f includes, so u is not used."""
        step: LinearStep = at(self.steps, k)
        return PlannedMean(step.predict(state.mean), _convert_stage(state, 2 * k + 1))

    @corrects
    def correct(self, state: PlannedMean, z: ArrayLike, k: Step = 0) -> tuple[PlannedMean, Innovation]:
        """Return the mean m + K (z - C m - c), with the recorded gain K, output C and offset c of step k.

        The stage counts predictions and corrections, and is 2 k + 2 after this one.
        """
        step: LinearStep = at(self.steps, k)
        z, expected = jnp.asarray(z), step.expect(state.mean)
        mean = step.correct(state.mean, z - expected)
        after = PlannedMean(mean, _convert_stage(state, 2 * k + 2))
        return after, gaussian_innovation(z, expected, step.innovation)

    @estimates
    def estimate(self, state: PlannedMean) -> Estimate:
        """Return the state's mean, with the covariance that was computed in advance for this stage of the run."""
        return self._estimate(state.mean, state.stage)

    def after_step(self, state: PlannedMean, k: Step) -> Estimate:
        """Return the state's mean, with the covariance computed in advance for step k.

        As k is the same of all runs that are stepped together, they share one covariance.
        """
        return self._estimate(state.mean, 2 * k + 2)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step: gains and covariances planned in `self.past`, and the means of this run.

        Without planned smoother steps (None) the filter cannot be smoothed, and the base class raises an error.
        """
        if self.past is None:
            return super().smoother_step(step)
        planned = cast(SmootherStep, at(self.past, step.k))
        before, prior, after = (jnp.asarray(state.mean) for state in (step.before, step.prior, step.after))
        return planned.with_data(before, prior, after)

    def with_past(self, steps: SmootherStep) -> AbstractFilter:
        """Return the filter with smoother `steps`, whose gains and covariances are the same for all data."""
        return replace(self, past=OverTime(steps))

    def _estimate(self, mean: Float[Array, " N"], stage: Step) -> Estimate:
        """Return the estimate of the plant's state, projection m, with the planned covariance of a stage.

        `stage` is the index of the covariance: 0 at the start, 2 k + 1 before and 2 k + 2 after correction k.
        """
        x = mean if self.projection is None else self.projection @ mean
        return Estimate(x, jnp.asarray(self.covariances)[stage], self.claim)


def _convert_stage(state: PlannedMean, stage: Step) -> jax.Array:
    """Return a stage, the index of a covariance, in the integer type that the state has: loops need one type."""
    return jnp.asarray(stage, dtype=jnp.asarray(state.stage).dtype)


def plan_filter(
    filter: AbstractFilter, inputs: Float[Array, "horizon inputs"], projection: Array | None = None
) -> PlannedFilter:
    """Return the filter with its matrices of each step recorded, for these inputs and complete data.

    The filter's state is a Gaussian, or holds one. Only its mean may depend on data, and only affinely. So the matrices
    F (prediction), K (gain) and C (output) are derivatives that are the same at every mean. `projection` (n, N) maps
    the filter's mean to the plant's states.
    """
    arguments = filter, array("inputs", inputs, (None, len(filter.inputs))), projection
    if is_traced(arguments):
        with write_for_derivatives():  # they are derivatives of covariances, also where these are zero
            return _record_matrices(*arguments)
    return cast(PlannedFilter, compute_once(_record_matrices, _plan_by_xla, arguments, most=SHORT))


def _record_matrices(filter: AbstractFilter, inputs: Array, projection: Array | None) -> PlannedFilter:
    """Return the filter with its gains and covariances of every step, recorded while it runs over data of zeros.

    Its gains and covariances do not depend on data, so later runs compute only means, from these stored matrices.

    Args:
        filter: a filter in which only the mean depends on data.
        inputs: of each step (steps, inputs).
        projection: (n, N), maps the filter's mean and covariance to those of the plant's state; None where they are
            these already.
    """
    # Complete data of zeros: the matrices do not depend on their values.
    zeros = jnp.zeros(filter.received)

    def record_step(state: PyTree, row: tuple[jax.Array, jax.Array]) -> tuple[PyTree, tuple[LinearStep, jax.Array]]:
        """Step the filter; return its state, and the step's matrices with the covariances before and after correction.

        The measurement is `zeros`, since the matrices depend on no value of it. `projection` maps the filter's mean to
        the plant's states.
        """
        k, u = row
        step, prior, after = record_step_matrices(filter, state, zeros, u, k)
        covariances = jnp.stack([_project_covariance(prior, projection), _project_covariance(after, projection)])
        return after, (step, covariances)

    start = filter.init()
    start = jax.tree.map(jnp.asarray, start)
    _, (steps, covariances) = jax.lax.scan(record_step, start, (jnp.arange(len(inputs)), jnp.asarray(inputs)))
    # Covariances in the order of `PlannedMean.stage`: at the start, then before and after correction of each step.
    in_order = covariances.reshape(-1, *covariances.shape[2:])
    by_stage = jnp.concatenate([_project_covariance(start, projection)[None], in_order])
    return PlannedFilter(
        steps=OverTime(steps),
        covariances=by_stage,
        start=gaussian_of(start).mean,
        projection=projection,
        **make_sizes(filter.claim, filter, filter.received),
    )


_plan_by_xla = quickly_compiled(_record_matrices)


def record_step_matrices(
    filter: AbstractFilter, state: PyTree, z: jax.Array, u: jax.Array, k: Step
) -> tuple[LinearStep, PyTree, PyTree]:
    """Return the matrices of step k, the state after its prediction, and that after its correction.

    With these matrices, stored in advance, a step of the filter is m- = F m + f and m = m- + K (z - C m- - c).

    Args:
        filter: a filter in which only the mean depends on data, by an affine function.
        state: state of the filter before the step, with mean m. Its mean does not matter for the matrices; the returned
            states have started from mean 0.
        z: measurement (m,), NaN where a component did not arrive.
        u: input.
        k: number of the step.
    """
    # F and f: the prior mean is affine in the mean, so that f is its value and F its derivative at 0.
    zero_mean = jnp.zeros_like(gaussian_of(state).mean)

    def predict(mean: jax.Array) -> tuple[jax.Array, PyTree]:
        """Return the predicted mean as a function of the mean before, to be differentiated, and the predicted state."""
        prior = filter.predict(_with_mean(state, mean), u, k)
        return jnp.asarray(gaussian_of(prior).mean), prior

    transition, prior = jax.jacfwd(predict, has_aux=True)(zero_mean)
    # K = dm+/dz. The innovation is e = z - C m- - c: C = -de/dm-, and c = -e at m- = 0 and z = 0.
    slopes = _differentiate_correction(filter, prior, zero_mean, z, k)
    step = LinearStep(
        transition=transition,
        drift=jnp.asarray(gaussian_of(prior).mean),
        gain=slopes.mean_by_z,
        output=-slopes.innovation_by_mean,
        offset=-jnp.asarray(slopes.innovation.value),
        innovation=jnp.asarray(slopes.innovation.covariance),
    )
    return step, prior, slopes.after


def _with_mean(state: PyTree, mean: jax.Array) -> PyTree:
    """Return a filter's state with another mean (N,): the state is a Gaussian, or holds one."""
    return with_gaussian(state, gaussian_of(state)._replace(mean=mean))


class CorrectionSlopes(NamedTuple):
    """Derivatives of a correction: of the corrected mean by z (N, m), and of the innovation by the prior mean (m, N).

    `after` and `innovation` are the corrected state and the innovation themselves.
    """

    mean_by_z: jax.Array
    innovation_by_mean: jax.Array
    after: PyTree
    innovation: Innovation


def _differentiate_correction(
    filter: AbstractFilter, prior: PyTree, mean: jax.Array, z: jax.Array, k: Step
) -> CorrectionSlopes:
    """Differentiate the filter's correction of the state `prior`, with the mean `mean` (N,), by z (m,) at step k."""

    def correct(mean: jax.Array, z: jax.Array) -> tuple[tuple[jax.Array, jax.Array], PyTree]:
        """Return the corrected mean and the innovation e, as functions of the prior mean and z, to be differentiated.

        The second result, not differentiated, is the corrected state and the whole innovation.
        """
        after, innovation = filter.correct(_with_mean(prior, mean), z, k)
        return (jnp.asarray(gaussian_of(after).mean), jnp.asarray(innovation.value)), (after, innovation)

    # Each derivative is a pair: by the prior mean, and by z.
    slopes, (after, innovation) = jax.jacfwd(correct, (0, 1), has_aux=True)(mean, z)
    (_, mean_by_z), (innovation_by_mean, _) = slopes
    return CorrectionSlopes(mean_by_z, innovation_by_mean, after, innovation)


def linear_step(filter: AbstractFilter, state: PyTree, z: jax.Array, u: jax.Array, k: Step) -> LinearStep:
    """Return the matrices of one step of a filter in which only the mean depends on data.

    z matters only by what arrived. A component that did not arrive has zeros in its column of the gain and in its rows
    of output and offset.
    """
    if isinstance(filter, PlannedFilter):
        recorded: LinearStep = at(filter.steps, k)
        return recorded
    step, _, _ = record_step_matrices(filter, state, jnp.where(jnp.isnan(z), z, 0.0), u, k)
    present = ~jnp.isnan(z)
    return step._replace(
        gain=jnp.where(present, step.gain, 0.0),
        output=jnp.where(present[:, None], step.output, 0.0),
        offset=jnp.where(present, step.offset, 0.0),
    )


class LinearisedStep(NamedTuple):
    """One step of a filter linearised at its estimate: x- = m- + e-, e+ = e- - K (C e- + nu), S = Cov nu.

    Shapes: predicted m- (n,), gain K (n, m), output C (m, n), noise S (m, m); zero for what did not arrive.
    """

    predicted: jax.Array
    gain: jax.Array
    output: jax.Array
    noise: jax.Array


def linearise_step(filter: AbstractFilter, state: PyTree, z: jax.Array, u: jax.Array, k: Step) -> LinearisedStep:
    """Linearise a filter's correction at its predicted mean m-, with the predicted covariance P fixed.

    The filter's state is a Gaussian, or holds one. The innovation e = z - zhat(m-) gives C = dzhat/dm- = -de/dm-, the
    gain is K = dm+/dz, and the rest of z has the covariance S = Cov(e) - C P C'. Rows and columns of components that
    did not arrive are zero.
    """
    prior = filter.predict(state, u, k)
    x = gaussian_of(prior)
    slopes = _differentiate_correction(filter, prior, jnp.asarray(x.mean), z, k)
    present = ~jnp.isnan(z)
    output = jnp.where(present[:, None], -slopes.innovation_by_mean, 0.0)
    innovation_covariance = jnp.where(present[:, None] & present, slopes.innovation.covariance, 0.0)
    return LinearisedStep(
        predicted=x.mean,
        gain=jnp.where(present, slopes.mean_by_z, 0.0),
        output=output,
        noise=innovation_covariance - output @ x.covariance @ output.T,
    )


def _project_covariance(state: PyTree, projection: Array | None) -> jax.Array:
    """Return the covariance of the plant's state x = projection m: projection P projection', (n, n).

    `state` is a filter's state with mean m and covariance P; without a projection m is x itself.
    """
    covariance = jnp.asarray(gaussian_of(state).covariance)
    return covariance if projection is None else jnp.asarray(projection) @ covariance @ jnp.asarray(projection).T
