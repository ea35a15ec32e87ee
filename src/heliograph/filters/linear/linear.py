"""The best linear filter behind a random channel that draws anew at each step, and the way to the others."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter, Step, corrects, predicts
from heliograph.filters.gaussian.correction import Signal, known_gain_covariance
from heliograph.filters.gaussian.gaussian import describe
from heliograph.filters.gaussian.update import Polytope
from heliograph.filters.innovation import gaussian_innovation, innovation_covariance
from heliograph.filters.linear.plan import plan
from heliograph.filters.modes.modal import modal_filter
from heliograph.filters.modes.side_information import side_information_filter
from heliograph.filters.modes.uncertain import uncertain_modal_filter
from heliograph.filters.smoother_step.base import AbstractSmootherStep
from heliograph.filters.smoother_step.building import linear_smoother_step, moments_smoother_step, observed_through
from heliograph.filters.wrappers.delay import as_current, behind_delays
from heliograph.model.channel import Channel, check_link
from heliograph.model.estimate import Claim, Estimate, Innovation
from heliograph.model.fading import memory_matters, uncertain_chain, without_memory
from heliograph.model.over_time import OverTime, at, first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor, check_linear
from heliograph.numerics.check import fail
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.over_runs import runs_last
from heliograph.numerics.small_matrix import congruence, diagonal, diagonal_of, times, times_vector, transpose
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.random_affine.base import as_maps
from heliograph.random_affine.moments.second_moments import SecondOrder, has_known_mean
from heliograph.random_affine.outliers import is_bounded


class LinearBelief(NamedTuple):
    """The estimate's mean and error covariance, and the state's own mean and covariance before any data."""

    mean: Float[jax.Array, " n"]
    covariance: Float[jax.Array, "n n"]
    state_mean: Float[jax.Array, " n"]
    state_covariance: Float[jax.Array, "n n"]


class LinearFilter(AbstractFilter):
    """The linear minimum-mean-square-error filter of a linear plant behind a random affine channel.

    With G random, the innovation covariance needs E[y y'] = C E[x x'] C' + R, which is propagated before any data
    instead of being read off the estimate. Then the claim is exact; where probabilities are uncertain, an upper bound.
    The innovation has the nominal law's covariance; it is not Gaussian, so its Gaussian likelihood is nominal.

    `mean_known`: E[G] is. Given later data too the claim is then the filter's: with the gains fixed, what dominates
    each step's noise dominates the error. With E[G] uncertain nothing is proved of it, and it is nominal.

    Source: De Koning, Optimal estimation of linear discrete-time systems with stochastic parameters (1984).
    """

    plant: AnyPlant
    sensor: AnySensor
    channel: SecondOrder | OverTime
    update: Polytope
    mean_known: bool = eqx.field(static=True)
    claim: Claim = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    received: int = eqx.field(static=True)

    @in_float64
    def init(self) -> LinearBelief:
        """The prior, as estimate and as state."""
        start = at(self.plant, 0)
        mean, spread = jnp.asarray(start.initial_mean), jnp.asarray(start.initial_covariance)
        return LinearBelief(mean, spread, mean, spread)

    @predicts
    def predict(self, state: LinearBelief, u: ArrayLike = (), k: Step = 0) -> LinearBelief:
        """Both moments over step k."""
        plant, u = at(self.plant, k), jnp.asarray(u)
        shift, noise = jnp.asarray(plant.input_matrix) @ u + plant.noise_mean(), plant.noise_covariance(u)
        error, local = (moved(*part, plant.matrix, shift, noise) for part in (state[:2], state[2:]))
        return LinearBelief(*error, *local)

    @corrects
    def correct(self, state: LinearBelief, z: ArrayLike, k: Step = 0) -> tuple[LinearBelief, Innovation]:
        """Use what arrived of z."""
        sensor, channel, z = at(self.sensor, k), at(self.channel, k), jnp.asarray(z)
        y = signal(state[1:], sensor.matrix, sensor.noise.mean, sensor.noise.covariance)
        y = y._replace(matrix=jnp.asarray(sensor.matrix), noise=jnp.asarray(sensor.noise.covariance))
        gain, bound = self.update.correct(state.covariance, y, channel, ~jnp.isnan(z))
        # No variance is below the rounding of the mean itself, however often noise-free data say the same again.
        bound = above_rounding(bound, state.state_mean, state.state_covariance)
        mean, covariance, expected = used(
            state.mean,
            state.covariance,
            gain,
            bound,
            sensor.matrix,
            sensor.noise.mean,
            channel.mean_gain,
            channel.offset,
            z,
        )
        innovation = gaussian_innovation(z, expected, innovation_covariance(y, channel))
        return LinearBelief(mean, covariance, state.state_mean, state.state_covariance), innovation

    @in_float64
    def estimate(self, state: LinearBelief) -> Estimate:
        """The estimate's mean and covariance."""
        return Estimate(state.mean, state.covariance, self.claim)

    def smoother_step(
        self,
        before: LinearBelief,
        prior: LinearBelief,
        after: LinearBelief,
        innovation: Innovation,
        z: ArrayLike,
        u: ArrayLike,
        k: Step,
    ) -> AbstractSmootherStep:
        """The update itself, or the moments around it where E[G] is uncertain."""
        sensor, channel, z = at(self.sensor, k), at(self.channel, k), jnp.asarray(z)
        transition = jnp.asarray(at(self.plant, k).matrix)
        if not self.mean_known:
            cross = before.covariance @ transition.T
            return moments_smoother_step(after, prior, cross, "nominal")
        total = innovation.covariance
        if channel.uncertain:  # the gain was made for the worst law, not for the nominal one
            y = signal(prior[1:], sensor.matrix, sensor.noise.mean, sensor.noise.covariance)
            total = known_gain_covariance(y, channel, ~jnp.isnan(z))
        output = observed_through(channel.mean_gain, sensor.matrix)
        process = at(self.plant, k).noise_covariance(jnp.asarray(u))
        return linear_smoother_step(after, prior, transition, process, output, innovation.value, total, self.claim)

    def planned(self, inputs: Float[Array, "horizon inputs"]) -> AbstractFilter:
        """With all covariances and gains computed before."""
        return plan(self, inputs)


