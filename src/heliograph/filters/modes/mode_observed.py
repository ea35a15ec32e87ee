"""Filters with side information on the links' memory: its state at this step, or at the step before."""

from itertools import product
from math import prod
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import WeightedColumns
from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.base import AbstractSizedFilter, Step, corrects, estimates, make_sizes, predicts
from heliograph.filters.gaussian.gaussian_prediction import second_moments_at_start
from heliograph.filters.gaussian.uncertain_channel_updates import Polytope
from heliograph.filters.linear.linear import correct_linear
from heliograph.filters.linear.linear_filter_state import (
    LinearBelief,
    PlantMotion,
    motion_of_plant,
    predict_belief,
    prior_belief,
)
from heliograph.filters.modes.arrival_patterns import append_flag
from heliograph.filters.modes.jump_linear_filter import claim_of_modes
from heliograph.model.channel import Channel, check_link
from heliograph.model.estimate import Estimate, Innovation, lower_claim_by_noise
from heliograph.model.fading import uncertain_chain, with_flag
from heliograph.model.over_time import at, at_each_step, first, unstack
from heliograph.model.plant import AnyPlant
from heliograph.model.premises.premise import Premise, with_premise
from heliograph.model.sensor import AnySensor, check_linear
from heliograph.numerics.check import fail
from heliograph.numerics.types import ArrayLike, Bool, Float
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.memories_of_channels import condition_on_memories, memories
from heliograph.random_affine.mixture import Mixture
from heliograph.random_affine.moments.second_moment_map import QuadraticMap
from heliograph.random_affine.moments.second_moments import SecondOrder, describe_second_moments, nominal_spread


class ModeObservedBelief(NamedTuple):
    """Belief given the data, and what the last correction is repeated from once its mode is known.

    `before`: its prior; `z` (m,): the measurement used then; `move`: the plant's motion since. `begun`: once there was
    a correction.
    """

    belief: LinearBelief
    before: LinearBelief
    z: Float[jax.Array, " m"]
    move: PlantMotion
    begun: Bool[jax.Array, ""]

    @property
    def gaussian(self) -> Gaussian:
        """Law of the state given the data."""
        return self.belief.gaussian


