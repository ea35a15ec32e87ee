"""What is smoothed: every state given all data (fixed interval), `lag` later steps, or one state (fixed point)."""

import warnings
from itertools import pairwise
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.filters.smoother_step import SmootherStep
from heliograph.model.estimate import Estimate
from heliograph.numerics.check import check_count, fail
from heliograph.numerics.module import Module, readable, unwritten
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Array, Float
from heliograph.smoothing.forward_and_backward_pass import (
    smooth_fixed_interval,
    smooth_fixed_interval_means,
    smooth_fixed_lag,
    smooth_fixed_point,
)

BLOCKS = 10  # parts of a run, whose scatter gives the standard error of the NIS
DEVIATIONS = 3.5  # standard errors of the mean NIS: fewer may be chance
EXCESS = 1.05  # ratio to the expected NIS from which on a warning is given: less does little harm


@compile_on_call
def nis_sums(steps: SmootherStep) -> Float[Array, "5"]:
    """Return five sums of a run by which `nis_test` tests whether the filter is consistent.

    The run is cut into ten blocks of rows. In a block, s is the sum of the squared innovations e' S^-1 e (NIS), and h
    the number of components of e that arrived. The result are the sums over the blocks of s, h, s^2, s h and h^2, or
    zeros for a filter without NIS.
    """
    if steps.nis is None or steps.received is None:
        return jnp.zeros(5)
    return sum_nis_over_blocks(steps.nis, steps.received)


def sum_nis_over_blocks(nis: Float[Array, " time"], received: Float[Array, " time"]) -> Float[Array, "5"]:
    """Return the sums of s, h, s^2, s h and h^2 over blocks, where s sums `nis` in a block and h sums `received`.

    `nis` is the square e' S^-1 e of each step's innovation, and `received` the number of its components that arrived.
    The steps are cut into BLOCKS parts. Their scatter gives the standard error.
    """
    xp = library(nis)  # NumPy or JAX
    time = len(nis)
    count = min(BLOCKS, time)
    edges = [-(-time * i // count) for i in range(count + 1)]  # block i: rows edges[i] to edges[i + 1] - 1
    s, h = (xp.stack([xp.sum(values[begin:end]) for begin, end in pairwise(edges)]) for values in (nis, received))
    sums: Array = xp.stack([xp.sum(values) for values in (s, h, s * s, s * h, h * h)])
    return sums


def nis_test(sums: Float[np.ndarray, "5"]) -> tuple[float, float]:
    """Return the mean squared innovation e' S^-1 e (NIS) per component, 1 if consistent, and its standard error.

    `sums` are those of s, h, s^2, s h and h^2 over blocks, with s the sum of NIS in a block and h its number of
    components. The mean is the ratio sum s / sum h, and its error is sqrt(sum (s - ratio h)^2) / sum h. Without any
    component they are 1 and 0.
    """
    s, h, ss, sh, hh = (float(total) for total in sums)
    if not h:
        return 1.0, 0.0
    ratio = s / h
    squares = ss - 2 * ratio * sh + ratio**2 * hh
    return ratio, float(np.sqrt(max(squares, 0.0))) / h


def warn_if_inconsistent(name: str, sums: Float[np.ndarray, "5"]) -> None:
    """Warn if a filter's squared innovations (NIS) are more than EXCESS times what its model predicts, beyond chance.

    An excess of up to DEVIATIONS standard errors may be chance.

    Args:
        name: what warns, such as "smoothing".
        sums: the five sums that `nis_sums` returns.
    """
    ratio, error = nis_test(sums)
    if ratio > EXCESS and ratio - 1 > DEVIATIONS * error:
        warnings.warn(
            f"{name}: squared innovations are {ratio:.3g} +- {error:.1g} times what the filter believes; of a filter "
            "that is not consistent later data make the claims worse, and perhaps the estimates",
            stacklevel=3,
        )


A = TypeVar("A", jax.Array, np.ndarray)


@readable
class AbstractSmoothing(Module):
    """Choice of the states to be estimated, and of the later data that they are estimated from."""

    def estimates(self, steps: SmootherStep) -> Estimate:
        """Return the estimates along time from smoother steps stacked along time, with the claim that remains.

        Warns if the filter's squared innovations (NIS) show that it is not consistent. Later data may then make the
        estimates worse.
        """
        warn_if_inconsistent("smoothing", np.asarray(nis_sums(steps)))
        return _sweep_compiled(self, steps)

    def sweep(self, steps: SmootherStep) -> Estimate:
        """Return the estimates of one run from its smoother steps, like `estimates`, but traceable and without warning.

        Each kind of smoothing says here how its passes go.
        """
        raise unwritten(self, "sweep")

    def means(self, steps: SmootherStep) -> jax.Array:
        """Return the means alone, where covariances are known from elsewhere."""
        return jnp.asarray(self.sweep(steps).mean)

    def select_reference(self, values: A) -> A:
        """Return for each estimate the value that it estimates, from `values` of each step (..., time, n)."""
        return values

    def check(self, horizon: int) -> None:
        """Raise ValueError if a run of so many steps has no such estimate."""


@compile_on_call
def _sweep_compiled(smoothing: AbstractSmoothing, steps: SmootherStep) -> Estimate:
    """Return `smoothing.sweep(steps)`, the smoothed estimates, from compiled code."""
    return smoothing.sweep(steps)


class FixedInterval(AbstractSmoothing):
    """Smoothing of every state given all data of the run."""

    def sweep(self, steps: SmootherStep) -> Estimate:
        """Return the estimates (time, ...)."""
        return smooth_fixed_interval(steps)

    def means(self, steps: SmootherStep) -> jax.Array:
        """Return the means (time, ...)."""
        return smooth_fixed_interval_means(steps)


class FixedLag(AbstractSmoothing):
    """Smoothing of every state given the data of up to `lag` later steps; at the end of a run there are fewer.

    Args:
        lag: number of later steps, from 0.

    Raises:
        ValueError: a lag that is no whole number from 0.
    """

    lag: int

    def __init__(self, lag: int):
        """Hold the lag: the number of later steps whose data each smoothed estimate uses."""
        self.lag = check_count("lag", lag, least=0)

    def sweep(self, steps: SmootherStep) -> Estimate:
        """Return the estimates (time, ...)."""
        return smooth_fixed_lag(steps, self.lag)


class FixedPoint(AbstractSmoothing):
    """Smoothing of the state after one step, given the data up to it and then up to each later step.

    Args:
        step: number of that step, from 0.

    Raises:
        ValueError: a step that is no whole number from 0.
    """

    step: int = eqx.field(static=True)

    def __init__(self, step: int):
        """Hold the number of the one time step whose state is smoothed."""
        self.step = check_count("step of a fixed point", step, least=0)

    def sweep(self, steps: SmootherStep) -> Estimate:
        """Return the estimates (time from that step on, ...)."""
        return smooth_fixed_point(steps, self.step)

    def select_reference(self, values: A) -> A:
        """Return the value at the smoothed step, once for each estimate of it (..., estimates, n).

        `values` (..., time, n) have one row for each step of the run. The estimates are all of the state after step
        `self.step`, given data up to it, up to the next step, ..., up to the last one.
        """
        repeated: A = values[..., [self.step] * (values.shape[-2] - self.step), :]
        return repeated

    def check(self, horizon: int) -> None:
        """Raise ValueError if the step is not one of the run's."""
        if self.step >= horizon:
            raise fail("step of a fixed point", f"one of the run's {horizon}, counted from 0", self.step)