@runs_last
def moved(
    mean: jax.Array, spread: jax.Array, matrix: jax.Array, shift: jax.Array, noise: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """A m + b and A P A' + Q."""
    return times_vector(matrix, mean) + shift, congruence(matrix, spread) + noise


@runs_last
def above_rounding(covariance: jax.Array, state_mean: jax.Array, state_covariance: jax.Array) -> jax.Array:
    """P + diag(((n + 2) eps)^2 E[x_i^2]) where P_ii is not zero: what a mean of such a size cannot say.

    Data without noise would else shrink P at each step by eps^2, to where a smoother divides the rounding of an
    innovation by it.
    """
    unit = (len(covariance) + 2) * float(np.finfo(covariance.dtype).eps)
    second = diagonal_of(state_covariance) + state_mean**2
    return covariance + diagonal(jnp.where(diagonal_of(covariance) > 0, unit**2 * second, 0.0))


@runs_last
def signal(
    known: tuple[jax.Array, jax.Array, jax.Array], c: jax.Array, noise_mean: jax.Array, noise: jax.Array
) -> Signal:
    """y = C x + v: its mean before any data, the covariance of what is not known of it, E[y y'].

    Of what is known before data alone, error covariance and the state's own moments: derivatives with respect to the
    estimate pass it by.
    """
    covariance, state_mean, state_covariance = known
    cross = times(covariance, transpose(c))
    mean = times_vector(c, state_mean) + noise_mean
    second = congruence(c, state_covariance) + noise + mean[:, None] * mean[None]
    return Signal(mean, times(c, cross) + noise, cross, second)


@runs_last
def used(
    mean: jax.Array,
    prior: jax.Array,
    gain: jax.Array,
    bound: jax.Array,
    c: jax.Array,
    noise_mean: jax.Array,
    channel_gain: jax.Array,
    channel_offset: jax.Array,
    z: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Mean and covariance after z, and what was expected, M (C m + v) + b."""
    present = ~jnp.isnan(z)
    expected = times_vector(channel_gain, times_vector(c, mean) + noise_mean) + channel_offset
    after = mean + times_vector(gain, jnp.where(present, z - expected, 0.0))
    return after, jnp.where(jnp.any(present, axis=0), bound, prior), expected


def linear_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, update: Polytope | None = None
) -> AbstractFilter:
    """The best linear filter for a linear plant and sensor behind any channel.

    Claim: "exact"; "upper" where probabilities are uncertain. Behind a channel that remembers its modes are estimated
    too; if it also loses data, what arrives tells of the modes (`told_filter`). Behind a link that is late what was
    sent is estimated too, unless the delay is constant. A sensor noise correlated with its own past is outside.

    Raises:
        ValueError: a plant or sensor that is not linear, or parts that do not fit.
    Source: De Koning (1984), for multiplicative noise; Costa (1994), for modes.
    """
    if as_maps("channel", [first(channel)])[0].past:
        return behind_delays(plant, sensor, channel, partial(linear_filter, update=update))
    check_linear("linear filter", plant, sensor)
    check_link(first(sensor), first(channel), len(first(plant).states))
    if first(channel).remembers:
        if update is not None:
            raise fail("update", "none behind a channel that remembers", type(update).__name__)
        if is_bounded(plant, sensor, channel):
            raise fail("noise behind a channel that remembers", "a known law", "bounds of outliers alone")
        if first(channel).erases:
            return side_information_filter(plant, sensor, channel)
        if uncertain_chain(channel):
            return uncertain_modal_filter(plant, sensor, channel)
        return modal_filter(plant, sensor, channel)
    rule = Polytope() if update is None else update
    described = describe(channel, rule)
    whole = described.values if isinstance(described, OverTime) else described
    start = first(plant)
    return LinearFilter(
        plant=plant,
        sensor=sensor,
        channel=described,
        update=rule,
        mean_known=not whole.uncertain or has_known_mean(whole),
        claim="upper" if whole.uncertain or is_bounded(plant, sensor, channel) else "exact",
        states=start.states,
        inputs=start.inputs,
        received=first(channel).outputs,
    )


def memoryless_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, update: Polytope | None = None
) -> LinearFilter:
    """The best linear filter for links that draw anew at each step, behind links that may remember.

    Claim: as `linear_filter` of links that forget, lowered to "nominal" where memory matters (`memory_matters`);
    `true_error` says before any data by how much it is wrong then.

    Raises:
        ValueError: a plant or sensor that is not linear, parts that do not fit, losses.
    Source: De Koning (1984), for multiplicative noise that is independent over time.
    """
    item = linear_filter(plant, sensor, without_memory(channel), update)
    assert isinstance(item, LinearFilter)  # what does not remember has no other
    return replace(item, claim="nominal") if memory_matters(channel) else item


def as_current_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, update: Polytope | None = None
) -> LinearFilter:
    """The filter that takes what is late as current: the best linear one if all delays were none.

    Claim: "nominal" where anything can be late; `true_error` says before any data how wrong it is then.

    Raises:
        ValueError: what `linear_filter` refuses, losses.
    Source: the usual mistake; De Koning (1984), with y_k in place of y_{k-d}.
    """
    item = linear_filter(plant, sensor, without_memory(as_current(channel)), update)
    assert isinstance(item, LinearFilter)  # what is neither late nor remembers has no other
    return replace(item, claim="nominal") if first(channel).past else item
