"""Filter behind a sender that decides when to send: Gaussians of the state and of what the sender compares y with."""

from collections.abc import Sequence
from copy import copy

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import WeightedColumns
from heliograph.factors.factored_gaussian import Gaussian, append_rows, from_covariance, take_leading
from heliograph.filters.base import AbstractFilter, AbstractSizedFilter, Step, corrects, estimates, predicts
from heliograph.filters.event.event_filter_state import EventBelief
from heliograph.filters.event.gaussian_sum import (
    FLOOR,
    GaussianSum,
    concatenate_sums,
    log_total_weight,
    merge_groups,
    reduce_to_count,
    restore_if_impossible,
)
from heliograph.filters.event.joint_gaussian import (
    LinkMoments,
    augment_by_signal,
    condition_parts_on_received,
    predict_sent_value,
    predict_with_reference,
    set_known_components,
)
from heliograph.filters.event.sender_status_probabilities import (
    Message,
    SilenceByCause,
    agrees_with_number,
    append_losses,
    split_by_cause,
    split_by_obligation,
    status_after_sending,
)
from heliograph.filters.event.silent_region import SilentRegion
from heliograph.filters.gaussian.gaussian_prediction import second_moments_at_start, smoother_step_by_transform
from heliograph.filters.gaussian.moment_transforms import AbstractTransform
from heliograph.filters.modes.arrival_patterns import ChannelByPattern, pattern_of
from heliograph.filters.smoother_step import SmootherStep, StepTrace
from heliograph.model.centred_signal import predict_signal
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import OverTime, at, first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.model.trigger import AbstractThreshold
from heliograph.numerics.types import Array, ArrayLike, Float

RIM = 1e-9  # share of delta by which a value may lie inside for rounding
COUNTED = 16  # counts 0 to 15 of lost transmissions; the last one stands for all larger ones


