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
from heliograph.model.assumed.assumed_model import AssumedModel, with_assumed
from heliograph.model.channel import Channel, check_link
from heliograph.model.estimate import Estimate, Innovation, lower_claim_by_noise
from heliograph.model.fading import uncertain_chain, with_flag
from heliograph.model.over_time import at, at_each_step, first, unstack
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor, check_linear
from heliograph.numerics.check import fail
from heliograph.numerics.types import ArrayLike, Bool, Float
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.memories_of_channels import condition_on_memories, memories
from heliograph.random_affine.mixture import Mixture
from heliograph.random_affine.moments.second_moment_map import QuadraticMap
from heliograph.random_affine.moments.second_moments import SecondOrder, describe_second_moments, nominal_covariance


class ModeObservedBelief(NamedTuple):
    """Estimate given the data, and what is needed to repeat the last correction once its mode is known.

    `belief`: moments of x given the data, and before any data; `before`: those before the last correction; `z` (m,):
    the measurement used in it; `move`: the plant's motion since. `begun`: True once there was a correction.
    """

    belief: LinearBelief
    before: LinearBelief
    z: Float[jax.Array, " m"]
    move: PlantMotion
    begun: Bool[jax.Array, ""]

    @property
    def gaussian(self) -> Gaussian:
        """The Gaussian of x given the data: of the estimate, not the one before any data."""
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
        """Return the filter's state before any data: the law of x_0.

        The state also holds the last measurement and the last motion of the plant, to repeat a step whose mode is
        reported late. There are none yet: z is NaN, and the motion is x+ = x.
        """
        belief = prior_belief(at(self.plant, k=0))
        n = len(belief.gaussian.mean)
        zeros = jnp.zeros((n, n))
        no_noise = WeightedColumns(zeros, jnp.zeros(n))
        return ModeObservedBelief(
            belief=belief,
            before=belief,
            z=jnp.full(first(self.channel).outputs, jnp.nan),
            move=PlantMotion(matrix=jnp.eye(n), offset=jnp.zeros(n), covariance=zeros, noise=no_noise),
            begun=jnp.asarray(False),
        )

    @predicts
    def predict(self, state: ModeObservedBelief, u: ArrayLike = (), k: Step = 0) -> ModeObservedBelief:
        """Predict the moments of x over step k, those given the data and those before any data.

        The plant's motion is kept: a late report of the mode repeats the correction before it, and then the motion.
        """
        move = motion_of_plant(at(self.plant, k), jnp.asarray(u), second_moments_at_start(self.plant))
        return state._replace(belief=predict_belief(state.belief, move), move=move)

    @corrects
    def correct(self, state: ModeObservedBelief, z: ArrayLike, k: Step = 0) -> tuple[ModeObservedBelief, Innovation]:
        """Correct with z, given the states of the links' memories that came with it.

        A link's gain depends on a memory (a Markov chain's mode, or a gain that drifts), which is reported to the
        receiver. If `self.late`, the states are those of the step before: then that step's measurement is used again
        with them, and z with the law of the present states that follows from them.

        Args:
            state: estimate, and what the last correction used, to repeat it.
            z: what the channel delivers (m,), then one number for each memory, the number of its mode or its gain; NaN
                for what did not arrive. Without these numbers z is not used.
            k: number of the step.
        """
        sensor, channel, observed = at(self.sensor, k), at(self.channel, k), jnp.asarray(z)
        m = channel.outputs
        z, memory_states = observed[:m], observed[m:]
        # At the first step there are no states of a step before: none are needed.
        is_known = ~jnp.any(jnp.isnan(memory_states)) | (~state.begun if self.late else False)
        states_or_zero = jnp.nan_to_num(memory_states)  # what is computed with a 0 for a NaN is not used
        if self.late:
            # The states that came are those of the step before: repeat its correction with them first.
            redone = self._redo_last_step(state, states_or_zero, k)
            prior = jax.tree.map(lambda a, b: jnp.where(is_known & state.begun, a, b), redone, state.belief)
            channel_moments = self._predict_channel_moments(state.begun, states_or_zero, k)
        else:
            prior, channel_moments = state.belief, _find_moments_given_states(channel, states_or_zero)
        # Update with z, which is not used where a state is missing.
        usable = jnp.where(is_known, z, jnp.nan)
        corrected, innovation = correct_linear(
            prior, sensor, channel_moments, Polytope(), z, second_moments_at_start(self.plant)
        )
        corrected = jax.tree.map(lambda a, b: jnp.where(is_known, a, b), corrected, prior)
        value, covariance = innovation.value, jnp.asarray(innovation.covariance)
        # The innovation has an entry for each received number, also for the states, which are given: 0 or NaN.
        for memory_state in memory_states:
            flag_innovation, covariance = append_flag(covariance, memory_state)
            value = jnp.append(value, flag_innovation)
        belief = ModeObservedBelief(belief=corrected, before=prior, z=usable, move=state.move, begun=jnp.asarray(True))
        return belief, Innovation(value, covariance, innovation.log_likelihood)

    def _redo_last_step(self, state: ModeObservedBelief, memory_states: jax.Array, k: Step) -> LinearBelief:
        """Return the prior of step k after the correction of step k - 1 is made again, with the channel's state then.

        `memory_states` are numbers, received one step late: for each link with memory the number of its mode, or its
        gain, at step k - 1. Given these, `state.z` corrects `state.before` again, and the plant moves the result.
        """
        last_step = jnp.maximum(jnp.asarray(k) - 1, 0)
        channel = _find_moments_given_states(at(self.channel, last_step), memory_states)
        initial_power = second_moments_at_start(self.plant)
        no_uncertain_laws = Polytope()
        corrected, _ = correct_linear(
            state.before, at(self.sensor, last_step), channel, no_uncertain_laws, state.z, initial_power
        )
        return predict_belief(corrected, state.move)

    def _predict_channel_moments(self, has_begun: jax.Array, memory_states: jax.Array, k: Step) -> SecondOrder:
        """Return the mean and covariance of (G, n) in z = G y + n at step k, given the links' states at step k - 1.

        A link's state is what it remembers: its mode, or a gain that drifts. At the first step (`has_begun` is False)
        no earlier states exist, and the moments are those under the initial laws.
        """
        channel, last_step = at(self.channel, k), jnp.maximum(jnp.asarray(k) - 1, 0)
        given_last_states = _find_moments_of_next_states(at(self.channel, last_step), channel, memory_states)
        at_first_step = _find_moments_of_next_states(None, channel, memory_states)
        moments: SecondOrder = jax.tree.map(lambda a, b: jnp.where(has_begun, a, b), given_last_states, at_first_step)
        return moments

    @estimates
    def estimate(self, state: ModeObservedBelief) -> Estimate:
        """Return the mean and covariance of x given the data."""
        return Estimate(state.gaussian.mean, state.gaussian.covariance, self.claim)


