"""Passes of a smoother: the filter's pass ahead, which collects a smoother step of each row, and passes over these.

These go back from the end of a run (fixed interval), back over each lag, or ahead with one state (fixed point).
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.base import AbstractFilter
from heliograph.filters.rows.run_over_data import check_data
from heliograph.filters.smoother_step import EarlierState, SmootherStep
from heliograph.model.estimate import Estimate
from heliograph.numerics.check import check_count, instance
from heliograph.numerics.types import Array, ArrayLike, Float, Int, PyTree

T = TypeVar("T")


def smoother_steps(
    filter: "AbstractFilter",
    measurements: Float[ArrayLike, "steps received"],
    inputs: Float[ArrayLike, "steps inputs"] | None = None,
    state: PyTree | None = None,
    first_step: int = 0,
) -> "tuple[PyTree, SmootherStep]":
    """Step a filter over rows of data; return its state after them, and its smoother steps stacked along time.

    A smoother step holds what a backward pass needs of a row: the filtered law, and the regression of the state before
    the row on the state after it.

    Args:
        filter: a filter that can be smoothed.
        measurements: rows (steps, received), or (steps,) of one number; NaN for what did not arrive.
        inputs: rows (steps, inputs); by default there are none, as for a filter without inputs.
        state: state before the first row; the filter's initial state by default.
        first_step: number of the first row's step; 0 by default.

    Raises:
        ValueError: arrays of other sizes than the filter's, a wrong step number, a filter that cannot be smoothed.
    """
    # Check the filter, the rows and the number of the first step.
    instance("filter", filter, AbstractFilter, "a filter, such as kalman_filter(...)")
    z, u = check_data(filter, measurements, inputs)
    first = np.asarray(check_count("first step", first_step, least=0))
    start = filter.init() if state is None else state
    return filter_rows_with_smoother_steps(filter, z, u, start, first)


@compile_on_call
def filter_rows_with_smoother_steps(
    filter: AbstractFilter, z: Array, u: Array, state: PyTree, first: Array
) -> tuple[PyTree, SmootherStep]:
    """Run a filter over rows of data; return its state after them, and the smoother steps stacked along time.

    A smoother step is what a backward pass needs of a row. The measurements z and the inputs u must be checked arrays.
    `state` is the state before the first row, and `first` the number of its step.
    """

    def body(state: PyTree, row: tuple[jax.Array, ...]) -> tuple[PyTree, SmootherStep]:
        """Return the filter's state after a row (z, u, k), and the smoother step of this row."""
        return filter.step_with_smoother(state, *row)

    rows = jnp.asarray(z), jnp.asarray(u), jnp.asarray(first + jnp.arange(len(z)))
    return jax.lax.scan(body, jax.tree.map(jnp.asarray, state), rows)


def plan_with_smoother_steps(filter: AbstractFilter, inputs: Array) -> AbstractFilter:
    """Return the filter planned for these inputs and complete data, with its smoother steps except their means.

    A planned filter has covariances and gains that were computed in advance. If they depend on data, the filter is
    returned as it is.
    """
    planned = filter.planned(inputs)
    if planned is filter:
        return filter
    return planned.with_past(data_free_smoother_steps(filter, inputs))


def data_free_smoother_steps(filter: AbstractFilter, inputs: Array) -> SmootherStep:
    """Return the smoother steps for z = 0, of a filter whose covariances and gains depend on no data.

    Their covariances and gains are those for any data. Their means will be replaced by those that the data give.
    `inputs` has a row for each step.
    """
    zeros = jnp.zeros((len(inputs), filter.received))
    steps: SmootherStep
    _, steps = filter_rows_with_smoother_steps(filter, zeros, inputs, filter.init(), np.asarray(0))
    return steps


def smooth_fixed_interval(steps: SmootherStep) -> Estimate:
    """Estimate each step's state given all data, by one backward pass over smoother steps, stacked along time.

    The pass begins with the filtered law after the last step, given which each step's law follows from that of the step
    after it.
    """

    def body(later: Gaussian, pair: tuple[SmootherStep, SmootherStep]) -> tuple[Gaussian, Estimate]:
        """Smooth the state between two steps from `later`, the smoothed law of the state after both.

        Returns its law, which the pass goes on with, and the estimate of the plant's state.
        """
        previous, step = pair
        law = step.back(later)
        return law, previous.estimate_from(law)

    # From the last step, whose smoothed state is the filtered one.
    last = take_step(steps, -1)
    _, earlier = jax.lax.scan(body, last.end, _pair_with_next(steps), reverse=True)
    return _append_last(earlier, last.estimate_from(last.end))


