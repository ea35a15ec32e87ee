"""Passes over the smoother steps of one run: back from its end, back over a lag, or ahead with one state."""

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compiled
from heliograph.filters.base import AbstractFilter
from heliograph.filters.rows import data_of
from heliograph.filters.smoother_step.base import AbstractSmootherStep, Moments, Point
from heliograph.model.estimate import Estimate
from heliograph.numerics.check import check_count, instance
from heliograph.numerics.over_runs import runs_last
from heliograph.numerics.types import Array, ArrayLike, Float, Int, PyTree

T = TypeVar("T")


def smoother_steps(
    filter: "AbstractFilter",
    measurements: Float[ArrayLike, "steps received"],
    inputs: Float[ArrayLike, "steps inputs"] | None = None,
    state: PyTree | None = None,
    first_step: int = 0,
) -> "tuple[PyTree, AbstractSmootherStep]":
    """Step a filter over rows of data: its state after them, and its smoother steps stacked along time.

    Args:
        filter: a filter that can be smoothed.
        measurements: rows (steps, received), or (steps,) of one number; NaN for what did not arrive.
        inputs: rows (steps, inputs); by default a filter without inputs is assumed.
        state: state before the first row; the filter's initial state by default.
        first_step: number of the first row's step; 0 by default.

    Raises:
        ValueError: arrays that are not the filter's, a step that is none, a filter that cannot be smoothed.
    """
    instance("filter", filter, AbstractFilter, "a filter, such as kalman_filter(...)")
    z, u = data_of(filter, measurements, inputs)
    first = np.asarray(check_count("first step", first_step, 0))
    return stepped(filter, z, u, filter.init() if state is None else state, first)


@compiled
def stepped(
    filter: AbstractFilter, z: Array, u: Array, state: PyTree, first: Array
) -> tuple[PyTree, AbstractSmootherStep]:
    """Step a filter over rows of data inside a compiled computation, like `smoother_steps`."""

    def body(state: PyTree, row: tuple[jax.Array, ...]) -> tuple[PyTree, AbstractSmootherStep]:
        return filter.step_with_smoother(state, *row)

    rows = jnp.asarray(z), jnp.asarray(u), jnp.asarray(first + jnp.arange(len(z)))
    return jax.lax.scan(body, jax.tree.map(jnp.asarray, state), rows)


def planned_with_past(filter: AbstractFilter, inputs: Array) -> AbstractFilter:
    """Plan the filter for these inputs and complete data, with its smoother steps but for their data."""
    planned = filter.planned(inputs)
    if planned is filter:
        return filter
    return planned.with_past(quiet_steps(filter, inputs))


def quiet_steps(filter: AbstractFilter, inputs: Array) -> AbstractSmootherStep:
    """Smoother steps for measurements of zero: right but for means, if no gain depends on data."""
    quiet = jnp.zeros((len(inputs), filter.received))
    steps: AbstractSmootherStep = stepped(filter, quiet, inputs, filter.init(), np.asarray(0))[1]
    return steps


def swept(steps: AbstractSmootherStep) -> Estimate:
    """Estimate each step's state given all data: one backward pass."""
    return Estimate(*_both(steps), steps.claim)


def swept_means(steps: AbstractSmootherStep) -> jax.Array:
    """Means of each step's state given all data."""
    return _means(steps)


@runs_last
def _both(steps: AbstractSmootherStep) -> tuple[jax.Array, jax.Array]:
    return _back(steps)


@runs_last
def _means(steps: AbstractSmootherStep) -> jax.Array:
    return _back(steps)[0]


