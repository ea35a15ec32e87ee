"""Best linear filter behind a random channel with independent draws, and the choice of the filter for others."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import heliograph.filters.modes as modes
import heliograph.filters.words as words
import heliograph.filters.wrappers as wrappers
from heliograph.filters.base import AbstractFilter, AbstractSizedFilter, Step, corrects, estimates, make_sizes, predicts
from heliograph.filters.gaussian.gaussian import correct_signal, describe_channel_moments
from heliograph.filters.gaussian.gaussian_prediction import second_moments_at_start
from heliograph.filters.gaussian.signal_moments import Signal, bound_signal_power_at_start
from heliograph.filters.gaussian.uncertain_channel_updates import Polytope
from heliograph.filters.linear.linear_filter_state import (
    LinearBelief,
    MomentsBeforeData,
    motion_of_plant,
    predict_belief,
    prior_belief,
)
from heliograph.filters.linear.precomputed_filter import plan_filter
from heliograph.filters.smoother_step import SmootherStep, StepTrace, smoother_step_of
from heliograph.filters.wrappers.accepted_models import accept_limits, accept_sensor_inputs, accept_told_numbers
from heliograph.model.assumed.assumed_model import believes
from heliograph.model.channel import Channel, check_link
from heliograph.model.estimate import Claim, Estimate, Innovation, lower_claim_by_noise
from heliograph.model.fading import uncertain_chain
from heliograph.model.markov_jump_models import list_mode_models
from heliograph.model.over_time import OverTime, at, first, stack_over_time
from heliograph.model.plant import AbstractPlant, AnyPlant
from heliograph.model.sensor import AnySensor, LinearSensor, check_linear
from heliograph.numerics.check import fail
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.random_affine.base import check_maps
from heliograph.random_affine.memories_of_channels import is_memory_dependent
from heliograph.random_affine.moments.second_moments import SecondOrder, has_known_mean
from heliograph.random_affine.noises.outlier_noise import has_bounded_noise
from heliograph.random_affine.words.rounding_noise import find_rounded_noises

if TYPE_CHECKING:  # what few calls need is loaded by them
    from heliograph.filters.linear.likelihood_scores import ScoreRecursion
    from heliograph.model.words.encoder import Words


class LinearFilter(AbstractSizedFilter):
    """The linear minimum-mean-square-error filter of a linear plant behind a random affine channel z = G y + n.

    With y = C x + v, M = E[G] and Y = E[y y'] = C E[x x'] C' + R:

        S = M (C P- C' + R) M' + E[(G - M) Y (G - M)'] + Cov n     innovation covariance
        K = P- C' M' S^-1,  m = m- + K (z - M (C m- + E v) - E n),  P = P- - K S K'

    The middle term of S is what an ordinary Kalman filter lacks: the random gain multiplies the whole signal, not only
    its unknown part. Y is propagated from the state's moments before any data instead of being taken from the estimate.
    Then the claim is exact; where probabilities are uncertain, an upper bound.

    The innovation has the nominal law's covariance; it is not Gaussian, so its Gaussian likelihood is nominal.

    `mean_known`: whether E[G] is known. If so, the claim of smoothed estimates is that of the filter: with the gains
    fixed, what dominates each step's noise dominates the error. Otherwise it is nominal.

    Source: De Koning, Optimal estimation of linear discrete-time systems with stochastic parameters (1984).
    """

    plant: AnyPlant
    sensor: AnySensor
    channel: SecondOrder | OverTime
    rule: Polytope
    mean_known: bool = eqx.field(static=True)

    @in_float64
    def init(self) -> LinearBelief:
        """Return the prior law of x_0: as the estimate, and as the state's moments before any data."""
        return prior_belief(self.law_at_start)

    @predicts
    def predict(self, state: LinearBelief, u: ArrayLike = (), k: Step = 0) -> LinearBelief:
        """Predict mean and covariance to A m + B u + E w and A P A' + Q, of two laws of the state.

        They are that of the estimate, and that of the state before any data, on which noise of a random gain depends.
        """
        motion = motion_of_plant(at(self.plant, k), jnp.asarray(u), second_moments_at_start(self.plant))
        return predict_belief(state, motion)

    @corrects
    def correct(self, state: LinearBelief, z: ArrayLike, k: Step = 0) -> tuple[LinearBelief, Innovation]:
        """Correct the estimate with the components of z that arrived; moments before any data stay as they are."""
        sensor, channel, start = at(self.sensor, k), at(self.channel, k), second_moments_at_start(self.plant)
        return correct_linear(state, sensor, channel, self.rule, jnp.asarray(z), start)

    @estimates
    def estimate(self, state: LinearBelief) -> Estimate:
        """Return the mean and covariance of the state given the data, those of `state.gaussian`."""
        return Estimate(state.gaussian.mean, state.gaussian.covariance, self.claim)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step of x+ = A x + b + w by the Rauch-Tung-Striebel recursion.

        It is the best linear smoother, since w is white and independent of gains and past draws. `slopes_and_noise`
        holds the slopes of A x in the factors of x, and factors of Cov w.
        """
        motion = motion_of_plant(at(self.plant, step.k), jnp.asarray(step.u), second_moments_at_start(self.plant))
        slopes_and_noise = motion.matrix @ step.before.gaussian.root, motion.noise
        claim: Claim = self.claim if self.mean_known else "nominal"
        return smoother_step_of(step, slopes_and_noise, claim)

    @property
    def is_linear(self) -> bool:
        """Always True: its gains and covariances depend on moments before any data, so data move only the mean."""
        return True

    @property
    def has_score_recursion(self) -> bool:
        """True if `score_rows` can differentiate the log-likelihood by a recursion.

        It can for a known law of the channel, and a noise that depends on the signal only through a random gain.
        """
        return not (stack_over_time(self.channel).uncertain or find_rounded_noises(self.sensor))

    @property
    def has_known_gain(self) -> bool:
        """True if no gain of the channel is random: its covariance is 0 at all steps.

        Then no covariance of the filter needs E[x x'] before any data. A gain that JAX traces counts as random.
        """
        gain_covariance = stack_over_time(self.channel).gain_covariance
        return not (is_traced(gain_covariance) or np.any(np.asarray(gain_covariance)))

    def score_rows(
        self, make: Callable[[Array], "LinearFilter"], x: Float[Array, " p"], half: Array
    ) -> "ScoreRecursion":
        """Return the recursion over rows of data that gives a filter's log-likelihood, its gradient and information.

        A fit searches values for p numbers of the model, and needs the gradient by them and Fisher's information. They
        are those of the filter make(x), not of this one, which only says whether the channel's gain is known.

        Args:
            make: makes a filter from the free numbers; its `has_score_recursion` is True.
            x: values (p,) of the free numbers.
            half: number of the row at which the recording's second half begins. Information is summed for each half.

        Source: Gupta and Mehra, Computational aspects of maximum likelihood estimation (1974).
        """
        from heliograph.filters.linear.likelihood_scores import ScoreRecursion  # not before a fit needs it

        return ScoreRecursion(make=make, x=x, half=half, known_gain=self.has_known_gain, informed=True)

    @property
    def law_at_start(self) -> AbstractPlant:
        """The plant of the first step, from whose law of the first state the filter starts."""
        plant: AbstractPlant = at(self.plant, k=0)
        return plant

    def trace_log_likelihood(
        self, plain: Callable[..., jax.Array], z: Float[Array, "steps m"], u: Float[Array, "steps inputs"]
    ) -> jax.Array:
        """Return plain(self, z, u), the log-likelihood of rows by the filter's steps, for derivatives by parameters.

        If the channel's law is known, the same value gets a derivative that goes by covariances, which is faster.
        """
        if not self.has_score_recursion:
            return super().trace_log_likelihood(plain, z, u)
        from heliograph.filters.linear.traced_likelihood import trace_log_likelihood  # not before a trace needs it

        return trace_log_likelihood(plain, self, z, u)

    def planned(self, inputs: Float[Array, "horizon inputs"]) -> AbstractFilter:
        """Return the filter with gains and covariances of each step computed in advance, for these inputs."""
        return plan_filter(self, inputs)

    def given_record(self) -> AbstractFilter:
        """Return a filter with the same estimates, whose covariances are those given its data.

        Where no gain is random, they are the filter's own covariances, and the filter itself is returned.
        """
        if self.assumed is None or self.assumed.channel is None or first(self.assumed.channel).has_known_gain:
            return self  # no gain is random
        from heliograph.filters.linear.covariance_given_recording import LinearFilterOfRecord

        return LinearFilterOfRecord(filter=self, plant=self.plant, **make_sizes("nominal", self, self.received))


def signal_before_data(state: LinearBelief, sensor: LinearSensor, initial_power: jax.Array) -> Signal:
    """Return the moments of y = C x + v before any data, E y and E[y y'], with the slopes of the estimate's error.

    They depend on the error covariance and on the state's moments before data, but not on the estimate: so gain and
    covariance do not depend on data. `initial_power` is E[x_i^2] at the start, which decides the rounding.
    """
    y = MomentsBeforeData(state.state_mean, state.state_covariance).measure(sensor)
    return Signal(
        prior=state.gaussian,
        mean=y.mean,
        slopes=jnp.asarray(sensor.matrix) @ state.gaussian.root,
        noise=y.noise,
        second=y.second,
        size=bound_signal_power_at_start(sensor, initial_power),
    )


def correct_linear(
    state: LinearBelief,
    sensor: LinearSensor,
    channel: SecondOrder,
    rule: Polytope,
    z: jax.Array,
    initial_power: jax.Array,
) -> tuple[LinearBelief, Innovation]:
    """Return the estimate corrected with the components of z (m,) that arrived, and the innovation.

    z = G y + n of the signal y = C x + v. The innovation is z - E[G] (C m + E v) - E n, with the estimate m. The gain
    and covariance use E[y y'] before any data instead of m. `rule` says how uncertain probabilities of the channel are
    bounded. `initial_power` is E[x_i^2] at the start, which decides the rounding.
    """
    before_data = signal_before_data(state, sensor, initial_power)
    expected_y = jnp.asarray(sensor.matrix @ state.gaussian.mean + sensor.noise.mean)  # C m + E v
    about_estimate = before_data._replace(mean=expected_y)
    after, innovation = correct_signal(about_estimate, channel, rule, z, moments_for_gain=before_data)
    return state._replace(gaussian=after), innovation


@accept_limits
@believes
@accept_sensor_inputs
@accept_told_numbers
def linear_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: Channel,
    update: Polytope | None = None,
    encoder: "Words | None" = None,
) -> AbstractFilter:
    """Return the best linear filter for a linear plant and sensor behind any channel.

    Modes of links, of a `markov_plant` and of a `markov_sensor` are estimated jointly; if a link with memory also loses
    data, what arrives is used as information on the modes (`side_information_filter`). Behind a late link the past
    signals are estimated jointly, unless the delay is constant.

    Inputs are taken as known in advance. Behind a random gain the noise depends on the second moment of the state, and
    this is that of the plant under such inputs; an input computed from the estimates depends on the gains drawn, so in
    closed loop the covariance is not the error's and the claim does not hold, worst for an unstable plant, whose moment
    grows without bound.

    Args:
        plant: a linear plant, n states, or one with modes whose laws are linear.
        sensor: a linear sensor, m outputs, with white noise, or one with modes.
        channel: from the sensor to the filter; beside modes of plant or sensor one without losses.
        update: how uncertain probabilities are bounded; `Polytope()` by default, none behind links with memory.
        encoder: `Words` as which the sensor's measurement is sent, where the channel is one of words; none by default.

    Claim: "exact"; "upper" where probabilities are uncertain, "nominal" there by `ZeroMean`. Behind words:
    "exact" with a triangular dither, with one that is taken off behind a known gain, and with any but "none" of a
    Gaussian y; "upper" else with these; without dither "exact" if the sensor's noise is Gaussian with a deviation of a
    step or more, "nominal" if not; and "nominal" where overload may change the rms error by more than 1 %.

    Raises:
        ValueError: a plant or sensor that is not linear, parts that do not fit, or, beside modes of plant or sensor,
            losses or uncertain transitions.

    Source: De Koning (1984), for multiplicative noise; Costa (1994), for modes.
    """
    if encoder is not None:
        return words.build_behind_words(plant, sensor, channel, encoder, partial(linear_filter, update=update))
    # Delays: the same filter for the system enlarged by past signals.
    if check_maps("channel", [first(channel)])[0].past:
        return wrappers.build_behind_delays(plant, sensor, channel, partial(linear_filter, update=update))
    for moves, senses in product(list_mode_models(first(plant)), list_mode_models(first(sensor))):
        check_linear("linear filter", moves, senses)
        check_link(senses, first(channel), len(moves.states))
    # Memory: the modes are estimated jointly with the state. A sensor that rounds may lower the claim.
    if first(channel).remembers or is_memory_dependent(first(plant)) or is_memory_dependent(first(sensor)):
        if update is not None:
            raise fail("update", "none behind a channel that remembers", type(update).__name__)
        if has_bounded_noise(plant, sensor, channel):
            raise fail("noise behind a channel that remembers", "a known law", "bounds of outliers alone")
        filter = _make_filter_behind_memory(plant, sensor, channel)
        if not find_rounded_noises(sensor):
            return filter
        return replace(filter, claim=lower_claim_by_noise(filter.claim, sensor))
    # Independent draws: second moments of the channel are all that matters.
    rule = Polytope() if update is None else update
    described = describe_channel_moments(channel, rule)
    moments = stack_over_time(described)
    claim = lower_claim_by_noise(rule.claim(moments.uncertain), plant, sensor, channel)
    return LinearFilter(
        plant=plant,
        sensor=sensor,
        channel=described,
        rule=rule,
        mean_known=not moments.uncertain or has_known_mean(moments),
        **make_sizes(claim, first(plant), first(channel).outputs),
    )


def _make_filter_behind_memory(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> AbstractFilter:
    """Return the filter that estimates the modes of links, plant and sensor jointly with the state.

    There is a filter for each case, tested in this order: plant or sensor has modes, losses reveal the channel's mode,
    the chain is uncertain, the channel is a sum of independent links, or none of these.
    """
    if is_memory_dependent(first(plant)) or is_memory_dependent(first(sensor)):
        return _make_jump_system_filter(plant, sensor, channel)
    if first(channel).erases:
        return modes.side_information_filter(plant, sensor, channel)
    if uncertain_chain(channel):
        return modes.uncertain_modal_filter(plant, sensor, channel)
    terms = modes.independent_terms(channel)
    if len(terms) > 1:
        return modes.additive_modal_filter(plant, sensor, terms)
    return modes.modal_filter(plant, sensor, channel)


def _make_jump_system_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> AbstractFilter:
    """Return the best linear filter of a plant or sensor whose matrices depend on a mode, a hidden Markov chain.

    The model at the first step (`first`) stands for all: which kinds of models there are does not vary over time.

    Raises:
        ValueError: a channel that loses data, or one of uncertain transition probabilities. No best linear filter of
            these together with modes is known here.
    """
    if first(channel).erases:
        expected = "a link without losses where plant or sensor has modes (a row that is lost is NaN; imm_filter else)"
        raise fail("channel of a linear filter", expected, "an erasure")
    if uncertain_chain(channel):
        expected = "known transitions where plant or sensor has modes"
        raise fail("channel of a linear filter", expected, "a radius of uncertainty")
    return modes.modal_filter(plant, sensor, channel)