class ModeObservedFilter(AbstractSizedFilter):
    """Best linear filter given the states of the links' memories, at each step with z, or of the step before (`late`).

    The received vector is z followed by the states of the memories, as `with_flag` delivers them. If they are late, the
    last update is repeated with the mode that is now known, then z is used under the law of the mode that follows.
    Where a state is missing z is not used.

    Source: the Kalman filter given the modes, with the spread of De Koning (1984) within each.
    """

    plant: AnyPlant
    sensor: AnySensor
    channel: Channel
    late: bool = eqx.field(static=True)

    @compile_on_call
    def init(self) -> ModeObservedBelief:
        """Return the belief before any data.

        There is no last measurement (z is NaN), and no last step (the matrix is I, without noise).
        """
        belief = prior_belief(at(self.plant, k=0))
        n = len(belief.gaussian.mean)
        zeros = jnp.zeros((n, n))
        no_noise = WeightedColumns(zeros, jnp.zeros(n))
        return ModeObservedBelief(
            belief=belief,
            before=belief,
            z=jnp.full(first(self.channel).outputs, jnp.nan),
            move=PlantMotion(matrix=jnp.eye(n), shift=jnp.zeros(n), covariance=zeros, noise=no_noise),
            begun=jnp.asarray(False),
        )

    @predicts
    def predict(self, state: ModeObservedBelief, u: ArrayLike = (), k: Step = 0) -> ModeObservedBelief:
        """Predict both pairs of moments over step k."""
        move = motion_of_plant(at(self.plant, k), jnp.asarray(u), second_moments_at_start(self.plant))
        return state._replace(belief=predict_belief(state.belief, move), move=move)

    @corrects
    def correct(self, state: ModeObservedBelief, z: ArrayLike, k: Step = 0) -> tuple[ModeObservedBelief, Innovation]:
        """Correct with z, given the states of the links' memories that came with it.

        Where `late`, they are those of the step before: its measurement is used again with them, then z under the law
        of the memories that follows. z: what the channel delivers (m,), then one number for each memory, the number of
        its mode or its gain; NaN for what did not arrive. Without these numbers z is not used.
        """
        sensor, channel, observed = at(self.sensor, k), at(self.channel, k), jnp.asarray(z)
        m = channel.outputs
        z, memory_states = observed[:m], observed[m:]
        # At the first step there are no states of a step before: none are needed.
        is_known = ~jnp.any(jnp.isnan(memory_states)) | (~state.begun if self.late else False)
        states_or_zero = jnp.nan_to_num(memory_states)  # what is computed with a 0 for a NaN is not used
        if self.late:
            # The states that came are those of the step before: use them there first.
            redone = self._redo_last_step(state, states_or_zero, k)
            prior = jax.tree.map(lambda a, b: jnp.where(is_known & state.begun, a, b), redone, state.belief)
            described = self._describe_channel_after(state.begun, states_or_zero, k)
        else:
            prior, described = state.belief, _find_moments_given_states(channel, states_or_zero)
        # Update with z, which is not used where a state is missing.
        usable = jnp.where(is_known, z, jnp.nan)
        after, innovation = correct_linear(prior, sensor, described, Polytope(), z, second_moments_at_start(self.plant))
        after = jax.tree.map(lambda a, b: jnp.where(is_known, a, b), after, prior)
        value, spread = innovation.value, jnp.asarray(innovation.covariance)
        # The innovation has a place for each number that arrives, also for these; they add nothing to the likelihood.
        for memory_state in memory_states:
            flag_innovation, spread = append_flag(spread, memory_state)
            value = jnp.append(value, flag_innovation)
        belief = ModeObservedBelief(belief=after, before=prior, z=usable, move=state.move, begun=jnp.asarray(True))
        return belief, Innovation(value, spread, innovation.log_likelihood)

    def _redo_last_step(self, state: ModeObservedBelief, memory_states: jax.Array, k: Step) -> LinearBelief:
        """Return the prior of step k, after the last correction is made again with what was learned since.

        The states of the links' memories are received one step late. They give better moments of the channel for the
        last measurement `state.z`, which corrects the belief `state.before` again.
        """
        last_step = jnp.maximum(jnp.asarray(k) - 1, 0)
        channel = _find_moments_given_states(at(self.channel, last_step), memory_states)
        initial_power = second_moments_at_start(self.plant)
        corrected, _ = correct_linear(
            state.before, at(self.sensor, last_step), channel, Polytope(), state.z, initial_power
        )
        return predict_belief(corrected, state.move)

    def _describe_channel_after(self, has_begun: jax.Array, memory_states: jax.Array, k: Step) -> SecondOrder:
        """Return the channel's moments at step k, given the states of the links' memories one step before.

        A memory is what a link remembers, such as its mode. At the first step (`has_begun` is False) there are no such
        states.
        """
        channel, last_step = at(self.channel, k), jnp.maximum(jnp.asarray(k) - 1, 0)
        at_later_step = _find_moments_given_earlier_states(at(self.channel, last_step), channel, memory_states)
        at_first_step = _find_moments_given_earlier_states(None, channel, memory_states)
        moments: SecondOrder = jax.tree.map(lambda a, b: jnp.where(has_begun, a, b), at_later_step, at_first_step)
        return moments

    @estimates
    def estimate(self, state: ModeObservedBelief) -> Estimate:
        """Return the mean and covariance of the estimate."""
        return Estimate(state.gaussian.mean, state.gaussian.covariance, self.claim)


def _find_moments_given_states(channel: AbstractRandomAffine, numbers: jax.Array) -> SecondOrder:
    """Return the second moments of the channel given the memories' states, as numbers."""
    states = [m.state_from_number(number) for m, number in zip(memories(channel).values(), numbers, strict=True)]
    return _find_nominal_moments(condition_on_memories(channel, states))