class EventFilter(AbstractSizedFilter):
    """The Gaussian sum of `event_filter`: each Gaussian is over (x, r), the plant's state and the senders' reference.

    A sender transmits its signal y if |y - r| > delta. pieces: of that interval, one Gaussian for each in which y - r
    lay last; lost_references: Gaussians whose reference is a value that was lost; may_lose: transmissions may be lost;
    delivers_signal: what arrives is y itself; same_law_in_modes: what arrives has the same law in every mode of the
    link; outputs: length of y; age_count: the largest number of steps since a transmission that is counted, plus 1.
    """

    plant: AnyPlant
    sensor: AnySensor
    channel: ChannelByPattern | OverTime
    trigger: AbstractThreshold
    initial: Float[Array, " M"]
    transform: AbstractTransform
    pieces: int = eqx.field(static=True)
    lost_references: int = eqx.field(static=True)
    may_lose: bool = eqx.field(static=True)
    delivers_signal: bool = eqx.field(static=True)
    same_law_in_modes: bool = eqx.field(static=True)
    outputs: int = eqx.field(static=True)
    age_count: int = eqx.field(static=True)

    @property
    def reference_may_be_lost(self) -> bool:
        """True if the value that the sender compares with may be one that the filter never received."""
        return self.may_lose and self.trigger.reference == "sent"

    def with_room_for_heartbeats_of(self, others: Sequence[AbstractFilter]) -> "EventFilter":
        """Return the filter with the largest `age_count`, of steps since a sender sent, of its own and the others'."""
        age_count = max((other.age_count for other in others if isinstance(other, EventFilter)), default=self.age_count)
        if self.trigger.heartbeat is None or age_count <= self.age_count:
            return self
        filter_with_room = copy(self)
        object.__setattr__(filter_with_room, "age_count", age_count)  # fields are frozen
        return filter_with_room

    @property
    def senders(self) -> list[slice]:
        """For each sender the slice of y that it sends: a component each if the rule is for each, else all of y."""
        m = self.outputs
        return [slice(i, i + 1) for i in range(m)] if self.trigger.region == "each" else [slice(0, m)]

    @property
    def silence_tells(self) -> bool:
        """Always True: a sender is silent only if |y - r| <= delta, so that silence is a measurement."""
        return True

    @compile_on_call
    def init(self) -> EventBelief:
        """Return the prior of (x, r): x is the plant's state, and r, the senders' reference, is known to be 0."""
        start, m = at(self.plant, k=0), self.outputs
        x = from_covariance(start.initial_mean, start.initial_covariance)
        known_reference = WeightedColumns(np.eye(m), jnp.zeros(m))
        joint = append_rows(x, jnp.zeros(m), jnp.zeros((m, len(start.states))), known_reference)  # r = 0
        # Probabilities of each sender's status: link mode, steps since it sent, transmissions lost (S, M, A, C).
        counts = COUNTED if self.trigger.losses == "numbered" else 1
        status = jnp.zeros((len(self.senders), len(self.initial), self.age_count, counts))
        status = status.at[:, :, 0, 0].set(jnp.asarray(self.initial))
        prior_sum = GaussianSum(jnp.zeros(1), jax.tree.map(lambda leaf: leaf[None], joint), status[None])
        # Before its first transmission a sender that needs a reference must send.
        has_sent = jnp.full(len(self.senders), not self.trigger.needs_reference)
        return EventBelief.from_sum(self._pad_sum(prior_sum), has_sent, jnp.asarray(False))

    def _pad_sum(self, single: GaussianSum) -> GaussianSum:
        """Return the one Gaussian of `single`, then copies of weight 0, so that all steps have as many Gaussians."""
        count = self._known_reference_count + self.reference_may_be_lost * self.lost_references
        copies: GaussianSum = jax.tree.map(lambda leaf: jnp.repeat(leaf, count, axis=0), single)
        return copies._replace(log_weight=jnp.where(jnp.arange(count) == 0, single.log_weight[0], -jnp.inf))

    @property
    def region(self) -> SilentRegion:
        """The region |y - r| <= delta, of signal y and reference r, in which a sender is silent, in its pieces."""
        return SilentRegion(len(self.states), self.trigger, self.outputs, self.pieces)

    @property
    def _known_reference_count(self) -> int:
        """Number of Gaussians whose reference r the filter knows.

        Silence leaves one Gaussian for each of the pieces of |y - r| <= delta. If a value may be lost and does
        not become the reference, silence leaves another one for each piece of |y - r| > delta.
        """
        outside = self.region.count_outside_parts(self.senders[0])
        return self.pieces + (outside if self.may_lose and not self.reference_may_be_lost else 0)

    @predicts
    def predict(self, state: EventBelief, u: ArrayLike = (), k: Step = 0) -> EventBelief:
        """Predict each Gaussian of (x, r), and the probabilities of each sender's status, one step ahead.

        x is the plant's state. The senders' reference r stays, or is set to the prediction of y.
        """
        plant, u, start = at(self.plant, k), jnp.asarray(u), second_moments_at_start(self.plant)
        x_and_r = jax.vmap(lambda x: predict_with_reference(plant, self.transform, x, u, start))(state.gaussian)
        if self.trigger.reference == "prediction":
            expected = self.predict_reference(self._merge_state(state).mean, u, k)
            indices_of_r = len(self.states) + np.arange(self.outputs)
            x_and_r = jax.vmap(lambda x: set_known_components(x, indices_of_r, expected))(x_and_r)
        # Status of sender s in Gaussian h: link mode i (or j), age a (steps since it sent), c transmissions lost.
        # P(mode = j) = sum_i P(mode = i) Pi_ij, but at the first step the modes have their initial law.
        transition = jnp.asarray(at(self.channel, k).transition)
        transition = jnp.where(state.moved, transition, jnp.eye(len(transition)))
        status = jnp.einsum("hsiac,ij->hsjac", state.label, transition)
        # Ages grow by one. An age that has reached the heartbeat stays there until the sender sends again.
        if self.trigger.heartbeat is not None:
            older = jnp.concatenate([jnp.zeros_like(status[..., :1, :]), status[..., :-1, :]], axis=-2)
            age, oldest = jnp.arange(self.age_count)[:, None], self.trigger.heartbeat
            status = jnp.where(age <= oldest, older, 0.0) + jnp.where(age == oldest, status, 0.0)
        return EventBelief(state.weight, gaussian=x_and_r, label=status, begun=state.begun, moved=jnp.asarray(True))

    def predict_reference(self, mean: jax.Array, u: ArrayLike, k: Step) -> jax.Array:
        """Return the prediction of y at step k that both ends compute, from the mean after the step before and u."""
        return predict_signal(at(self.plant, k), at(self.sensor, k), mean, u)

    @corrects
    def correct(self, state: EventBelief, z: ArrayLike, k: Step = 0) -> tuple[EventBelief, Innovation]:
        """Correct with the values that came, and with the silence of the senders from which none came.

        A sender transmits only if its value y differs enough from its reference r, so that silence tells something too.
        z: the values of all senders, NaN where none came; then the losses that each one reports, if it reports any.
        """
        plant, sensor, channel, z = at(self.plant, k), at(self.sensor, k), at(self.channel, k), jnp.asarray(z)
        count = self.received - self.trigger.side_information(self.outputs)
        values, losses = z[:count], z[count:]
        mixture, has_sent, start = state.gaussian_sum, state.begun, second_moments_at_start(self.plant)
        log_likelihood, innovations, covariances = jnp.zeros(()), [], []
        # Senders one after the other, each given those before it; each sends the entries `components` of y.
        for s, components in enumerate(self.senders):
            received = values[components] if len(self.senders) > 1 else values
            losses_of_sender = losses[s] if len(losses) else jnp.asarray(jnp.nan)
            message = Message.read(s, received, losses_of_sender, has_sent[s], self.trigger.losses)
            xry = augment_by_signal(plant, sensor, self.transform, mixture, start)  # joint Gaussians of (x, r, y)
            posterior, mean_of_value, covariance_of_value = self._condition_on_message(xry, message, channel)
            # Normalise the weights; their sum was p(value or silence of sender s | data before).
            log_likelihood_of_sender = log_total_weight(posterior.log_weight)
            log_likelihood += log_likelihood_of_sender
            mixture = posterior.scale_weights(-log_likelihood_of_sender)
            # By now the sender has a reference, or once a value came if it waits for an acknowledgement.
            came = jnp.any(~jnp.isnan(received)) | message.is_refused
            has_sent = has_sent.at[s].set(has_sent[s] | (came if self.trigger.reference == "acknowledged" else True))
            innovations.append(received - mean_of_value)
            covariances.append(covariance_of_value)
        innovation = Innovation(*append_losses(jnp.concatenate(innovations), covariances, losses), log_likelihood)
        return EventBelief.from_sum(mixture, has_sent, state.moved), innovation

    def _condition_on_message(
        self, xry: GaussianSum, message: Message, channel: ChannelByPattern
    ) -> tuple[GaussianSum, jax.Array, jax.Array]:
        """Condition a sum of Gaussians of (x, r, y) on what came from a sender: a value, or nothing.

        x is the plant's state, r the senders' reference and y their signal. `channel`: the link, by mode.
        Returns the sum over (x, r), and the predicted mean and covariance of a value, 0 where none came.
        """
        z = message.value

        def condition_on_silence(xry: GaussianSum) -> tuple[GaussianSum, jax.Array, jax.Array]:
            """Return the sum given silence; no value is expected, so zeros as its mean and covariance."""
            posterior = self._condition_on_silence(xry, message, channel)
            return posterior, jnp.zeros_like(z), jnp.zeros((len(z), len(z)))

        corrected: tuple[GaussianSum, jax.Array, jax.Array] = jax.lax.cond(
            jnp.any(~jnp.isnan(z)),
            lambda xry: self._condition_on_value(xry, message, channel),
            condition_on_silence,
            xry,
        )
        return corrected

    def _condition_on_silence(self, xry: GaussianSum, message: Message, channel: ChannelByPattern) -> GaussianSum:
        """Return the sum over (x, r) given silence of a sender: it sent nothing, or what it sent was lost.

        `xry`: K Gaussians of the state x, and the senders' references r and signals y; one sends if |y - r| > delta.
        """
        # Probabilities (K, M, A, C) of Gaussian, link mode, steps since sent and number of losses, for each cause.
        s = message.sender
        unsent, must_send = split_by_obligation(xry.status[:, s], message.has_sent, self.trigger.heartbeat)
        loss_probability = self._loss_probability(channel, s)[:, None, None]
        by_cause = split_by_cause(unsent, must_send, loss_probability, message, self.trigger.losses)
        if self.reference_may_be_lost:
            return restore_if_impossible(self._truncate_with_lost_references(xry, s, by_cause), xry)
        return restore_if_impossible(self._truncate_with_known_reference(xry, message, by_cause), xry)

    def _truncate_with_known_reference(
        self, xry: GaussianSum, message: Message, by_cause: SilenceByCause
    ) -> GaussianSum:
        """Return the sum over (x, r) given silence of a sender, where a value that is lost leaves its reference r.

        The sender sends y if |y - r| > delta. So each Gaussian of (x, r, y) is cut to the pieces of |y - r| <= delta
        and, if values may be lost, to those of |y - r| > delta. Gaussians in one piece are merged. `by_cause`:
        probabilities of each Gaussian's sender status with each cause of silence.
        """
        s = message.sender
        sender, x_and_r = self.senders[s], np.arange(len(self.states) + self.outputs)
        # |y - r| <= delta: it was not sent, or it had to be sent nevertheless and was lost.
        inside = xry.with_sender_status(s, by_cause.unsent + by_cause.forced if self.may_lose else by_cause.unsent)
        no_lost_references = inside.select_range(0, 0)
        pieces, _ = self.region.truncate_inside(inside, no_lost_references, sender)
        if self.may_lose:
            # |y - r| > delta: it was sent and lost.
            sent = xry.with_sender_status(s, by_cause.dropped + by_cause.forced)
            outside = self.region.truncate_outside(sent, sender, scale=1.0)
            pieces = concatenate_sums([pieces, merge_groups(outside, self.region.count_outside_parts(sender))])
        kept = pieces.select_components(x_and_r)
        # A value y that came was acknowledged, although the receiver refuses it: it is the new r.
        renewed = pieces.select_components(self._find_new_reference(sender))
        chosen: GaussianSum = jax.tree.map(lambda new, old: jnp.where(message.is_refused, new, old), renewed, kept)
        return chosen if self.trigger.losses != "unknown" else kept

    def _truncate_with_lost_references(self, xry: GaussianSum, s: int, by_cause: SilenceByCause) -> GaussianSum:
        """Return the sum over (x, r) given silence of sender s, if a value y that was lost is its next reference r.

        A sender sends its signal y if |y - r| > delta; r, the value sent last, may be lost. `xry`: Gaussians of (x, r,
        y), x the plant's state, r known in the first `pieces`. `by_cause`: probabilities of sender status and cause of
        silence. Returned are those with a known r, one for each piece of |y - r| <= delta, then `lost_references`.
        """
        n, sender = len(self.states), self.senders[s]
        x_and_r = np.arange(n + self.outputs)
        # Not sent: |y - r| <= delta, and r stays.
        unsent = xry.with_sender_status(s, by_cause.unsent)
        known, lost_before = self.region.truncate_inside(
            unsent.select_range(0, self.pieces), unsent.select_range(self.pieces), sender
        )
        # Sent by the rule and lost: |y - r| > delta. Forced and lost: y anywhere. In both cases y is the new r.
        outside = merge_groups(
            self.region.truncate_outside(xry.with_sender_status(s, by_cause.dropped), sender, 1.0),
            self.region.count_outside_parts(sender),
        )
        anywhere = merge_groups(xry.with_sender_status(s, by_cause.forced))
        lost_now = concatenate_sums([outside, anywhere]).select_components(self._find_new_reference(sender))
        # Of all Gaussians with a lost reference, those nearest in r are merged until few remain.
        few_lost = reduce_to_count(
            concatenate_sums([lost_before.select_components(x_and_r), lost_now]),
            self.lost_references,
            slice(n + sender.start, n + sender.stop),
        )
        return concatenate_sums([known.select_components(x_and_r), few_lost])

    def _condition_on_value(
        self, xry: GaussianSum, message: Message, channel: ChannelByPattern
    ) -> tuple[GaussianSum, jax.Array, jax.Array]:
        """Return the sum over (x, r) given a value z of a sender, and the predicted mean and covariance of z.

        Each Gaussian of `xry`, over (x, r, y), gets a Kalman update and is cut to |y - r| > delta; all are merged.
        """
        s, z, losses = message.sender, message.value, message.losses
        sender, arrived = self.senders[s], ~jnp.isnan(z)
        # Status probabilities (K, M, A, C), by link mode, steps since sent and losses, times P(z's pattern | mode).
        pattern_number, chance = self._find_arrival_pattern(channel, arrived)
        arrival_probability = chance if len(self.senders) == 1 else 1 - self._loss_probability(channel, s)
        status = xry.status[:, s] * arrival_probability[:, None, None]
        if self.trigger.losses == "numbered":  # the sender's counter says how many were lost before
            status = status * agrees_with_number(losses, COUNTED)
        # The Gaussians before z and updated by z, for each mode, or once if all modes have the same law.
        updated, prior, links = [], [], []
        for j in range(1 if self.same_law_in_modes else status.shape[1]):
            status_of_mode = status if self.same_law_in_modes else jnp.zeros_like(status).at[:, j].set(status[:, j])
            mode = jnp.argmax(chance > 0) if self.same_law_in_modes else j
            moments = channel.mean, channel.gain_covariance, channel.noise  # each array by (mode, pattern)
            links.append(
                LinkMoments(*jax.tree.map(lambda part, at=(mode, pattern_number): jnp.asarray(part)[at], moments))
            )
            prior.append(xry.with_sender_status(s, status_of_mode))
            updated.append(
                condition_parts_on_received(prior[j], z, arrived, links[j], sender, self.outputs, self.delivers_signal)
            )
        sent_updated, sent_prior = self._restrict_each_to_sent(updated, prior, message)
        # All merged to one Gaussian of (x, y), since y is the next reference.
        merged = merge_groups(concatenate_sums(sent_updated).select_components(self._find_new_reference(sender)))
        merged = merged.with_sender_status(s, status_after_sending(merged.status[:, s], is_lost=False))
        predicted_z = predict_sent_value(sent_prior, links, sender, self.outputs)
        return self._pad_sum(merged), predicted_z.mean[0], predicted_z.covariance[0]

    def _find_arrival_pattern(self, channel: ChannelByPattern, arrived: jax.Array) -> tuple[jax.Array | int, jax.Array]:
        """Return the number of the pattern of arrivals `arrived`, and its probability in each mode (M,)."""
        pattern = arrived if len(self.senders) == 1 else jnp.ones(self.outputs, dtype=bool)
        number = pattern_of(channel, pattern) if len(channel.present) > 1 else 0
        return number, jnp.asarray(channel.chance)[:, number]

    def _restrict_each_to_sent(
        self, updated: list[GaussianSum], prior: list[GaussianSum], message: Message
    ) -> tuple[list[GaussianSum], list[GaussianSum]]:
        """Return the sums after (`updated`) and before a value, one for each mode, each cut to where the sender sends.

        All are cut at once, which gives several groups of all Gaussians. Their parts are joined again for each sum.
        """
        count, size = len(prior), len(prior[0].log_weight)
        sent = self._restrict_to_sent(concatenate_sums([*updated, *prior]), message)
        blocks = [sent.select_range(start, start + size) for start in range(0, len(sent.log_weight), size)]
        by_sum = [concatenate_sums(blocks[j :: 2 * count]) for j in range(2 * count)]
        return by_sum[:count], by_sum[count:]

    def _restrict_to_sent(self, xry: GaussianSum, message: Message) -> GaussianSum:
        """Restrict each Gaussian of (x, r, y) to where the sender sends: |y - r| > delta, or anywhere if it must send.

        Returns three groups in one sum: each Gaussian cut to the pieces of |y - r| > delta; each uncut, as a fallback,
        with P(sent) = FLOOR if |y - r| > delta is less probable, else 0; each uncut where the sender must send.
        """
        s = message.sender
        by_rule, must_send = split_by_obligation(xry.status[:, s], message.has_sent, self.trigger.heartbeat)
        sent_by_rule, sender = xry.with_sender_status(s, by_rule), self.senders[s]
        # 1 - RIM: y was compared before it was rounded, and may lie inside by as much.
        outside = self.region.truncate_outside(sent_by_rule, sender, scale=1 - RIM)
        log_mass_outside = jnp.max(outside.log_weight.reshape(self.region.count_outside_parts(sender), -1), axis=0)
        least = sent_by_rule.log_weight + np.log(FLOOR)
        fallback = sent_by_rule._replace(log_weight=jnp.where(log_mass_outside < least, least, -jnp.inf))
        return concatenate_sums([outside, fallback, xry.with_sender_status(s, must_send)])

    def _loss_probability(self, channel: ChannelByPattern, s: int) -> jax.Array:
        """Return the probability that what a sender transmits is lost, for each mode of the link (M,)."""
        components = self.senders[s] if len(self.senders) > 1 else slice(None)
        is_lost = ~jnp.any(jnp.asarray(channel.present)[:, components], axis=1)  # by pattern of arrivals
        return jnp.asarray(channel.chance) @ is_lost.astype(float)

    def _find_new_reference(self, sender: slice) -> np.ndarray:
        """Return the indices in (x, r, y) of the next (x, r): y in place of r for the components of the sender."""
        n, m = len(self.states), self.outputs
        indices: np.ndarray = np.arange(n + m)
        if self.trigger.needs_reference:
            # Of (x, r, y): r begins at n, y at n + m.
            indices[n + sender.start : n + sender.stop] = np.arange(n + m + sender.start, n + m + sender.stop)
        return indices

    @estimates
    def estimate(self, state: EventBelief) -> Estimate:
        """Return mean and covariance of the plant's state under the whole sum of Gaussians."""
        merged = self._merge_state(state)
        return Estimate(merged.mean, merged.covariance, self.claim)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step of one Gaussian, to which each sum around the update is merged by its moments."""
        return smoother_step_by_transform(self, step.map_states(self._merge_state), first(self.plant))

    def _merge_state(self, state: EventBelief) -> Gaussian:
        """Merge the sum into one Gaussian of the plant's state, the first components of (x, r)."""
        stack_of_one = take_leading(merge_groups(state.gaussian_sum).gaussian, len(self.states))
        x: Gaussian = jax.tree.map(lambda leaf: leaf[0], stack_of_one)
        return x