def smooth_fixed_interval_means(steps: SmootherStep) -> jax.Array:
    """Return the mean (steps, n) of each step's state given all data, by one backward pass over smoother steps.

    It is `smooth_fixed_interval` without covariances, where these are known from elsewhere.
    """

    def body(later: jax.Array, pair: tuple[SmootherStep, SmootherStep]) -> tuple[jax.Array, jax.Array]:
        """Smooth the mean of the state between two steps from `later`, the smoothed mean of the state after both.

        Returns the filter's mean, which the pass goes on with, and the plant's part of it.
        """
        previous, step = pair
        mean = step.mean_back(later)
        return mean, _take_plant_mean(previous, mean)

    last = take_step(steps, -1)
    end = jnp.asarray(last.mean)
    _, earlier = jax.lax.scan(body, end, _pair_with_next(steps), reverse=True)
    return _append_last(earlier, _take_plant_mean(last, end))


def smooth_fixed_lag(steps: SmootherStep, lag: int | Int[Array, ""]) -> Estimate:
    """Estimate each step's state given up to `lag` later steps.

    For each step k there is a short backward pass, from the filtered law after step k + lag to that after step k. All
    these passes run in parallel, `lag` steps of each. A law is a mean and a covariance.

    Args:
        steps: the filter's steps (leading axis: time): each has its filtered law, and passes a smoothed law one back.
        lag: number of later steps whose data an estimate may use.
    """
    last = len(steps.mean) - 1
    k = jnp.arange(last + 1)

    def pass_one_step_back(passes: jax.Array, laws: Gaussian) -> Gaussian:
        """Smooth, in the pass of each step k, the state before step j = k + lag - passes from that after it.

        `laws` are the smoothed laws after the steps j, and `passes` is the number of steps passed so far. If j is
        beyond the step `last`, where the data end, the law stays.
        """
        j = k + lag - passes
        laws_before = jax.vmap(lambda step, law: step.back(law))(take_steps(steps, jnp.minimum(j, last)), laws)
        has_data = j <= last

        def choose(passed: jax.Array, unchanged: jax.Array) -> jax.Array:
            """Return the entries of `passed` in passes whose step j has data, and of `unchanged` in all others."""
            return jnp.where(has_data.reshape(-1, *[1] * (passed.ndim - 1)), passed, unchanged)

        chosen: Gaussian = jax.tree.map(choose, laws_before, laws)
        return chosen

    # The pass of step k begins with the filtered law after step k + lag, or after the last step.
    filtered = take_steps(steps.end, jnp.minimum(k + lag, last))
    smoothed = jax.lax.fori_loop(0, lag, pass_one_step_back, filtered)
    estimate: Estimate = jax.vmap(lambda step, law: step.estimate_from(law))(steps, smoothed)
    return estimate


def smooth_fixed_point(steps: SmootherStep, step: int) -> Estimate:
    """Estimate the state x_j after the step number j = `step`, given the data up to it, and up to each later step.

    Returns the stacked estimates, one for each of these ends of the data.

    Args:
        steps: the filter's smoother steps, stacked along time.
        step: number j of the step.
    """
    fixed_step = take_step(steps, step)

    def body(fixed_state: EarlierState, later_step: SmootherStep) -> tuple[EarlierState, Estimate]:
        """Update x_j by the data of a later step, and estimate it given all data up to there.

        `fixed_state` is the regression of x_j on the present state: each later step first carries the regression to the
        new present state. `fixed_step` is the smoother step number j.
        """
        updated = later_step.ahead(fixed_state)  # x_j regressed on the state after the later step
        law = later_step.find_law_of_earlier(updated)
        # Attitudes in `law` are rotation vectors from the filtered mean after step j.
        return updated, fixed_step.estimate_from(fixed_step.settle(law))

    _, later = jax.lax.scan(body, fixed_step.start(), take_steps(steps, slice(step + 1, None)))
    filtered = fixed_step.estimate_from(fixed_step.after)
    estimates: Estimate = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), filtered, later)
    return estimates


def _take_plant_mean(step: SmootherStep, mean: jax.Array) -> jax.Array:
    """Return the mean of the plant's state, projection m + offset, for a mean m of the filter's state.

    A filter's state may hold more than the plant's, such as delayed values or learned parameters.
    """
    return jnp.asarray(step.estimate_from(step.after._replace(mean=mean)).mean)


def _pair_with_next(steps: SmootherStep) -> tuple[SmootherStep, SmootherStep]:
    """Return the steps k = 0 ... last - 1 and the steps k + 1, so that a scan sees each step with the next one."""
    return take_steps(steps, slice(None, -1)), take_steps(steps, slice(1, None))


def _append_last(rows: T, last: T) -> T:
    """Append the last step's value to those of the steps before."""
    whole: T = jax.tree.map(lambda leaf, end: jnp.concatenate([leaf, end[None]]), rows, last)
    return whole


def take_step(steps: T, k: int) -> T:
    """Return entry k of arrays that are stacked along time."""
    step: T = jax.tree.map(lambda leaf: leaf[k], steps)
    return step


def take_steps(steps: T, which: slice | jax.Array) -> T:
    """Return some entries of arrays that are stacked along time."""
    chosen: T = jax.tree.map(lambda leaf: leaf[which], steps)
    return chosen
