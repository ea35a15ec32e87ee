"""Quadratic filter whose products reach into the past through the estimate of a linear filter."""

from typing import NamedTuple

import jax.numpy as jnp

from heliograph.filters.base import AbstractSizedFilter, Step, corrects, estimates, predicts
from heliograph.filters.linear.polynomial import (
    add_mean,
    initial_mean,
    lift_about_mean,
    polynomial_claim,
    predict_mean,
    select_degree_one,
    subtract_mean,
)
from heliograph.filters.linear.scheduled_gains import ScheduledFilter, ScheduleState
from heliograph.filters.linear.unconditional_mean import UnconditionalMean, centre_plant
from heliograph.linear.lmmse_recursion import lmmse
from heliograph.linear.polynomial_filter_errors import quadratic_system_with_linear_estimate
from heliograph.model.assumed.assumed_model import AssumedModel, with_assumed
from heliograph.model.channel import Channel
from heliograph.model.estimate import Claim, Estimate, Innovation
from heliograph.model.over_time import first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.random_affine.base import check_forgets, check_maps
from heliograph.random_affine.moments.monomials import evaluate_monomials


class MemoryState(NamedTuple):
    """States of a linear filter and of a quadratic one (`products`), both of x - E[x], and the mean E[x] (n,)."""

    linear: ScheduleState
    products: ScheduleState
    mean: Float[Array, " n"]


class MemoryFilter(AbstractSizedFilter):
    """Quadratic filter with memory: its measurement is z, its squares, and the products of z and the linear estimate.

    A linear filter runs beside it. The products with its estimate, which sums up all earlier z, are the memory. Both
    filters have saved gains, for complete data: after a gap the covariance is NaN. The innovation is that of z itself,
    with its exact covariance. `centre` is the recursion of the unconditional mean E[x] if both filters are of x - E[x],
    else None.
    """

    linear: ScheduledFilter
    products: ScheduledFilter
    centre: UnconditionalMean | None

    def __init__(
        self, linear: ScheduledFilter, products: ScheduledFilter, claim: Claim, centre: UnconditionalMean | None = None
    ):
        """Join the two filters.

        Args:
            linear: filter of z, which gives the linear estimate xhat.
            products: filter of the measurement (z, z z', z xhat'), which gives the final estimate.
            claim: what the covariance is said to be: exact, an upper bound or nominal.
            centre: recursion of the unconditional mean that is subtracted before both, or None.
        """
        self.linear, self.products, self.claim, self.centre = linear, products, claim, centre
        self.states, self.inputs, self.received = linear.states, linear.inputs, linear.received
        self.kept = products.kept

    @in_float64
    def init(self) -> MemoryState:
        """Return the initial states of both filters, and E[x_0], which is subtracted before them."""
        return MemoryState(self.linear.init(), self.products.init(), initial_mean(self.centre, len(self.states)))

    @predicts
    def predict(self, state: MemoryState, u: ArrayLike = (), k: Step = 0) -> MemoryState:
        """Predict x - E[x] with the linear and the quadratic filter, and E[x], which is known before any data."""
        linear, products = self.linear.predict(state.linear, u, k), self.products.predict(state.products, u, k)
        return MemoryState(linear, products, predict_mean(self.centre, state.mean, k))

    @corrects
    def correct(self, state: MemoryState, z: ArrayLike, k: Step = 0) -> tuple[MemoryState, Innovation]:
        """Correct the linear filter with z, then the quadratic one with (z, z z', z xhat'), xhat the linear estimate.

        If the gain is known, z - E[z] replaces z: moments about the mean lose no digits to a large mean. The returned
        innovation is that of z alone.
        """
        z = subtract_mean(self.centre, z, state.mean, k)
        linear, _ = self.linear.correct(state.linear, z, k)
        monomials = evaluate_monomials(z, degree=2)[:-1]  # z and its squares, without the constant
        measurement = jnp.concatenate([monomials, jnp.outer(z, linear.mean).reshape(-1)])
        products, innovation = self.products.correct(state.products, measurement, k)
        return MemoryState(linear, products, state.mean), select_degree_one(innovation, z, degree=2)

    @estimates
    def estimate(self, state: MemoryState) -> Estimate:
        """Return the estimate of x: that of x - E[x] by the quadratic filter, plus E[x]."""
        return add_mean(self.products.estimate(state.products), state.mean)

    def after_step(self, state: MemoryState, k: Step) -> Estimate:
        """Return the estimate of x after step k: that of x - E[x] by the quadratic filter, plus E[x]."""
        return add_mean(self.products.after_step(state.products, k), state.mean)


def memory_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel, horizon: int) -> MemoryFilter:
    """Return the quadratic filter whose products reach into the past through the linear filter's estimate.

    Its measurement is z, the products of the components of z, and the products of z with the estimate of the linear
    filter (LMMSE). That estimate is a linear function of all earlier z, so products with it bring in the past at little
    cost.

    Args:
        plant: a linear plant without inputs, n states.
        sensor: a linear sensor, m outputs.
        channel: from the sensor to the filter, without memory.
        horizon: number of steps.

    Claim: what the covariance is said to be is as for `polynomial_filter` at degree 2, "exact" if all laws are known,
    else "nominal". The error is never larger than that of the quadratic filter, whose measurements are among these.

    Raises:
        ValueError: what `polynomial_filter` refuses; a channel with memory.

    Source: a second-order Volterra filter with the linear estimate in place of the past measurements.
    """
    check_forgets("channel of a memory filter", check_maps("channel", [first(channel)])[0])
    claim = polynomial_claim(plant, sensor, channel, degree=2)
    centre, system = lift_about_mean(plant, sensor, channel, degree=1, horizon=horizon)
    # First the linear filter, whose gains decide the moments of the products of its estimate with z. Then the LMMSE
    # filter of the system whose state is all products up to degree 2 of (x, linear estimate, z), about the mean of x.
    linear = lmmse(system, claim)
    centred_plant = plant if centre is None else centre_plant(plant)
    products = lmmse(quadratic_system_with_linear_estimate(centred_plant, sensor, channel, linear), linear.claim)
    names = first(plant).states
    filter = MemoryFilter(
        linear=ScheduledFilter(linear, names),
        products=ScheduledFilter(products, names),
        claim=products.claim,
        centre=centre,
    )
    # Covariances of products of two numbers are moments of order 4.
    return with_assumed(filter, AssumedModel(plant, sensor, channel, order=4))
