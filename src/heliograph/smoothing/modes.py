"""Smoothing modes: fixed interval, fixed lag and fixed point."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.smoother_step.base import AbstractSmootherStep
from heliograph.model.estimate import Estimate
from heliograph.numerics.check import check_count, fail
from heliograph.numerics.float64 import compiled
from heliograph.numerics.module import Module
from heliograph.numerics.readable import readable
from heliograph.smoothing.backward_pass import carried_ahead, swept, swept_means, swept_over_lag
from heliograph.smoothing.consistency import nis_sums, warn_of

A = TypeVar("A", jax.Array, np.ndarray)


@readable
class AbstractSmoothing(Module):
    """Choice of the states to be estimated, and of the later data that they are estimated from."""

    def estimates(self, steps: AbstractSmootherStep) -> Estimate:
        """Estimates along time from smoother steps stacked along time, with the claim that remains.

        Warns where the NIS of the filter says that it is not consistent: later data then make estimates worse.
        """
        warn_of("smoothing", np.asarray(nis_sums(steps)))
        return _swept(self, steps)

    def sweep(self, steps: AbstractSmootherStep) -> Estimate:
        """Compute the estimates of one run, like `estimates`, inside a compiled computation."""
        raise NotImplementedError

    def means(self, steps: AbstractSmootherStep) -> jax.Array:
        """Means alone, where covariances are known from elsewhere."""
        return jnp.asarray(self.sweep(steps).mean)

    def covariances(self, steps: AbstractSmootherStep) -> jax.Array:
        """Covariances alone, whatever the data were."""
        return jnp.asarray(self.sweep(steps.without_data()).covariance)

    def about(self, values: A) -> A:
        """Select from `values` along time (..., time, n), such as the true state, those that the estimates refer to."""
        return values

    def check(self, horizon: int) -> None:
        """Raise ValueError if a run of so many steps has no such estimate."""


@compiled
def _swept(smoothing: AbstractSmoothing, steps: AbstractSmootherStep) -> Estimate:
    return smoothing.sweep(steps)


class FixedInterval(AbstractSmoothing):
    """Smoothing of every state given all data of the run."""

    def sweep(self, steps: AbstractSmootherStep) -> Estimate:
        """Estimates (time, ...)."""
        return swept(steps)

    def means(self, steps: AbstractSmootherStep) -> jax.Array:
        """Means (time, ...)."""
        return swept_means(steps)


class FixedLag(AbstractSmoothing):
    """Smoothing of every state given the data of up to `lag` later steps; at the end of a run there are fewer.

    Args:
        lag: number of later steps, from 0.

    Raises:
        ValueError: a lag that is no whole number from 0.
    """

    lag: int

    def __init__(self, lag: int):
        self.lag = check_count("lag", lag, 0)

    def sweep(self, steps: AbstractSmootherStep) -> Estimate:
        """Estimates (time, ...)."""
        return swept_over_lag(steps, self.lag)


class FixedPoint(AbstractSmoothing):
    """Smoothing of the state after one step, given the data up to it and then up to each later step.

    Args:
        step: number of that step, from 0.

    Raises:
        ValueError: a step that is no whole number from 0.
    """

    step: int = eqx.field(static=True)

    def __init__(self, step: int):
        self.step = check_count("step of a fixed point", step, 0)

    def sweep(self, steps: AbstractSmootherStep) -> Estimate:
        """Estimates (time from that step on, ...)."""
        return carried_ahead(steps, self.step)

    def about(self, values: A) -> A:
        """Repeat the value of that step, once per estimate of it."""
        result: A = values[..., [self.step] * (values.shape[-2] - self.step), :]
        return result

    def check(self, horizon: int) -> None:
        """Raise ValueError if the step is not one of the run's."""
        if self.step >= horizon:
            raise fail("step of a fixed point", f"one of the run's {horizon}, counted from 0", self.step)


def named_smoothing(name: str) -> AbstractSmoothing | None:
    """Smoothing by a word of the command line: "all" for the fixed interval, a number for a lag, nothing for none.

    Raises:
        ValueError: another word.
    """
    if name == "":
        return None
    if name == "all":
        return FixedInterval()
    if not (name.isascii() and name.isdecimal()):
        raise fail("--smooth", "all, or how many later rows", repr(name))
    return FixedLag(int(name))