def _back(steps: AbstractSmootherStep) -> tuple[jax.Array, jax.Array]:
    """Smoothed means and covariances; any further axes are carried along, so that runs may be the last."""

    def estimate_from(step: AbstractSmootherStep, moments: Moments) -> tuple[jax.Array, jax.Array]:
        estimate = step.estimate_from(moments)
        return jnp.asarray(estimate.mean), jnp.asarray(estimate.covariance)

    # One step back: the adjoint or the moments, and the smoothed state before the step.
    def body(carry: PyTree, pair: tuple[AbstractSmootherStep, AbstractSmootherStep]) -> tuple[PyTree, PyTree]:
        (later, known), (before, step) = carry, pair
        earlier = step.back(later, before.mean, before.covariance)
        moments = step.before(before, earlier, known)
        return (earlier, moments), estimate_from(before, moments)

    # From the last step, whose smoothed state is the filtered one.
    last = row(steps, -1)
    start = last.end(), last.smoothed(last.end())
    if len(steps.mean) == 1:
        mean, covariance = estimate_from(last, start[1])
        return mean[None], covariance[None]
    rows = rows_of(steps, slice(None, -1)), rows_of(steps, slice(1, None))
    shapes, _ = jax.eval_shape(body, start, row(rows, -1))  # of what runs share, their axis is 1 long
    end = jax.tree.map(lambda leaf, like: jnp.broadcast_to(leaf, like.shape), start, shapes)
    _, smoothed = jax.lax.scan(body, end, rows, reverse=True)
    mean, covariance = (
        jnp.concatenate([a, b[None]]) for a, b in zip(smoothed, estimate_from(last, end[1]), strict=True)
    )
    return mean, covariance


def swept_over_lag(steps: AbstractSmootherStep, lag: int | Int[Array, ""]) -> Estimate:
    """Estimate each step's state given up to `lag` later steps: as many short backward passes, in parallel."""
    last = len(steps.mean) - 1
    times = jnp.arange(last + 1)
    # Begin at the newest step that each one may use.
    ends = rows_of(steps, jnp.minimum(times + lag, last))
    newest = jax.vmap(lambda step: step.end())(ends)
    start = newest, jax.vmap(lambda step, later: step.smoothed(later))(ends, newest)

    def body(done: jax.Array, carry: tuple[PyTree, Moments]) -> tuple[PyTree, Moments]:
        """Pass from the state after step k + lag - done to the one before it, unless the data end earlier."""
        later, known = carry
        ahead = times + lag - done
        index = jnp.minimum(ahead, last)
        here, before = rows_of(steps, index), rows_of(steps, jnp.maximum(index - 1, 0))
        earlier = jax.vmap(lambda step, *rest: step.back(*rest))(here, later, before.mean, before.covariance)
        moments = jax.vmap(lambda step, *rest: step.before(*rest))(here, before, earlier, known)
        both: tuple[PyTree, Moments] = jax.tree.map(
            lambda a, b: jnp.where((ahead <= last).reshape(-1, *[1] * (a.ndim - 1)), a, b), (earlier, moments), carry
        )
        return both

    # As many steps back as the lag has.
    _, outcome = jax.lax.fori_loop(0, lag, body, start)
    estimate: Estimate = jax.vmap(lambda step, moments: step.estimate_from(moments))(steps, outcome)
    return estimate


def carried_ahead(steps: AbstractSmootherStep, step: int) -> Estimate:
    """Estimate the state after one step given the data up to it, and up to each later one."""
    start = row(steps, step)

    def body(point: Point, step_and_prior: tuple[AbstractSmootherStep, jax.Array]) -> tuple[Point, Moments]:
        here, before = step_and_prior
        after = here.ahead(point, before)
        return after, Moments(after.mean, after.covariance)

    rows = rows_of(steps, slice(step + 1, None)), steps.covariance[step:-1]
    _, outcome = jax.lax.scan(body, start.start(), rows)
    first = Moments(start.mean, start.covariance)
    whole = jax.tree.map(lambda leaf, rest: jnp.concatenate([leaf[None], rest]), first, outcome)
    estimate: Estimate = jax.vmap(start.estimate_from)(whole)
    return estimate


def row(steps: T, k: int) -> T:
    """Return one step of what is stacked along time."""
    step: T = jax.tree.map(lambda leaf: leaf[k], steps)
    return step


def rows_of(steps: T, which: slice | jax.Array) -> T:
    """Return some steps of what is stacked along time."""
    chosen: T = jax.tree.map(lambda leaf: leaf[which], steps)
    return chosen