def _find_moments_given_states(channel: AbstractRandomAffine, numbers: jax.Array) -> SecondOrder:
    """Return the mean and covariance of (G, n) in z = G y + n, given the present states of the links' memories.

    A memory is what the next draw of a link depends on: a Markov chain of modes, or a gain that drifts.
    `numbers` holds for each memory its mode's number, or the gain, as the receiver was given them.
    """
    states = [m.state_from_number(number) for m, number in zip(memories(channel).values(), numbers, strict=True)]
    return _find_nominal_moments(condition_on_memories(channel, states))


def _find_moments_of_next_states(
    last_channel: AbstractRandomAffine | None, channel: AbstractRandomAffine, numbers: jax.Array
) -> SecondOrder:
    """Return the mean and covariance of (G, n) in z = G y + n, given the links' states one step before.

    Args:
        last_channel: the channel one step before; None at the first step, where states have their initial laws.
        channel: the channel at this step.
        numbers: for each memory (a chain of modes, or a gain that drifts) its state one step before, as a number.
    """
    # For each memory pairs (next state, probability). A gain that drifts has quadrature points as next states, enough
    # for the degree in which z depends on it.
    next_states = []
    known_memories = memories(channel if last_channel is None else last_channel)
    for (identity, memory), number in zip(known_memories.items(), numbers, strict=True):
        state = None if last_channel is None else memory.state_from_number(number)
        states, weights = memory.next_state_quadrature(state, channel.degree_in(identity))
        next_states.append([(states[j], weights[j]) for j in range(len(weights))])
    # The channel is the mixture over all combinations of next states.
    maps, probabilities = [], []
    for combination in product(*next_states):
        maps.append(condition_on_memories(channel, [state for state, _ in combination]))
        probabilities.append(jnp.asarray(prod(weight for _, weight in combination)))
    return _find_nominal_moments(Mixture(maps, jnp.stack(probabilities)))


def _find_nominal_moments(channel: AbstractRandomAffine) -> SecondOrder:
    """Return the mean and covariance of the channel under the nominal law, for numbers that may be traced.

    The nominal law has the probabilities as given, without their radii of uncertainty. Traced numbers are those that a
    fit searches.
    """
    mean, covariance = jnp.asarray(channel.moments(1).mean[:-1]), nominal_covariance(channel)
    covariance = QuadraticMap(jnp.asarray(covariance.center), jnp.asarray(covariance.radius))
    # Bounds of an uncertain law are not used: their maps are zero.
    zero_map = QuadraticMap(jnp.zeros_like(covariance.center), jnp.zeros_like(covariance.radius))
    return describe_second_moments(
        mean=mean, spread=covariance, shift=zero_map, power=zero_map, nominal=covariance, uncertain=False
    )


def mode_known_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> ModeObservedFilter:
    """Return the best linear filter with side information: current modes or drifting gains of links arrive with z.

    Its measurements are those of `with_flag(link)`: z, then for each link with memory the number of its mode, or its
    gain, at the same step. A `Node` refuses a link that reports those of the step before.

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

    Its measurements are those of `with_flag(link, late=True)`: z, then for each link with memory the number of its
    mode, or its gain, one step before. A `Node` refuses a link that reports those of the same step.

    Args:
        plant: a linear plant, n states.
        sensor: a linear sensor, m outputs.
        channel: from the sensor to the filter, without the flags and without erasures.

    Claim: as `mode_known_filter`.

    Raises:
        ValueError: a plant or sensor that is not linear, a channel with erasures, or parts that do not fit.

    Source: the Kalman filter given all modes up to the step before, then one update under the law of the present mode
    given the last.
    """
    return _make_mode_observed_filter(plant, sensor, channel, late=True)


def _make_mode_observed_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel, late: bool) -> ModeObservedFilter:
    """Check the parts; return the best linear filter that receives the states of the links' memories with z.

    A memory is a chain of modes, or a gain that drifts, in the channel. Its state arrives at the same step, or `late`:
    one step later. The filter's claim says what its covariance is: exact, or only nominal. All parts are linear.
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
    return with_assumed(filter, AssumedModel(plant, sensor, received))
