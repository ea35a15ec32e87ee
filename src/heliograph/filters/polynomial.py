"""Filters that use powers and products of what they hear: a lift of the measurement before a linear filter."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from heliograph.filters.base import AbstractFilter
from heliograph.filters.scheduled import LinearSystemFilter, ScheduledFilter, ScheduleState
from heliograph.linear.lift import lifted_system
from heliograph.linear.memory import memory_system
from heliograph.linear.recursion import lmmse
from heliograph.model.channel import Channel
from heliograph.model.estimate import Claim, Estimate
from heliograph.model.over_time import OverTime, first, unstack
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.float64 import compiled, in_float64
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.monomials import monomials


class PolynomialFilter(AbstractFilter):
    """Give a filter all monomials of z up to `degree` in place of z; with a component, every monomial of it is missing.

    `inner` is a `LinearSystemFilter` or a `ScheduledFilter` of the lifted system.
    """

    inner: AbstractFilter
    degree: int = eqx.field(static=True)
    claim: Claim = eqx.field(static=True)

    def __init__(self, inner: AbstractFilter, degree: int):
        self.inner, self.degree, self.claim = inner, degree, inner.claim

    @in_float64
    def init(self) -> Any:
        """The inner filter's state."""
        return self.inner.init()

    @compiled
    def step(self, state: Any, z: Any, u: Any = (), k: Any = 0) -> tuple[Any, Estimate]:
        """Lift z and step the inner filter."""
        result: tuple[Any, Estimate] = self.inner.step(
            state, monomials(jnp.asarray(z, dtype=float), self.degree)[:-1], u, k
        )
        return result


def polynomial_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, horizon: int, degree: int = 2
) -> PolynomialFilter:
    """The best filter that is a polynomial of `degree` in each received z_k: 1 linear, 2 quadratic, 3 cubic.

    For linear plants and sensors behind any channel, with noises of any law whose moments up to 2 degree exist. It
    estimates the whole state, a dynamical bias included, and its covariance is recomputed where z has gaps. For many
    complete runs `scheduled_polynomial_filter` does the same with saved gains.

    Claim: "exact"; "nominal" where probabilities are uncertain (the nominal ones are trusted). Covers `horizon`
    steps; a stream that goes on keeps the last step's matrices, which is right once they have settled.

    Raises:
        ValueError: parts that do not fit, a plant with inputs, a lift of more than the stated memory.
    Source: quadratic filtering with dynamical bias, Theorems 1 and 2, as repaired for random powers.
    """
    system = lifted_system(plant, sensor, channel, degree, horizon)
    return PolynomialFilter(LinearSystemFilter(system, claim_of(channel)), degree)


def scheduled_polynomial_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, horizon: int, degree: int = 2
) -> PolynomialFilter:
    """`polynomial_filter` with saved gains, for complete data: the same estimates at a fraction of the cost per step.

    Raises:
        ValueError: what `polynomial_filter` refuses.
    Source: as `polynomial_filter`.
    """
    system = lifted_system(plant, sensor, channel, degree, horizon)
    return PolynomialFilter(ScheduledFilter(lmmse(system, claim_of(channel))), degree)


class MemoryState(NamedTuple):
    """States of the linear filter and of the filter of the products."""

    linear: ScheduleState
    products: ScheduleState


class MemoryFilter(AbstractFilter):
    """The quadratic filter with memory: it hears z, its squares, and the products of z and the linear estimate.

    With saved gains, for complete data; see `ScheduledFilter` for what gaps do.
    """

    linear: ScheduledFilter
    products: ScheduledFilter
    claim: Claim = eqx.field(static=True)

    @in_float64
    def init(self) -> MemoryState:
        """Both filters' starts."""
        return MemoryState(self.linear.init(), self.products.init())

    @compiled
    def step(self, state: MemoryState, z: Any, u: Any = (), k: Any = 0) -> tuple[MemoryState, Estimate]:
        """Step the linear filter, then give (z, squares, products of z and its estimate) to the other."""
        z = jnp.asarray(z, dtype=float)
        linear, guess = self.linear.step(state.linear, z, u, k)
        squares = monomials(z, 2)[:-1]
        heard = jnp.concatenate([squares, jnp.outer(z, jnp.asarray(guess.mean)).reshape(-1)])
        products, estimate = self.products.step(state.products, heard, u, k)
        return MemoryState(linear, products), estimate


def memory_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel, horizon: int) -> MemoryFilter:
    """The quadratic filter whose products reach into the past through the linear filter's estimate.

    Claim: as `polynomial_filter`; never worse than its quadratic filter.

    Raises:
        ValueError: what `polynomial_filter` refuses.
    Source: a second-order Volterra filter with the linear estimate in place of the past measurements.
    """
    claim = claim_of(channel)
    linear = lmmse(lifted_system(plant, sensor, channel, 1, horizon), claim)
    products = lmmse(memory_system(plant, sensor, channel, linear), claim)
    return MemoryFilter(linear=ScheduledFilter(linear), products=ScheduledFilter(products), claim=claim)


def claim_of(channel: Channel) -> Claim:
    """ "exact" if the channel's law is known, "nominal" if some probability is uncertain."""
    each: list[AbstractRandomAffine] = unstack(channel) if isinstance(channel, OverTime) else [first(channel)]
    return "exact" if all(c.corner_count() == 1 for c in each) else "nominal"
