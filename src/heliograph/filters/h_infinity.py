"""The H-infinity filter: gains designed for a level, run on any plant and sensor."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter, Step, corrects, predicts
from heliograph.h_infinity.design import HInfinityDesign
from heliograph.h_infinity.system import GrowthSystem
from heliograph.model.estimate import Claim, Estimate, Innovation
from heliograph.model.over_time import OverTime, at, first
from heliograph.model.plant import AbstractPlant, AnyPlant
from heliograph.model.sensor import AnySensor, check_sensor, refuse_angles
from heliograph.numerics.check import array, fail, instance
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import ArrayLike, Float


class Pending(NamedTuple):
    """The last estimate (n,), and the correction (n,) that what came since will make to the next."""

    mean: Float[jax.Array, " n"]
    correction: Float[jax.Array, " n"]


class HInfinityFilter(AbstractFilter):
    """xhat+ = f(xhat, u) + K (received - E[G] h(xhat)): an estimate at step k uses what came before step k.

    It claims no covariance: its guarantee is a ratio of energies over the horizon. What did not arrive counts as what
    the filter expected. At the first step there is nothing to correct with, and the estimate is f of the initial one.
    """

    plant: AnyPlant
    sensor: AnySensor
    gains: OverTime
    expected_gain: OverTime
    initial_mean: np.ndarray
    claim: Claim = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    received: int = eqx.field(static=True)

    @in_float64
    def init(self) -> Pending:
        """The initial estimate, with no correction."""
        mean = jnp.asarray(self.initial_mean)
        return Pending(mean, jnp.zeros_like(mean))

    @predicts
    def predict(self, state: Pending, u: ArrayLike = (), k: Step = 0) -> Pending:
        """Over step k, with what came before it."""
        mean = at(self.plant, k).transition(state.mean, jnp.asarray(u)) + state.correction
        return Pending(mean, jnp.zeros_like(mean))

    @corrects
    def correct(self, state: Pending, z: ArrayLike, k: Step = 0) -> tuple[Pending, Innovation]:
        """Keep what z will correct in the next estimate; this one stays."""
        value = jnp.asarray(z) - at(self.expected_gain, k) @ at(self.sensor, k).measure(state.mean)
        later = at(self.gains, k) @ jnp.where(jnp.isnan(value), 0.0, value)
        nothing = jnp.where(jnp.any(~jnp.isnan(value)), jnp.nan, 0.0)
        return Pending(state.mean, later), Innovation(value, jnp.full((len(value), len(value)), jnp.nan), nothing)

    @in_float64
    def estimate(self, state: Pending) -> Estimate:
        """The mean, without a covariance."""
        n = state.mean.shape[0]
        return Estimate(state.mean, jnp.full((n, n), jnp.nan), self.claim)


def h_infinity_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    system: GrowthSystem,
    design: HInfinityDesign,
    initial_mean: ArrayLike | None = None,
) -> HInfinityFilter:
    """The filter with designed gains; it covers the steps of the system, whose A x + f(x) must be `plant`'s transition.

    `system` says what the filter expects of the channel. The initial mean is the plant's unless given.

    Claim: "none" for a covariance; `certify_level` checks the level that it does guarantee.

    Raises:
        ValueError: a design that is not feasible, or a plant, sensor and system that do not fit.
    Source: H-infinity fusion over amplify-and-forward relays, equation (6).
    """
    instance("system", system, GrowthSystem, "a GrowthSystem, as growth_system makes it")
    instance("design", design, HInfinityDesign, "a design, as recursive_design makes it")
    if not design.feasible:
        smallest = "" if design.smallest_level is None else f"; the smallest level found is {design.smallest_level:.6g}"
        raise fail("design", "one that is feasible", f"{design.status} at level {design.level:g}{smallest}")
    instance("plant", first(plant), AbstractPlant, "a plant")
    start, inputs = first(plant), system.output.shape[1]
    n = len(start.states)
    if n != system.states or design.gains.shape != (system.steps, n, system.received):
        raise fail("system", f"{n} states and gains {design.gains.shape}", f"{system.states} states")
    check_sensor(first(sensor), n)
    refuse_angles("H-infinity filter", plant, sensor)
    if len(first(sensor).outputs) != inputs:
        raise fail("sensor", f"the system's {inputs} outputs", len(first(sensor).outputs))
    mean = start.initial_mean if initial_mean is None else array("filter's initial mean", initial_mean, (n,))
    expected = np.array([link.mean[:, :inputs] for link in system.channel])
    return HInfinityFilter(
        plant=plant,
        sensor=sensor,
        gains=OverTime(design.gains),
        expected_gain=OverTime(expected),
        initial_mean=mean,
        claim="none",
        states=start.states,
        inputs=start.inputs,
        received=system.received,
    )