def _find_moments_given_earlier_states(
    last: AbstractRandomAffine | None, channel: AbstractRandomAffine, numbers: jax.Array
) -> SecondOrder:
    """Return the moments of the channel given the memories' states one step before; without them, of the first step."""
    # Of each memory its possible next states, with their probabilities: (state, weight) pairs.
    choices = []
    for (identity, memory), number in zip(memories(channel if last is None else last).items(), numbers, strict=True):
        state = None if last is None else memory.state_from_number(number)
        states, weights = memory.next_state_quadrature(state, channel.degree_in(identity))
        choices.append([(states[j], weights[j]) for j in range(len(weights))])
    # The channel is the mixture over all combinations.
    maps, probabilities = [], []
    for combination in product(*choices):
        maps.append(condition_on_memories(channel, [state for state, _ in combination]))
        probabilities.append(jnp.asarray(prod(weight for _, weight in combination)))
    return _find_nominal_moments(Mixture(maps, jnp.stack(probabilities)))


def _find_nominal_moments(channel: AbstractRandomAffine) -> SecondOrder:
    """Return the mean and spread of the channel under the nominal law, for numbers that may be traced.

    The nominal law has the probabilities as given, without their radii of uncertainty. Traced numbers are those that a
    fit searches.
    """
    mean, spread = jnp.asarray(channel.moments(1).mean[:-1]), nominal_spread(channel)
    spread = QuadraticMap(jnp.asarray(spread.center), jnp.asarray(spread.radius))
    # Bounds of an uncertain law are not used: their maps are zero.
    zero_map = QuadraticMap(jnp.zeros_like(spread.center), jnp.zeros_like(spread.radius))
    return describe_second_moments(
        mean=mean, spread=spread, shift=zero_map, power=zero_map, nominal=spread, uncertain=False
    )


def mode_known_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> ModeObservedFilter:
    """Return the best linear filter with side information: current modes or drifting gains of links arrive with z.

    Its measurements are those of `with_flag(link)`; a `Node` refuses flags of the step before.

    Args:
        plant: a linear plant, n states.
        sensor: a linear sensor, m outputs.
        channel: from the sensor to the filter, without the flags and without erasures.

    Claim: "exact", given the side information; "upper" where noise is known by bounds, "nominal" where probabilities
        within a mode are uncertain.

    Raises:
        ValueError: a plant or sensor that is not linear, a channel with erasures, or parts that do not fit.

    Source: the Kalman filter given the modes, with the spread of De Koning (1984) within each.
    """
    return _make_mode_observed_filter(plant, sensor, channel, late=False)


def mode_late_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> ModeObservedFilter:
    """Return the best linear filter with late side information: the links' modes or drifting gains of the step before.

    Its measurements are those of `with_flag(link, late=True)`; a `Node` refuses flags of the same step.

    Args:
        plant: a linear plant, n states.
        sensor: a linear sensor, m outputs.
        channel: from the sensor to the filter, without the flags and without erasures.

    Claim: as `mode_known_filter`.

    Raises:
        ValueError: a plant or sensor that is not linear, a channel with erasures, or parts that do not fit.

    Source: the Kalman filter given the modes, and one update with the law of the mode that follows the last.
    """
    return _make_mode_observed_filter(plant, sensor, channel, late=True)


def _make_mode_observed_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel, late: bool) -> ModeObservedFilter:
    """Check the parts; return the best linear filter that receives the states of the links' memories with z.

    A memory is a chain of modes, or a gain that drifts, in the channel. Its state arrives at the same step, or `late`:
    one step later.
    """
    check_linear("filter that observes the mode", plant, sensor)
    # Erasures are side information of another kind.
    if any(step.erases for step in unstack(channel) if isinstance(step, AbstractRandomAffine)):
        expected = "a channel without erasures (side_information_filter with flags=np.eye(modes) takes them)"
        raise fail("filter that observes the mode", expected, "one that loses packets")
    start = first(plant)
    check_link(first(sensor), first(channel), len(start.states))
    # From a late mode the present one is predicted by the chain: nominal where the chain is uncertain.
    claim = "nominal" if late and uncertain_chain(channel) else claim_of_modes(channel)
    claim = lower_claim_by_noise(claim, plant, sensor, channel)
    # Received: z and one number per memory.
    received_numbers = first(channel).outputs + len(memories(channel))
    filter = ModeObservedFilter(
        plant=plant,
        sensor=sensor,
        channel=channel,
        late=late,
        **make_sizes(claim, start, received_numbers),
    )
    received = at_each_step(lambda link: with_flag(link, late=late), channel) if memories(channel) else channel
    return with_premise(filter, Premise(plant, sensor, received))
