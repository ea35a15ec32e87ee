"""Log-likelihood of recorded data under a filter's model: the sum over its innovations."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.rows.chunks import sum_filtered_in_chunks
from heliograph.filters.rows.run_over_data import check_data, step_over_known_rows
from heliograph.model.estimate import Innovation
from heliograph.numerics.check import instance
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.types import Array, ArrayLike, Float, PyTree, Scalar


def log_likelihood(
    filter: AbstractFilter,
    measurements: Float[ArrayLike, "steps received"],
    inputs: Float[ArrayLike, "steps inputs"] | None = None,
) -> Scalar:
    """Return log p(z_1, z_2, ...) under the filter's model: the sum of its innovations' log-likelihoods, in nats.

    It is exact for the Kalman filter of a linear Gaussian system. For other filters it is nominal, but a fit can still
    maximise it. Many rows are taken in chunks side by side, as by `filter.run`.

    `jax.grad` passes through it, in any number that the filter is made of, in the precision of the trace
    (`jax.enable_x64`). In double precision the derivatives by covariances are right also where these are zero or
    singular: there they are one-sided, as no variance is negative. Where some components of z are determined by others,
    the derivatives are those of the density of the free components. Derivatives are NaN, not wrong, where a state is
    known by `side_information_filter`, `clock_filter`, or a transform of one's own that has `apply` alone; where the
    model excludes z; and where a variance of zero moves a mean into `limits=`. Second derivatives along variances of
    zero cannot be had, but for `kalman_filter` of a known start and `linear_filter`: twice along one they are not
    finite, along two they may be beyond 1e80.

    Args:
        filter: the filter.
        measurements: rows (steps, received); NaN did not arrive and adds nothing.
        inputs: rows (steps, inputs); by default a filter without inputs is assumed.

    Returns:
        The sum; NaN from the row on at which the filter's estimate is no number.

    Raises:
        ValueError: measurements or inputs of the wrong shape, infinite values, more steps than the filter covers.

    Source: Schweppe, Evaluation of likelihood functions for Gaussian signals (1965).
    """
    instance("filter", filter, AbstractFilter, "a filter")
    # Traced by JAX, as in a gradient: by a scan that can be differentiated.
    arguments = filter, *check_data(filter, measurements, inputs)
    if is_traced(arguments):
        return filter.trace_log_likelihood(_sum_log_likelihoods, *arguments[1:])
    # Numbers: in chunks side by side if the filter can; else row by row.
    total = sum_filtered_in_chunks(*arguments, _judge_likelihood)
    if total is not None:  # None: the filter cannot be run in chunks
        return float(total)
    _, log_likelihoods = step_over_known_rows(*arguments, _judge_likelihood)
    return float(np.sum(log_likelihoods))


def _sum_log_likelihoods(
    filter: AbstractFilter, z: Float[Array, "steps m"], u: Float[Array, "steps inputs"]
) -> jax.Array:
    """Return the sum of the innovations' log-likelihoods over all rows, filtered one after another."""
    log_likelihoods = filter.scan(z, u, partial(_judge_likelihood, filter))
    return jnp.sum(log_likelihoods)


def _judge_likelihood(filter: AbstractFilter, state: PyTree, innovation: Innovation, k: Array) -> jax.Array:
    """Return the log-likelihood of a row's innovation; NaN where the estimate is no number.

    Without the NaN such a row would add 0, as one in which nothing arrived.
    """
    lost = jnp.any(jnp.isnan(jnp.asarray(filter.estimate(state).mean)))
    return jnp.where(lost, jnp.nan, innovation.log_likelihood)
