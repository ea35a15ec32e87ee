"""The best linear filter behind a random channel, and the filter that hears nothing."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.correction import Signal
from heliograph.filters.gaussian import Belief, describe
from heliograph.filters.transform import AbstractTransform, Cubature
from heliograph.filters.update import Polytope
from heliograph.model.channel import Channel, check_link
from heliograph.model.estimate import Claim, Estimate
from heliograph.model.over_time import OverTime, at, first
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.model.sensor import AnySensor, is_linear
from heliograph.numerics.check import array, covariance, fail
from heliograph.numerics.float64 import compiled, in_float64
from heliograph.random_affine.second_order import SecondOrder


class LinearBelief(NamedTuple):
    """The estimate's mean and error covariance, and the state's own mean and covariance before any data."""

    mean: jax.Array
    covariance: jax.Array
    state_mean: jax.Array
    state_covariance: jax.Array


class LinearFilter(AbstractFilter):
    """The linear minimum-mean-square-error filter of a linear plant behind a random affine channel.

    With G random, the innovation covariance needs E[y y'] = C E[x x'] C' + R, which is propagated before any data
    instead of being read off the estimate. Then the claim is exact; where probabilities are uncertain, an upper bound.

    Source: De Koning, Optimal estimation of linear discrete-time systems with stochastic parameters (1984).
    """

    plant: AnyPlant
    sensor: AnySensor
    channel: SecondOrder | OverTime
    update: Polytope
    claim: Claim = eqx.field(static=True)

    @in_float64
    def init(self) -> LinearBelief:
        """The prior, as estimate and as state."""
        start = at(self.plant, 0)
        mean, spread = jnp.asarray(start.initial_mean), jnp.asarray(start.initial_covariance)
        return LinearBelief(mean, spread, mean, spread)

    @compiled
    def step(self, state: LinearBelief, z: Any, u: Any = (), k: Any = 0) -> tuple[LinearBelief, Estimate]:
        """Predict both moments over step k, then use what arrived of z."""
        plant, sensor, channel = at(self.plant, k), at(self.sensor, k), at(self.channel, k)
        u, z = jnp.asarray(u, dtype=float), jnp.asarray(z, dtype=float)
        a, c = plant.matrix, sensor.matrix

        def move(mean: jax.Array, spread: jax.Array) -> Belief:
            moved = plant.transition(mean, u) + plant.noise_mean()
            return Belief(moved, a @ spread @ a.T + plant.noise_covariance(u))

        prior, own = move(state.mean, state.covariance), move(state.state_mean, state.state_covariance)
        noise, own_signal = sensor.noise, c @ own.mean + sensor.noise.mean
        second = c @ own.covariance @ c.T + noise.covariance + jnp.outer(own_signal, own_signal)
        cross = prior.covariance @ c.T
        gain, bound = self.update.correct(
            prior.covariance,
            Signal(own_signal, c @ cross + noise.covariance, cross, second),
            channel,
            present := ~jnp.isnan(z),
        )
        expected = channel.mean_gain @ (c @ prior.mean + noise.mean) + channel.offset
        mean = prior.mean + gain @ jnp.where(present, z - expected, 0.0)
        after = jnp.where(jnp.any(present), bound, prior.covariance)
        return LinearBelief(mean, after, *own), Estimate(mean, after, self.claim)


def linear_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel, update: Polytope | None = None) -> LinearFilter:
    """The best linear filter for a linear plant and sensor behind any channel.

    Claim: "exact"; "upper" where probabilities are uncertain. A sensor noise correlated with its own past, or a channel
    that remembers, is outside.

    Raises:
        ValueError: a plant or sensor that is not linear, or parts that do not fit.
    Source: De Koning (1984), for multiplicative noise.
    """
    if not is_linear(plant, sensor):
        raise fail("linear filter", "a LinearPlant and a LinearSensor", f"{type(first(plant)).__name__} and "
                   f"{type(first(sensor)).__name__}")  # fmt: skip
    check_link(first(sensor), first(channel), len(first(plant).states))
    rule = Polytope() if update is None else update
    described = describe(channel, rule)
    uncertain = described.values.uncertain if isinstance(described, OverTime) else described.uncertain
    claim: Claim = "upper" if uncertain else "exact"
    return LinearFilter(plant=plant, sensor=sensor, channel=described, update=rule, claim=claim)


class OpenLoop(AbstractFilter):
    """The filter that hears nothing: prediction only. What any use of the measurements has to beat."""

    plant: AnyPlant
    transform: AbstractTransform
    initial_mean: np.ndarray
    initial_covariance: np.ndarray
    claim: Claim = eqx.field(static=True)

    @in_float64
    def init(self) -> Belief:
        """The prior."""
        return Belief(jnp.asarray(self.initial_mean), jnp.asarray(self.initial_covariance))

    @compiled
    def step(self, state: Belief, z: Any, u: Any = (), k: Any = 0) -> tuple[Belief, Estimate]:
        """Predict over step k; z is not used."""
        plant, u = at(self.plant, k), jnp.asarray(u, dtype=float)
        moved = self.transform.apply(lambda x: plant.transition(x, u), *state)
        after = Belief(moved.mean + plant.noise_mean(), moved.covariance + plant.noise_covariance(u))
        return after, Estimate(after.mean, after.covariance, self.claim)


def open_loop_filter(plant: AnyPlant, initial_mean: Any = None, initial_covariance: Any = None) -> OpenLoop:
    """Prediction by cubature points without any measurement.

    Claim: "exact" for a linear plant started from its own initial law, else "nominal".

    Raises:
        ValueError: an initial mean or covariance of the wrong shape.
    Source: the prediction step of any of the filters, alone.
    """
    start = first(plant)
    n = len(start.states)
    mean = start.initial_mean if initial_mean is None else array("filter's initial mean", initial_mean, (n,))
    spread = start.initial_covariance
    if initial_covariance is not None:
        spread = covariance("filter's initial covariance", initial_covariance, n)
    own = initial_mean is None and initial_covariance is None
    claim: Claim = "exact" if isinstance(start, LinearPlant) and own else "nominal"
    return OpenLoop(plant=plant, transform=Cubature(), initial_mean=mean, initial_covariance=spread, claim=claim)
