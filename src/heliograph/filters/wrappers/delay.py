"""Filters behind delayed links: constant delays, delays known at the receiver, and lines of past signals."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter, AbstractSizedFilter, Step, corrects, predicts
from heliograph.filters.modes.side_information import with_flag
from heliograph.filters.wrappers.held import HeldFilter, relayed_filter, with_relays
from heliograph.filters.wrappers.part import AbstractPartFilter, PartFilter
from heliograph.model.channel import Channel, check_link
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import OverTime, first, over_time, stack, unstack
from heliograph.model.past import with_past
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.check import check_count, fail, instance
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import ArrayLike, Float, Int, PyTree
from heliograph.random_affine.atoms import known
from heliograph.random_affine.base import AbstractRandomAffine, as_maps, check_forgets
from heliograph.random_affine.combine import Series
from heliograph.random_affine.delay import Delayed, of_line, sent
from heliograph.random_affine.in_line import Relayed
from heliograph.random_affine.moments.second_moments import SecondOrder, second_order


class LateState(NamedTuple):
    """State of the filter at the time of the last received signal, the inputs since then, and the last step."""

    base: PyTree
    inputs: Float[jax.Array, "delay inputs"]
    step: Int[jax.Array, ""]


class LateFilter(AbstractSizedFilter):
    """A filter behind a link with constant delay d: it filters at time k - d and predicts d steps ahead.

    This is the best linear filter with the past as states, without its cost. Built by `late_filter`.
    """

    base: AbstractFilter
    delay: int = eqx.field(static=True)

    def __init__(self, base: AbstractFilter, delay: int):
        self.base, self.delay, self.claim, self.states = base, delay, base.claim, base.states
        self.inputs, self.received = base.inputs, base.received

    @in_float64
    def init(self) -> LateState:
        """Return the state before any signal was sent."""
        start = jax.tree.map(jnp.asarray, self.base.init())
        return LateState(start, jnp.zeros((self.delay, len(self.inputs))), jnp.asarray(-1))

    @predicts
    def predict(self, state: LateState, u: ArrayLike = (), k: Step = 0) -> LateState:
        """Predict over step k - delay, with the input of that step."""
        line = jnp.concatenate([state.inputs, jnp.asarray(u)[None]])
        then = jnp.asarray(k) - self.delay
        moved = self._moved(state.base, line[0], then)
        return LateState(moved, line[1:], jnp.asarray(k, dtype=state.step.dtype))

    def _moved(self, base: PyTree, u: jax.Array, k: jax.Array) -> PyTree:
        """Predict over step k, or return the state as it is where k < 0."""
        after = self.base.predict(base, u, jnp.maximum(k, 0))
        return jax.tree.map(lambda new, old: jnp.where(k >= 0, new, old), after, base)

    @corrects
    def correct(self, state: LateState, z: ArrayLike, k: Step = 0) -> tuple[LateState, Innovation]:
        """Correct with what was sent at step k - delay; values received before the first signal say nothing."""
        then = jnp.asarray(k) - self.delay
        observed = jnp.where(then >= 0, jnp.asarray(z), jnp.nan)
        step = jnp.maximum(then, 0)
        base, innovation = self.base.correct(state.base, observed, step)
        _, early = self.base.correct(state.base, z, step)
        published = jax.tree.map(lambda now, before: jnp.where(then >= 0, now, before), innovation, early)
        return state._replace(base=base), Innovation(published.value, published.covariance, innovation.log_likelihood)

    @in_float64
    def estimate(self, state: LateState) -> Estimate:
        """Prediction over the last `delay` steps."""

        def move(j: jax.Array, base: PyTree) -> PyTree:
            return self._moved(base, jnp.asarray(state.inputs)[j], state.step - self.delay + 1 + j)

        if not self.delay:
            return self.base.estimate(state.base)
        return self.base.estimate(jax.lax.fori_loop(0, self.delay, move, jax.tree.map(jnp.asarray, state.base)))


def late_filter(filter: AbstractFilter, delay: int) -> LateFilter:
    """Put a filter behind a link with a constant delay: it filters the past and predicts to the present.

    Args:
        filter: a filter made for the link without delay.
        delay: whole number of steps, from 0.

    Claim: that of `filter`, for a prediction over `delay` steps.

    Raises:
        ValueError: no filter, a delay that is no whole number of steps.

    Source: prediction from the last filtered time; equal to augmenting the state with past signals.
    """
    return LateFilter(instance("filter", filter, AbstractFilter, "a filter"), check_count("delay", delay, 0))


class KnownDelayFilter(AbstractPartFilter):
    """The best linear filter behind a link with time stamps: the delay of each value is its last received component.

    It estimates the past signals as well, so that a signal received twice counts once, with two channel noises: joint
    noise R 11' + N I. Given all delays it is the best linear estimate.

    base: a filter of (x, y_k, ..., y_{k-D}) whose `channel` may be replaced by `channels` at a delay (0, ..., D).
    """

    base: AbstractFilter
    channels: SecondOrder

    @corrects
    def correct(self, state: PyTree, z: ArrayLike, k: Step = 0) -> tuple[PyTree, Innovation]:
        """Correct with the channel of the received delay; without a delay nothing is used."""
        z, delay = jnp.asarray(z)[:-1], jnp.asarray(z)[-1]
        known, longest = ~jnp.isnan(delay), len(self.channels.offset) - 1
        d = jnp.clip(jnp.where(known, delay, 0.0).astype(int), 0, longest)
        here = jax.tree.map(lambda leaf: jnp.asarray(leaf)[d] if eqx.is_array(leaf) else leaf, self.channels)
        base = eqx.tree_at(lambda item: item.channel, self.base, here)
        after, innovation = base.correct(state, z, k)
        used = jax.tree.map(lambda new, old: jnp.where(known, new, old), after, state)
        flag_innovation, covariance = with_flag(innovation.covariance, delay)
        likelihood = jnp.where(known, innovation.log_likelihood, 0.0)
        return used, Innovation(jnp.append(innovation.value, flag_innovation), covariance, likelihood)


Make = Callable[[AnyPlant, AnySensor, Channel], AbstractFilter]


def behind_delays(plant: AnyPlant, sensor: AnySensor, channel: Channel, make: Make) -> AbstractFilter:
    """Build a filter for a link that may be late, where `make` builds it for links without delay."""
    start, n = first(channel), len(first(plant).states)
    check_link(first(sensor), start, n, late=True)
    if isinstance(start, Delayed) and start.timestamped:
        return _known_delays(plant, sensor, channel, make)
    if isinstance(channel, Delayed) and channel.constant:
        return LateFilter(make(plant, sensor, channel.link), channel.past)
    if isinstance(start, Relayed):
        return _behind_relays(plant, sensor, channel, make)
    return PartFilter(make(*with_past(plant, sensor, channel)), n)


def _behind_relays(plant: AnyPlant, sensor: AnySensor, channel: Channel, make: Make) -> HeldFilter:
    if not isinstance(channel, Relayed):
        raise fail("channel with relays that are late by chance", "one that does not vary", "one in over_time")
    larger, last, link, lines = with_relays(plant, sensor, channel)
    return relayed_filter(plant, channel, make(larger, last, link), lines)


def _known_delays(plant: AnyPlant, sensor: AnySensor, channel: Channel, make: Make) -> KnownDelayFilter:
    if not isinstance(channel, Delayed):
        raise fail("channel with time stamps", "one that does not vary", "one in over_time")
    check_forgets("link with time stamps", channel.link)
    larger, everything, _ = with_past(plant, sensor, channel)
    items = [channel.given(d) for d in range(channel.past + 1)]
    base, start = make(larger, everything, items[0]), first(plant)
    return KnownDelayFilter(
        base=base,
        channels=stack([second_order(item) for item in items]),
        claim=base.claim,
        states=start.states,
        inputs=start.inputs,
        received=channel.outputs,
    )


def as_current(channel: Channel) -> Channel:
    """Return the channel for a filter that takes late signals as current: all signals of its line are y_k."""
    if isinstance(channel, OverTime):
        return over_time([as_current(item) for item in unstack(channel)])
    return _at_once(as_maps("channel", [channel])[0])


def _at_once(channel: AbstractRandomAffine) -> AbstractRandomAffine:
    if isinstance(channel, Relayed):
        return Series([_at_once(stage) for stage in channel.stages])
    return Series([known(np.tile(np.eye(sent(channel)), (1 + channel.past, 1))), of_line(channel)])
