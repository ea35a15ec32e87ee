"""One Gaussian behind a sender whose silence is Gaussian: one that sends by chance, or by schedule."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import WeightedColumns, eliminate, join_columns, zero_covariance
from heliograph.factors.factored_gaussian import (
    Gaussian,
    condition_on_observation,
    from_columns,
    from_covariance,
    from_covariance_by_elimination,
)
from heliograph.filters.base import AbstractSizedFilter, Step, corrects, estimates, predicts
from heliograph.filters.event.gaussian_sum import FLOOR, GaussianSum, concatenate_sums, merge_groups, safe_log
from heliograph.filters.gaussian.gaussian_prediction import (
    predict_gaussian,
    second_moments_at_start,
    smoother_step_by_transform,
)
from heliograph.filters.gaussian.moment_transforms import AbstractTransform
from heliograph.filters.gaussian.signal_moments import Signal, factor_covariance, find_signal_moments
from heliograph.filters.modes.arrival_patterns import ChannelByPattern, append_flag
from heliograph.filters.modes.correction_by_mode import correct_in_every_mode
from heliograph.filters.modes.mixing import replicate
from heliograph.filters.smoother_step import SmootherStep, StepTrace
from heliograph.model.centred_signal import predict_signal
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import OverTime, at, first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.model.trigger import REFUSED, Periodic, StochasticTrigger
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
    may_lose: bool = eqx.field(static=True)
    outputs: int = eqx.field(static=True)

    @property
    def silence_tells(self) -> bool:
        """Always True: the sender is silent by a rule on its signal, so that silence is a measurement."""
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

        The sender transmits y or stays silent by a rule that depends on y and a reference, so that silence, too, tells
        of the state x. A value is used by a Gaussian update, silence by the probability of being silent given x.

        Args:
            state: Gaussian of x, probabilities of the link's modes, and the reference with which the sender compares y.
            z: the value, NaN where none came; then, if the trigger's losses are known, a flag: 1 if the link was down.
            k: number of the step.
        """
        # The parts at this step, and the moments of the sensor's signal y.
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
        # That a value was sent says something too, behind a trigger that sends by chance.
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
        # The sum's one Gaussian, and the law of the link's modes, which is its status.
        x: Gaussian = jax.tree.map(lambda leaf: leaf[0], after.gaussian)
        corrected = StochasticBelief(x, after.status[0, 0], reference=state.reference, moved=state.moved)
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

        The sender is silent with a probability that falls with the distance of y from the reference r, so that sending
        says something of y: it changes mean and covariance of the predicted value, and adds log P(sent | z) to its
        log-likelihood. -log P(sent), the same for all z, is not added here.

        Args:
            innovation: innovation of the value, as if values were always sent.
            link: E G (m, p) and Cov of (G, n) (m, m, p + 1, p + 1), for z = G y + n.
            signal: moments of y before the value.
            reference: r, with which the sender compares y (m,).
            log_silent: log P(silent) before the value.
        """
        # If a component is missing, the innovation is returned unchanged; 0 and I only stand in for NaN here.
        value = jnp.asarray(innovation.value)
        covariance = jnp.asarray(innovation.covariance)
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
        """Return one Gaussian given that no value came: the sender was silent (link up), or the link was down.

        It merges `silent`, the Gaussian given silence, of weight P(up) P(silent), and `prior`, of weight P(down). If a
        value came and is refused, it is the Gaussian given that y was sent, of weight P(up) P(sent).

        Args:
            prior: Gaussian of x before the step's data. That the link is down says nothing of x.
            silent: Gaussian of x given that the sender was silent, as a sum of one Gaussian with weight P(silent).
            law: probabilities of the M modes of the link's Markov chain.
            channel: the link: probabilities `chance` of each pattern of arrivals in each mode, and which components
                arrive (`present`).
            down: a flag that the receiver gets, (1,): 1 if the link is down, REFUSED (2) if a value came that it
                refuses, else 0; (0,) if it gets none.
        """
        # P(nothing arrives | mode) (M,). Its status holds P(mode, link up or down), whose sum multiplies the weight.
        lost = jnp.asarray(channel.chance) @ (~jnp.any(jnp.asarray(channel.present), axis=1)).astype(float)
        is_up, is_down = law[None] * (1 - lost), law[None] * lost
        while_up = silent.with_sender_status(0, is_up)
        if not self.may_lose:
            return merge_groups(while_up)
        while_down = _sum_of_one_gaussian(jnp.zeros(()), prior, law)
        if not len(down):
            return merge_groups(concatenate_sums([while_up, while_down.with_sender_status(0, is_down)]))
        # The flag leaves one cause: silence, a link that is down (at least FLOOR, as the flag says so), or a refusal.
        while_down = while_down.with_sender_status(0, jnp.maximum(is_down, FLOOR * law))
        refused = self._condition_on_sent(prior, silent, law).with_sender_status(0, is_up)
        flagged = down[0] > 0, down[0] == REFUSED
        causes = concatenate_sums([
            while_up.scale_weights(jnp.where(flagged[0], -jnp.inf, 0.0)),
            while_down.scale_weights(jnp.where(flagged[0] & ~flagged[1], 0.0, -jnp.inf)),
            refused.scale_weights(jnp.where(flagged[1], 0.0, -jnp.inf)),
        ])  # fmt: skip
        return merge_groups(causes)

    def _condition_on_sent(self, prior: Gaussian, silent: GaussianSum, law: jax.Array) -> GaussianSum:
        """Return the Gaussian of x given that y was sent, of weight P(sent), of which nothing else is known.

        With s = P(silent), and m_s, P_s the mean and covariance of x given silence (`silent`), the law of total
        probability gives the moments m + d, P_sent of x given that y was sent, from m = s m_s + (1 - s)(m + d). A
        schedule (`Periodic`) says nothing of x.
        """
        if isinstance(self.trigger, Periodic):
            return _sum_of_one_gaussian(jnp.zeros(()), prior, law)
        s = jnp.minimum(jnp.exp(silent.log_weight[0]), 1 - FLOOR)  # so that 1 - s is not 0
        given_silence: Gaussian = jax.tree.map(lambda leaf: leaf[0], silent.gaussian)
        m, P = prior.mean, prior.covariance
        d_s, P_s = given_silence.mean - m, given_silence.covariance
        d = -s * d_s / (1 - s)
        P_sent = (P - s * (P_s + jnp.outer(d_s, d_s))) / (1 - s) - jnp.outer(d, d)
        return _sum_of_one_gaussian(jnp.log1p(-s), from_covariance_by_elimination(m + d, P_sent), law)

    def _average_link_moments(self, channel: ChannelByPattern, law: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return E G (m, p), and Cov((G, n)_ik, (G, n)_jl) [i, j, k, l] (m, m, p + 1, p + 1), for z = G y + n.

        Both are averages over the M modes, of probabilities `law`, given that all components arrive.
        """
        # P(mode, pattern of arrivals), 0 unless all components arrive.
        joint_probability = jnp.asarray(channel.chance) * jnp.all(jnp.asarray(channel.present), axis=1) * law[:, None]
        gain, covariance = (
            jnp.tensordot(joint_probability, jnp.asarray(moment), 2) / jnp.sum(joint_probability)
            for moment in (channel.mean, channel.covariance)
        )
        return gain[:, :-1], covariance

    def _find_moment_changes_given_sent(
        self, link: tuple[jax.Array, jax.Array], signal: Signal, reference: jax.Array, log_silent: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return by how much the mean (m,) and covariance (m, m) of z = G y + n change given that y was sent.

        A sender that is silent while y is near a reference sends only a y that is far from it, so a sent y has another
        law. Let y ~ N(m, S), s = P(silent), and m + d and S_s the mean and covariance of y given silence. By the law of
        total probability, (moment of y) = s (moment given silence) + (1 - s) (moment given sent).

        Args:
            link: E G (m, p), and the covariances C_ijkl = Cov(H_ik, H_jl) of H = (G, n).
            signal: mean m and covariance S of y.
            reference: what the sender compares y with.
            log_silent: log s.
        """
        (gain, gain_covariance), m, S = link, signal.mean, signal.covariance
        s = jnp.minimum(jnp.exp(log_silent), 1 - FLOOR)  # so that 1 - s is not 0
        y = _law_of_signal(signal)
        _, given_silence = self._observe_silence(y, y.root, zero_covariance(len(m)), m, reference)
        d = given_silence.mean - m
        # E[y | sent] - m = -s d / (1 - s)
        shift = -s * d / (1 - s)
        # E[(y - m)(y - m)' | sent] - S = (S - s (S_s + d d')) / (1 - s) - S
        change_about_m = (S - s * (given_silence.covariance + jnp.outer(d, d))) / (1 - s) - S
        # E[y y' | sent] - E[y y'], and with it the change of the second moment of (y, 1).
        change_of_yy = change_about_m + jnp.outer(m, shift) + jnp.outer(shift, m)
        change_of_second_moment = jnp.block([[change_of_yy, shift[:, None]], [shift, jnp.zeros(1)]])
        # Cov z = E[G] Cov(y) E[G]' + sum_kl C_ijkl E[(y, 1)(y, 1)']_kl
        change_of_covariance = change_about_m - jnp.outer(shift, shift)  # Cov(y | sent) - S
        change = gain @ change_of_covariance @ gain.T
        change += jnp.einsum("ijkl,kl->ij", gain_covariance, change_of_second_moment)
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
        noise = factor_covariance(covariance - WeightedColumns(slopes, y.variances).covariance)
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
        """Return W^-1 (m, m): silence, of probability exp(-e' W e / 2), is a measurement of y with this noise."""
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
        """Return mean and covariance of the plant's state, and what the covariance is said to be (`claim`)."""
        return Estimate(state.gaussian.mean, state.gaussian.covariance, self.claim)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step from the Gaussians before and after one update."""
        return smoother_step_by_transform(self, step, first(self.plant))


def _law_of_signal(signal: Signal) -> Gaussian:
    """Return the Gaussian of the signal y = mean + slopes xi + noise, where x = m + L xi is the state before z."""
    return from_columns(signal.mean, join_columns(WeightedColumns(signal.slopes, signal.prior.variances), signal.noise))


def _sum_of_one_gaussian(log_weight: jax.Array, belief: Gaussian, law: jax.Array) -> GaussianSum:
    """Return a `GaussianSum` of one Gaussian, so that the functions for sums can be used.

    Args:
        log_weight: log of its weight.
        belief: the Gaussian.
        law: probabilities of the link's modes given the Gaussian (M,): the status of the one sender.
    """
    single = GaussianSum(log_weight, belief, status=law[None])
    # The leading axis is that of the Gaussians in a sum.
    sum_of_one: GaussianSum = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], single)
    return sum_of_one
