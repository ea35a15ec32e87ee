"""Filters of data that are all late by a known number of steps."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.engine.choice import compile_on_call
from heliograph.filters.base import AbstractFilter, Step, corrects, estimates, make_sizes, predicts
from heliograph.filters.modes.arrival_patterns import append_flag
from heliograph.filters.wrappers.wrapper import AbstractWrapper
from heliograph.model.assumed.assumed_model import with_assumed
from heliograph.model.augmented.past_outputs import with_past
from heliograph.model.channel import Channel, delayed
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import at_each_step, first, stack
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.check import check_count, fail, instance
from heliograph.numerics.types import ArrayLike, Float, Int, PyTree
from heliograph.random_affine.base import check_forgets
from heliograph.random_affine.delay import DelayedLink
from heliograph.random_affine.moments.second_moments import SecondOrder, second_order

Make = Callable[[AnyPlant, AnySensor, Channel], AbstractFilter]


class LateState(NamedTuple):
    """State of the filter `delay` steps ago, when the last received signal was sent, the inputs since, and the step."""

    base: PyTree
    inputs: Float[jax.Array, "delay inputs"]
    step: Int[jax.Array, ""]


class LateFilter(AbstractWrapper):
    """A filter behind a link with constant delay d: it filters at time k - d and predicts d steps ahead.

    This is the best linear filter with the past as states, without its cost. Built by `late_filter`.
    """

    base: AbstractFilter
    delay: int = eqx.field(static=True)

    def __init__(self, base: AbstractFilter, delay: int):
        """Wrap `base`, a filter of the link without delay, for measurements that arrive `delay` steps late.

        Claim (what the covariance is said to be), states, inputs and length of z (`received`) are those of `base`.
        """
        self.base, self.delay, self.claim, self.states = base, delay, base.claim, base.states
        self.inputs, self.received = base.inputs, base.received

    @compile_on_call
    def init(self) -> LateState:
        """Return the state before step 0: the start of `base`, inputs of 0, and -1 as the last step."""
        start = jax.tree.map(jnp.asarray, self.base.init())
        return LateState(start, jnp.zeros((self.delay, len(self.inputs))), jnp.asarray(-1))

    @predicts
    def predict(self, state: LateState, u: ArrayLike = (), k: Step = 0) -> LateState:
        """Predict over step k - delay, with the input of that step.

        `state.inputs` holds the last `delay` inputs, which are still to be used. Before step 0 nothing is predicted.
        """
        inputs = jnp.concatenate([state.inputs, jnp.asarray(u)[None]])  # of steps k - delay to k
        sent_at = jnp.asarray(k) - self.delay
        predicted = self._predict_if_begun(state.base, inputs[0], sent_at)
        return LateState(predicted, inputs[1:], jnp.asarray(k, dtype=state.step.dtype))

    def _predict_if_begun(self, base: PyTree, u: jax.Array, k: jax.Array) -> PyTree:
        """Return the state of the filter `base` predicted over step k; unchanged if k < 0, before the first step."""
        after = self.base.predict(base, u, jnp.maximum(k, 0))
        return jax.tree.map(lambda new, old: jnp.where(k >= 0, new, old), after, base)

    @corrects
    def correct(self, state: LateState, z: ArrayLike, k: Step = 0) -> tuple[LateState, Innovation]:
        """Correct with what was sent at step k - delay.

        Before the first signal arrives, the state does not change and the log-likelihood is 0.
        """
        sent_at = jnp.asarray(k) - self.delay
        after, innovation = self.base.correct(state.base, z, jnp.maximum(sent_at, 0))
        base = jax.tree.map(lambda new, old: jnp.where(sent_at >= 0, new, old), after, state.base)
        log_likelihood = jnp.where(sent_at >= 0, innovation.log_likelihood, 0.0)
        weight = None if innovation.weight is None else jnp.where(sent_at >= 0, innovation.weight, jnp.nan)
        return state._replace(base=base), replace(innovation, log_likelihood=log_likelihood, weight=weight)

    @estimates
    def estimate(self, state: LateState) -> Estimate:
        """Return the estimate of the present state: that of `delay` steps ago, predicted with the inputs since."""

        def predict_over(j: jax.Array, base: PyTree) -> PyTree:
            """Predict over the step j after that of the last signal."""
            return self._predict_if_begun(base, jnp.asarray(state.inputs)[j], state.step - self.delay + 1 + j)

        if not self.delay:
            return self.base.estimate(state.base)
        present = jax.lax.fori_loop(0, self.delay, predict_over, jax.tree.map(jnp.asarray, state.base))
        return self.base.estimate(present)

    def after_step(self, state: LateState, k: Step) -> Estimate:
        """Return the estimate of the state at step k, as `estimate` does."""
        return self.estimate(state)


def late_filter(filter: AbstractFilter, delay: int) -> LateFilter:
    """Return a filter behind a link with a constant delay, which filters the past and predicts to the present.

    Args:
        filter: a filter made for the link without delay.
        delay: whole number of steps, from 0.

    Claim: that of `filter`, for a prediction over `delay` steps.

    Raises:
        ValueError: no filter, a delay that is no whole number of steps.

    Source: prediction from the last filtered time; equal to augmenting the state with past signals.
    """
    instance("filter", filter, AbstractFilter, "a filter")
    delayed_filter = LateFilter(filter, check_count("delay", delay, least=0))
    assumed = filter.assumed
    if assumed is None or not delay or assumed.channel is None:
        return with_assumed(delayed_filter, assumed)
    channel = at_each_step(lambda link: delayed(link, delay), assumed.channel)
    return with_assumed(delayed_filter, assumed.replaced(channel=channel))


class KnownDelayFilter(AbstractWrapper):
    """The best linear filter behind a link with time stamps: the delay of each value is its last received component.

    It estimates the past signals as well, so that a signal received twice counts once, with two channel noises: joint
    noise R 11' + N I. Given all delays it is the best linear estimate.

    base: a filter of (x, y_k, ..., y_{k-D}) whose field `channel` can be replaced. channels: the moments of its channel
    for each delay, with a leading axis of the delays 0, ..., D.
    """

    base: AbstractFilter
    channels: SecondOrder

    @corrects
    def correct(self, state: PyTree, z: ArrayLike, k: Step = 0) -> tuple[PyTree, Innovation]:
        """Correct with z, whose last number is the delay d of the value before it in steps.

        The filter of past and present states uses the moments of the channel for this d. If d is missing (NaN), z is
        not used, and the state stays.
        """
        z, delay = jnp.asarray(z)[:-1], jnp.asarray(z)[-1]
        is_known = ~jnp.isnan(delay)
        longest = len(self.channels.offset) - 1
        d = jnp.clip(jnp.where(is_known, delay, 0.0).astype(int), 0, longest)
        channel = jax.tree.map(lambda leaf: jnp.asarray(leaf)[d] if eqx.is_array(leaf) else leaf, self.channels)
        base = eqx.tree_at(lambda filter: filter.channel, self.base, channel)
        after, innovation = base.correct(state, z, k)
        after = jax.tree.map(lambda new, old: jnp.where(is_known, new, old), after, state)
        # The delay is a component of z too. Its innovation is 0, or NaN without a delay.
        delay_innovation, covariance = append_flag(innovation.covariance, delay)
        log_likelihood = jnp.where(is_known, innovation.log_likelihood, 0.0)
        weight = None if innovation.weight is None else jnp.append(innovation.weight, jnp.nan)
        return after, Innovation(jnp.append(innovation.value, delay_innovation), covariance, log_likelihood, weight)


def build_known_delay_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel, make: Make) -> KnownDelayFilter:
    """Build the filter behind a link with time stamps, which receives with each value how late it is.

    The plant's state is enlarged by the past signals y_k-1, ..., y_k-D. The filter of this state is made for no delay,
    and holds the moments of the link for each delay d = 0, ..., D, to take those of the delay that is received.
    """
    if not isinstance(channel, DelayedLink):
        raise fail("channel with time stamps", "one that does not vary", "one in over_time")
    check_forgets("link with time stamps", channel.link)
    enlarged_plant, line_sensor, _ = with_past(plant, sensor, channel)  # a sensor that outputs all past signals
    links = [channel.given(d) for d in range(channel.past + 1)]  # one for each delay
    base = make(enlarged_plant, line_sensor, links[0])
    start = first(plant)
    return KnownDelayFilter(
        base=base,
        channels=stack([second_order(link) for link in links]),
        **make_sizes(base.claim, start, channel.outputs),
    )
