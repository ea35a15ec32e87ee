"""The filter that is told the mode one step late: it redoes its last update with the mode, then makes the next one."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter, Step, corrects, predicts
from heliograph.filters.innovation import gaussian_innovation, innovation_covariance
from heliograph.filters.linear import LinearBelief, moved, signal, used
from heliograph.filters.told import with_flag
from heliograph.filters.update import Polytope
from heliograph.model.channel import Channel, check_link
from heliograph.model.estimate import Claim, Estimate, Innovation
from heliograph.model.over_time import OverTime, at, first, over_time, stack, unstack
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor, is_linear
from heliograph.numerics.check import fail
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import ArrayLike, Bool, Float
from heliograph.random_affine.forgetful import mixed
from heliograph.random_affine.modes import JointModes, joint_modes
from heliograph.random_affine.second_moments import SecondOrder, second_order


class Late(eqx.Module):
    """A channel at one step: in each mode, after each mode of the step before, and (the last one) before any.

    Shapes: a leading axis of modes, and of modes + 1.
    """

    given: SecondOrder
    after: SecondOrder


class LateBelief(NamedTuple):
    """The estimate, the plant's own moments, and what the estimate is if the mode of the last step was each of all.

    Shapes: mean (n,), covariance (n, n), means (M, n), covariances (M, n, n).
    """

    mean: Float[jax.Array, " n"]
    covariance: Float[jax.Array, "n n"]
    state_mean: Float[jax.Array, " n"]
    state_covariance: Float[jax.Array, "n n"]
    means: Float[jax.Array, "M n"]
    covariances: Float[jax.Array, "M n n"]
    begun: Bool[jax.Array, ""]


class LateFilter(AbstractFilter):
    """The best linear filter given the modes of all steps before: the last update is redone with its mode.

    It hears z and the number of the mode of the step before, as `with_flag(late=True)` delivers them. Where the number
    is missing after the first step, z is not used.

    Source: linear filtering with a transition that is known one step late; the Kalman filter given the modes.
    """

    plant: AnyPlant
    sensor: AnySensor
    channel: Late | OverTime
    modes: int = eqx.field(static=True)
    claim: Claim = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    received: int = eqx.field(static=True)

    @in_float64
    def init(self) -> LateBelief:
        """The prior."""
        start = at(self.plant, 0)
        mean, spread = jnp.asarray(start.initial_mean), jnp.asarray(start.initial_covariance)
        each = jnp.tile(mean, (self.modes, 1)), jnp.tile(spread, (self.modes, 1, 1))
        return LateBelief(mean, spread, mean, spread, *each, jnp.asarray(False))

    @predicts
    def predict(self, state: LateBelief, u: ArrayLike = (), k: Step = 0) -> LateBelief:
        """All of them over step k."""
        plant, u = at(self.plant, k), jnp.asarray(u)
        shift, noise = jnp.asarray(plant.input_matrix) @ u + plant.noise_mean(), plant.noise_covariance(u)

        def over(mean: jax.Array, spread: jax.Array) -> tuple[jax.Array, jax.Array]:
            return moved(mean, spread, jnp.asarray(plant.matrix), shift, noise)

        own = over(state.state_mean, state.state_covariance)
        each = jax.vmap(over)(state.means, state.covariances)
        return LateBelief(*over(state.mean, state.covariance), *own, *each, state.begun)

    @corrects
    def correct(self, state: LateBelief, z: ArrayLike, k: Step = 0) -> tuple[LateBelief, Innovation]:
        """Choose what the last mode was, and use z under the law that follows it."""
        sensor, channel, heard = at(self.sensor, k), at(self.channel, k), jnp.asarray(z)
        z, told = heard[:-1], heard[-1]
        number = jnp.clip(jnp.nan_to_num(told).astype(int), 0, self.modes - 1)
        known = ~state.begun | ~jnp.isnan(told)
        mean = jnp.where(known, state.means[number], state.mean)
        spread = jnp.where(known, state.covariances[number], state.covariance)
        usable = jnp.where(known, z, jnp.nan)
        prior = LinearBelief(mean, spread, state.state_mean, state.state_covariance)
        y = signal(prior, sensor.matrix, sensor.noise.mean, sensor.noise.covariance)

        def use(described: SecondOrder) -> tuple[jax.Array, jax.Array, jax.Array]:
            gain, bound = Polytope().correct(prior.covariance, y, described, ~jnp.isnan(usable))
            through = jnp.asarray(described.mean_gain), jnp.asarray(described.offset)
            of = jnp.asarray(sensor.matrix), jnp.asarray(sensor.noise.mean)
            return used(prior.mean, prior.covariance, gain, bound, *of, *through, usable)

        law = jax.tree.map(lambda a: jnp.asarray(a)[jnp.where(state.begun, number, self.modes)], channel.after)
        after, covariance, expected = use(law)
        means, covariances, _ = jax.vmap(use)(jax.tree.map(jnp.asarray, channel.given))
        innovation = gaussian_innovation(z, expected, innovation_covariance(y, law))
        flag, covariance_heard = with_flag(jnp.asarray(innovation.covariance), told)
        belief = LateBelief(after, covariance, *state[2:4], means, covariances, jnp.asarray(True))
        return belief, Innovation(jnp.append(innovation.value, flag), covariance_heard, innovation.log_likelihood)

    @in_float64
    def estimate(self, state: LateBelief) -> Estimate:
        """The estimate's mean and covariance."""
        return Estimate(state.mean, state.covariance, self.claim)


def late_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> LateFilter:
    """The best linear filter that is told, with each measurement, the mode of the step before.

    Claim: "exact"; "upper" where probabilities within a mode are uncertain.

    Raises:
        ValueError: a plant or sensor that is not linear, or parts that do not fit.
    Source: the Kalman filter given the modes, and one update with the law that follows the last.
    """
    if not is_linear(plant, sensor):
        raise fail("late filter", "a LinearPlant and a LinearSensor", "one that is not linear")
    start = first(plant)
    check_link(first(sensor), first(channel), len(start.states))
    steps = [joint_modes(c) for c in (unstack(channel) if isinstance(channel, OverTime) else [channel])]
    each = [_late(one, before, steps[0]) for one, before in zip(steps, [steps[0], *steps[:-1]], strict=True)]
    uncertain = any(part.uncertain for one in each for part in (one.given, one.after))
    return LateFilter(
        plant=plant,
        sensor=sensor,
        channel=over_time(each) if isinstance(channel, OverTime) else each[0],
        modes=len(steps[0].initial),
        claim="upper" if uncertain else "exact",
        states=start.states,
        inputs=start.inputs,
        received=first(channel).outputs + 1,
    )


def _late(now: JointModes, before: JointModes, begin: JointModes) -> Late:
    laws = [*np.asarray(before.transition), np.asarray(begin.initial)]
    return Late(stack([second_order(m) for m in now.maps]), stack([second_order(mixed(now, law)) for law in laws]))
