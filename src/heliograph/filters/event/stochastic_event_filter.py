"""One Gaussian behind a sender whose silence is Gaussian: one that sends by chance, or by schedule."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import WeightedColumns, eliminate, join_columns, zero_covariance
from heliograph.factors.factored_gaussian import Gaussian, condition_on_observation, from_columns, from_covariance
from heliograph.filters.base import AbstractSizedFilter, Step, corrects, estimates, predicts
from heliograph.filters.event.gaussian_sum import FLOOR, GaussianSum, concatenate_sums, merge_groups, safe_log
from heliograph.filters.gaussian.gaussian_prediction import (
    predict_gaussian,
    second_moments_at_start,
    smoother_step_by_transform,
)
from heliograph.filters.gaussian.moment_transforms import AbstractTransform
from heliograph.filters.gaussian.signal_moments import Signal, factor_spread, find_signal_moments
from heliograph.filters.modes.arrival_patterns import ChannelByPattern, append_flag
from heliograph.filters.modes.mixing import replicate
from heliograph.filters.modes.multiple_model import correct_in_every_mode
from heliograph.filters.smoother_step import SmootherStep, StepTrace
from heliograph.model.centred_signal import predict_signal
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import OverTime, at, first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.model.trigger import Periodic, StochasticTrigger
from heliograph.numerics.linalg import cholesky, psd_solve, symmetrize
from heliograph.numerics.types import Array, ArrayLike, Float


class StochasticBelief(NamedTuple):
    """The state (n,) given the data, the modes' law (M,) and the shared reference (m,) of the sender.

    `moved`: whether a step was predicted already: the modes move from the second on.
    """

    gaussian: Gaussian
    law: Float[jax.Array, " M"]
    reference: Float[jax.Array, " m"]
    moved: jax.Array


class StochasticEventFilter(AbstractSizedFilter):
    """The filter of `event_filter` behind a `StochasticTrigger` or `Periodic`.

    Silence of probability exp(-(y - r)' W (y - r) / 2) is r, measured of y with the noise W^-1: a Kalman update. Where
    it may be a loss too it is the sum of the prior, of weight p, and of the updated Gaussian, of weight
    (1 - p) (det W det S)^(-1/2) exp(-(C m - r)' S^-1 (C m - r) / 2), S = C P C' + R + W^-1; they are joined.
    """

    plant: AnyPlant
    sensor: AnySensor
    channel: ChannelByPattern | OverTime
    trigger: StochasticTrigger | Periodic
    initial: Float[Array, " M"]
    transform: AbstractTransform
    loses: bool = eqx.field(static=True)
    outputs: int = eqx.field(static=True)

    @property
    def silence_tells(self) -> bool:
        """Always true: silence is a measurement."""
        return True

    @compile_on_call
    def init(self) -> StochasticBelief:
        """Return the prior of x and the initial law of the link's modes; nothing was sent or predicted yet."""
        start = at(self.plant, k=0)
        x = from_covariance(start.initial_mean, start.initial_covariance)
        return StochasticBelief(
            gaussian=x, law=jnp.asarray(self.initial), reference=jnp.zeros(self.outputs), moved=jnp.asarray(False)
        )

    @predicts
    def predict(self, state: StochasticBelief, u: ArrayLike = (), k: Step = 0) -> StochasticBelief:
        """Predict x, the law of the link's modes, and the reference with which the sender compares its signal.

        Where the reference is a prediction, both ends of the link compute the same one.
        """
        plant, u = at(self.plant, k), jnp.asarray(u)
        predicted = predict_gaussian(plant, self.transform, state.gaussian, u, second_moments_at_start(self.plant))
        transition = jnp.asarray(at(self.channel, k).transition)
        # At the first step the modes have their initial law.
        law = jnp.where(state.moved, state.law @ transition, state.law)
        reference = state.reference
        if self.trigger.reference == "prediction":
            reference = self.predict_reference(state.gaussian.mean, u, k)
        return StochasticBelief(gaussian=predicted, law=law, reference=reference, moved=jnp.asarray(True))

    def predict_reference(self, mean: jax.Array, u: ArrayLike, k: Step) -> jax.Array:
        """Return the prediction of y at step k that both ends compute, from the mean after the step before and u."""
        return predict_signal(at(self.plant, k), at(self.sensor, k), mean, u)

    @corrects
    def correct(self, state: StochasticBelief, z: ArrayLike, k: Step = 0) -> tuple[StochasticBelief, Innovation]:
        """Correct with the value that came, or with the silence if none did.

        z: the value, NaN where none came; then, of a trigger whose losses are known, a flag: 1 if the link was down.
        """
        plant, sensor, channel, z = at(self.plant, k), at(self.sensor, k), at(self.channel, k), jnp.asarray(z)
        count = self.received - self.trigger.side_information(self.outputs)
        values, down = z[:count], z[count:]
        prior = state.gaussian
        signal = find_signal_moments(plant, sensor, self.transform, prior, second_moments_at_start(self.plant))

        # A value: the update in each mode of the link, joined.
        modes = len(state.law)
        signals = replicate(signal, modes)
        posteriors, weight, innovation = correct_in_every_mode(signals, channel, jnp.arange(modes), state.law, values)
        by_value = merge_groups(GaussianSum(safe_log(weight), posteriors, jnp.eye(len(weight))[:, None]))
        # No value: silence, or a link that is down.
        log_silent, given_silence = self._condition_on_silence(prior, signal, state.reference, k)
        silent = _sum_of_one_gaussian(log_silent, given_silence, state.law)
        by_silence = self._mix_silence_and_outage(prior, silent, state.law, channel, down)
        # Of a value: that it was sent says something too, behind a trigger that sends by chance.
        if isinstance(self.trigger, StochasticTrigger):
            link = self._average_link_moments(channel, state.law)
            innovation = self._condition_on_sending(innovation, link, signal, state.reference, log_silent)
        # Which of the two it is, with its likelihood; silence that the rule forbids has the likelihood FLOOR.
        arrived = jnp.any(~jnp.isnan(values))
        log_silence = jnp.maximum(by_silence.log_weight[0], np.log(FLOOR))
        after = jax.tree.map(lambda a, b: jnp.where(arrived, a, b), by_value, by_silence)
        log_likelihood = jnp.where(arrived, innovation.log_likelihood, log_silence)
        value, covariance = jnp.asarray(innovation.value), jnp.asarray(innovation.covariance)
        if len(down):
            flag_innovation, covariance = append_flag(covariance, down[0])
            value = jnp.append(value, flag_innovation)
        # The sum's one Gaussian, and the law of the link's modes, which is its label.
        x: Gaussian = jax.tree.map(lambda leaf: leaf[0], after.gaussian)
        corrected = StochasticBelief(x, after.label[0, 0], reference=state.reference, moved=state.moved)
        return corrected, Innovation(value, covariance, log_likelihood)

    def _condition_on_sending(
        self,
        innovation: Innovation,
        link: tuple[jax.Array, jax.Array],
        signal: Signal,
        reference: jax.Array,
        log_silent: jax.Array,
    ) -> Innovation:
        """Return a value's innovation given that it was sent; as it is where a component of the value is missing.

        Args:
            innovation: of the value, as if it were sent always.
            link: mean gain and spread, as `_average_link_moments` returns.
            signal: moments of y before the value.
            reference: r, with which the sender compares y (m,).
            log_silent: log P(silent) before the value.
        """
        # How z's predicted moments change by it; where a component is missing nothing does, and any numbers will do.
        value, covariance = jnp.asarray(innovation.value), jnp.asarray(innovation.covariance)
        is_complete = ~jnp.any(jnp.isnan(value))
        shift, change = self._find_moment_changes_given_sent(link, signal, reference, log_silent)
        complete = jnp.where(is_complete, value, 0.0), jnp.where(is_complete, covariance, jnp.eye(len(value)))
        # p(z | sent) is in proportion to p(z) P(sent | z).
        gain, _ = link
        log_sent = self._log_probability_sent(gain, signal, reference, *complete)
        return Innovation(
            value=jnp.where(is_complete, value - shift, value),
            covariance=jnp.where(is_complete, covariance + change, covariance),
            log_likelihood=innovation.log_likelihood + jnp.where(is_complete, log_sent, 0.0),
        )

    def _mix_silence_and_outage(
        self, prior: Gaussian, silent: GaussianSum, law: jax.Array, channel: ChannelByPattern, down: jax.Array
    ) -> GaussianSum:
        """Mix the update by silence (link up) with the prior (link down), by their weights given that no value came.

        `law`: probabilities of the modes of the link (M,); `lost`: probability in each mode that nothing arrives.
        `down`: what the receiver is told, 1 that the link is down; empty if nothing is told.
        """
        lost = jnp.asarray(channel.chance) @ (~jnp.any(jnp.asarray(channel.present), axis=1)).astype(float)
        parts = [silent.relabel_sender(0, law[None] * (1 - lost))]
        if self.loses:
            parts.append(_sum_of_one_gaussian(jnp.zeros(()), prior, law).relabel_sender(0, law[None] * lost))
        # A flag that says which of the two it was leaves one of them.
        if len(down):
            by_silence, *by_outage = parts
            is_down = down[0] > 0
            parts = [by_silence.scale_weights(jnp.where(is_down, -jnp.inf, 0.0))]
            parts += [part.scale_weights(jnp.where(is_down, 0.0, -jnp.inf)) for part in by_outage]
        return merge_groups(concatenate_sums(parts))

    def _average_link_moments(self, channel: ChannelByPattern, law: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the link's mean gain (m, p) and spread (m, m, p+1, p+1), given that all components arrive.

        The spread is that of (G, n) in z = G y + n. `law` (M,) holds the probabilities of the modes.
        `joint_probability` (M, patterns) is that of a mode and a pattern of arrivals, 0 unless all arrives.
        """
        joint_probability = jnp.asarray(channel.chance) * jnp.all(jnp.asarray(channel.present), axis=1) * law[:, None]
        gain, spread = (
            jnp.tensordot(joint_probability, jnp.asarray(moment), 2) / jnp.sum(joint_probability)
            for moment in (channel.mean, channel.spread)
        )
        return gain[:, :-1], spread

    def _find_moment_changes_given_sent(
        self, link: tuple[jax.Array, jax.Array], signal: Signal, reference: jax.Array, log_silent: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return how z's predicted mean (m,) and covariance (m, m) change given that it was sent: far from r.

        Of y ~ N(m, S) the share s is silent, with mean m + d and covariance S_s, so that of what is sent the mean is
        m - s d / (1 - s) and the second moment about m is (S - s (S_s + d d')) / (1 - s).
        """
        (gain, spread), mean, total = link, signal.mean, signal.covariance
        # Of y.
        silent = jnp.minimum(jnp.exp(log_silent), 1 - FLOOR)
        y = _law_of_signal(signal)
        _, given_silence = self._observe_silence(y, y.root, zero_covariance(len(mean)), mean, reference)
        d = given_silence.mean - mean
        shift = -silent * d / (1 - silent)
        change_about_m = (total - silent * (given_silence.covariance + jnp.outer(d, d))) / (1 - silent) - total
        # Of z: the mean gain, and the spread, which acts on second moments of (y, 1); these change by `second`.
        second = change_about_m + jnp.outer(mean, shift) + jnp.outer(shift, mean)
        second = jnp.block([[second, shift[:, None]], [shift, jnp.zeros(1)]])
        change_of_covariance = change_about_m - jnp.outer(shift, shift)
        change = gain @ change_of_covariance @ gain.T + jnp.einsum("ijkl,kl->ij", spread, second)
        return gain @ shift, symmetrize(change)

    def _log_probability_sent(
        self, gain: jax.Array, signal: Signal, reference: jax.Array, value: jax.Array, covariance: jax.Array
    ) -> jax.Array:
        """Return log P(sent | z) = log(1 - P(silent | z)) by the law of y given z, at least log FLOOR (FLOOR 1e-6).

        z = gain y + noise has the innovation `value` with the given covariance, and Cov(noise) is this covariance less
        that of gain y. Silence depends on y and on the reference.
        """
        y = _law_of_signal(signal)
        slopes = gain @ y.root
        noise = factor_spread(covariance - WeightedColumns(slopes, y.variances).covariance)
        y, _ = condition_on_observation(y, slopes, value, noise)
        log_silent, _ = self._observe_silence(y, y.root, zero_covariance(len(y.mean)), y.mean, reference)
        return jnp.log(jnp.maximum(-jnp.expm1(jnp.minimum(log_silent, 0.0)), FLOOR))

    def _observe_silence(
        self, x: Gaussian, slopes: jax.Array, noise: WeightedColumns, expected: jax.Array, reference: jax.Array
    ) -> tuple[jax.Array, Gaussian]:
        """Return log P(silent), and the law of x = mean + L xi given silence, for y = expected + slopes xi + noise.

        Silence has the probability exp(-e' W e / 2) with e = y - r. So it acts like a measurement r = y + v with
        Cov v = W^-1: the probability of silence is the density of r times a constant (the normaliser).
        """
        noise = join_columns(noise, eliminate(self._inverse_weight()))
        after, innovations = condition_on_observation(x, slopes, reference - expected, noise)
        size = jnp.abs(reference) + jnp.abs(expected)
        return innovations.log_density(jnp.ones(len(size), bool), size) + self._log_silence_normaliser(), after

    def _inverse_weight(self) -> jax.Array:
        """Return W^-1, the noise with which silence is a measurement."""
        assert isinstance(self.trigger, StochasticTrigger)
        return psd_solve(self.trigger.matrix(self.outputs), jnp.eye(self.outputs))

    def _log_silence_normaliser(self) -> jax.Array:
        """Return the log of exp(-e' W e / 2) / N(e; 0, W^-1), which is (m log(2 pi) - log det W) / 2 for all e.

        W is the matrix of the sender's rule: it stays silent with the probability exp(-e' W e / 2), e = y - r (m,).
        """
        assert isinstance(self.trigger, StochasticTrigger)
        root = cholesky(self.trigger.matrix(self.outputs))
        log_det = 2 * jnp.sum(jnp.log(jnp.diagonal(root)))
        return jnp.asarray((self.outputs * np.log(2 * np.pi) - log_det) / 2)

    def _condition_on_silence(
        self, prior: Gaussian, signal: Signal, reference: jax.Array, k: Step
    ) -> tuple[jax.Array, Gaussian]:
        """Return log P(silent) while the link is up, and the prior given silence.

        With a schedule (`Periodic`) the sender is silent with probability 0 in a step that is due, and 1 in any other.
        Silence then says nothing of x.
        """
        if isinstance(self.trigger, Periodic):
            due = jnp.asarray(k) % self.trigger.period == self.trigger.phase
            return jnp.where(due, -jnp.inf, 0.0), prior
        return self._observe_silence(prior, signal.slopes, signal.noise, signal.mean, reference)

    @estimates
    def estimate(self, state: StochasticBelief) -> Estimate:
        """Return the mean and covariance of the Gaussian."""
        return Estimate(state.gaussian.mean, state.gaussian.covariance, self.claim)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step of the Gaussian around the update."""
        return smoother_step_by_transform(self, step, first(self.plant))


def _law_of_signal(signal: Signal) -> Gaussian:
    """Return the Gaussian of the signal y before z: mean, slopes on the state's columns, and the noise beside them."""
    return from_columns(signal.mean, join_columns(WeightedColumns(signal.slopes, signal.prior.variances), signal.noise))


def _sum_of_one_gaussian(log_weight: jax.Array, belief: Gaussian, law: jax.Array) -> GaussianSum:
    """Return a sum of one Gaussian, with the probabilities `law` of the link's modes as its label."""
    alone: GaussianSum = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], GaussianSum(log_weight, belief, law[None]))
    return alone
