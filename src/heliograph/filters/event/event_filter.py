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
)
from heliograph.filters.event.joint_gaussian import (
    LinkMoments,
    augment_by_signal,
    condition_parts_on_received,
    predict_received,
    predict_with_reference,
    set_known_components,
)
from heliograph.filters.event.sender_status_probabilities import SilenceByCause, status_after_sending
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
COUNTED = 16  # lost transmissions that are counted; more are as many


class EventFilter(AbstractSizedFilter):
    """The Gaussian sum of `event_filter`.

    known: parts of the interval in which y - r lay last, one Gaussian each; lost: Gaussians whose reference is a value
    that was lost; loses: transmissions may be lost; delivers: what arrives is y itself; alike: what arrives has the
    same law in every mode; outputs: length of y; ages: numbers of steps since the last transmission that labels count.
    """

    plant: AnyPlant
    sensor: AnySensor
    channel: ChannelByPattern | OverTime
    trigger: AbstractThreshold
    initial: Float[Array, " M"]
    transform: AbstractTransform
    known: int = eqx.field(static=True)
    lost: int = eqx.field(static=True)
    loses: bool = eqx.field(static=True)
    delivers: bool = eqx.field(static=True)
    alike: bool = eqx.field(static=True)
    outputs: int = eqx.field(static=True)
    ages: int = eqx.field(static=True)

    @property
    def reference_may_be_lost(self) -> bool:
        """True if the value that the sender compares with may be one that the filter never received."""
        return self.loses and self.trigger.reference == "sent"

    def with_room_for_heartbeats_of(self, others: Sequence[AbstractFilter]) -> "EventFilter":
        """Return the filter with as many `ages`, counts of steps since a sender sent, as the largest of the others."""
        ages = max((other.ages for other in others if isinstance(other, EventFilter)), default=self.ages)
        if self.trigger.heartbeat is None or ages <= self.ages:
            return self
        filter_with_room = copy(self)
        object.__setattr__(filter_with_room, "ages", ages)  # fields are frozen
        return filter_with_room

    @property
    def senders(self) -> list[slice]:
        """Components of y that are sent together."""
        m = self.outputs
        return [slice(i, i + 1) for i in range(m)] if self.trigger.region == "each" else [slice(0, m)]

    @property
    def silence_tells(self) -> bool:
        """Always true: silence is a measurement."""
        return True

    @compile_on_call
    def init(self) -> EventBelief:
        """Return the prior of (x, r): x is the plant's state, and r, the senders' reference, is known to be 0."""
        start, m = at(self.plant, k=0), self.outputs
        x = from_covariance(start.initial_mean, start.initial_covariance)
        known_reference = WeightedColumns(np.eye(m), jnp.zeros(m))
        joint = append_rows(x, jnp.zeros(m), jnp.zeros((m, len(start.states))), known_reference)  # r = 0
        counts = COUNTED if self.trigger.losses == "numbered" else 1
        label = jnp.zeros((len(self.senders), len(self.initial), self.ages, counts))
        label = label.at[:, :, 0, 0].set(jnp.asarray(self.initial))
        prior_sum = GaussianSum(jnp.zeros(1), jax.tree.map(lambda leaf: leaf[None], joint), label[None])
        has_sent = jnp.full(len(self.senders), not self.trigger.needs_reference)
        return EventBelief.from_sum(self._pad_sum(prior_sum), has_sent, jnp.asarray(False))

    def _pad_sum(self, single: GaussianSum) -> GaussianSum:
        """Return a sum of one Gaussian, padded with copies of weight zero to the filter's number of Gaussians."""
        lost_references = self.lost if self.reference_may_be_lost else 0
        count = self._known_reference_count + lost_references
        copies: GaussianSum = jax.tree.map(lambda leaf: jnp.repeat(leaf, count, axis=0), single)
        return copies._replace(log_weight=jnp.where(jnp.arange(count) == 0, single.log_weight[0], -jnp.inf))

    @property
    def region(self) -> SilentRegion:
        """Where y - r lies as long as a sender is silent."""
        return SilentRegion(len(self.states), self.trigger, self.outputs, self.known)

    @property
    def _known_reference_count(self) -> int:
        """Number of Gaussians of known reference: one for each piece inside, and outside if values may be lost."""
        if not self.loses or self.reference_may_be_lost:
            return self.known
        return self.known + self.region.count_outside_parts(self.senders[0])

    @predicts
    def predict(self, state: EventBelief, u: ArrayLike = (), k: Step = 0) -> EventBelief:
        """Move x and the modes; r stays, or is the prediction; the age of the last value sent grows by one step."""
        plant, u, start = at(self.plant, k), jnp.asarray(u), second_moments_at_start(self.plant)
        both = jax.vmap(lambda x: predict_with_reference(plant, self.transform, x, u, start))(state.gaussian)
        if self.trigger.reference == "prediction":
            expected = self.predict_reference(self._merge_state(state).mean, u, k)
            of_reference = len(self.states) + np.arange(self.outputs)
            both = jax.vmap(lambda x: set_known_components(x, of_reference, expected))(both)
        # The modes move from the second step on: the initial law is that of the first step.
        rows = jnp.asarray(at(self.channel, k).transition)
        label = jnp.einsum("hsiac,ij->hsjac", state.label, jnp.where(state.moved, rows, jnp.eye(len(rows))))
        # Ages grow by one, but for the heartbeat's, which the last value keeps until another one is sent.
        if self.trigger.heartbeat is not None:
            older = jnp.concatenate([jnp.zeros_like(label[..., :1, :]), label[..., :-1, :]], axis=-2)
            age, oldest = jnp.arange(self.ages)[:, None], self.trigger.heartbeat
            label = jnp.where(age <= oldest, older, 0.0) + jnp.where(age == oldest, label, 0.0)
        return EventBelief(weight=state.weight, gaussian=both, label=label, begun=state.begun, moved=jnp.asarray(True))

    def predict_reference(self, mean: jax.Array, u: ArrayLike, k: Step) -> jax.Array:
        """Return the prediction of y at step k that both ends compute, from the mean after the step before and u."""
        return predict_signal(at(self.plant, k), at(self.sensor, k), mean, u)

    @corrects
    def correct(self, state: EventBelief, z: ArrayLike, k: Step = 0) -> tuple[EventBelief, Innovation]:
        """Correct with the values that came, and with the silence of the senders from which none came.

        z: the values of all senders, NaN where none came, then what is reported of each one's losses, if anything.
        """
        plant, sensor, channel, z = at(self.plant, k), at(self.sensor, k), at(self.channel, k), jnp.asarray(z)
        count = self.received - self.trigger.side_information(self.outputs)
        values, losses = z[:count], z[count:]
        mixture, begun, start = state.parts, state.begun, second_moments_at_start(self.plant)
        log_likelihood, differences, covariances = jnp.zeros(()), [], []
        # Senders one after the other, each with its value or its silence, given the senders before it.
        for s, components in enumerate(self.senders):
            received = values[components] if len(self.senders) > 1 else values
            lost = losses[s] if len(losses) else jnp.asarray(jnp.nan)
            augmented = augment_by_signal(plant, sensor, self.transform, mixture, start)
            arrived = jnp.any(~jnp.isnan(received))
            after, expected, spread = self._condition_on_sender(augmented, channel, received, lost, s, begun[s])
            log_likelihood_of_sender = log_total_weight(after.log_weight)
            log_likelihood += log_likelihood_of_sender
            mixture = after.scale_weights(-log_likelihood_of_sender)
            # From now on the sender has a reference; where it is acknowledged, once a value arrived.
            begun = begun.at[s].set(begun[s] | (arrived if self.trigger.reference == "acknowledged" else True))
            differences.append(received - expected)
            covariances.append(spread)
        innovation = Innovation(*_append_losses(jnp.concatenate(differences), covariances, losses), log_likelihood)
        return EventBelief.from_sum(mixture, begun, state.moved), innovation

    def _condition_on_sender(
        self, augmented: GaussianSum, channel: ChannelByPattern, z: jax.Array, lost: jax.Array, s: int, begun: jax.Array
    ) -> tuple[GaussianSum, jax.Array, jax.Array]:
        """Condition the sum over (x, r, y) on what came from sender s, a value z or nothing (z all NaN).

        Arguments as of `_condition_on_silence`, and z, the sender's part of what is received. Returns the sum over
        (x, r), and the mean and covariance that were predicted of a value, zero where none came.
        """

        def update_by_silence(augmented: GaussianSum) -> tuple[GaussianSum, jax.Array, jax.Array]:
            """Return the sum given silence of sender s; no value is expected, so zeros as its mean and covariance."""
            after = self._condition_on_silence(augmented, channel, lost, s, begun)
            return after, jnp.zeros_like(z), jnp.zeros((len(z), len(z)))

        def update_by_value(augmented: GaussianSum) -> tuple[GaussianSum, jax.Array, jax.Array]:
            """Return the sum given the value z of sender s, and the value's predicted mean and covariance."""
            return self._condition_on_value(augmented, channel, z, lost, s, begun)

        used: tuple[GaussianSum, jax.Array, jax.Array] = jax.lax.cond(
            jnp.any(~jnp.isnan(z)), update_by_value, update_by_silence, augmented
        )
        return used

    def _condition_on_silence(
        self, augmented: GaussianSum, channel: ChannelByPattern, lost: jax.Array, s: int, begun: jax.Array
    ) -> GaussianSum:
        """Condition the sum on silence: nothing was sent, or it was sent and lost.

        Args:
            augmented: law of (x, r, y), r what the sender compares y with.
            channel: the link, by mode.
            lost: whether the receiver was told of a loss, or how many; NaN where it was not.
            s: number of the sender.
            begun: whether the sender has something to compare with.

        Returns:
            The sum of (x, r), y taken off: first the Gaussians with a known reference, then those whose reference was
            lost.
        """
        # Why it may be silent, as labels (K, M, A, C) of each Gaussian: link mode, steps since the last transmission,
        # transmissions lost.
        unsent, due = self._split_label_by_sending(augmented.label[:, s], begun)
        loss = self._loss_probability(channel, s)[:, None, None]
        dropped, forced = (status_after_sending(sent * loss, is_lost=True) for sent in (unsent, due))
        if self.trigger.losses == "known":  # told of a loss: it was sent; told of none: it was not
            unsent = jnp.where(lost > 0, 0.0, unsent)
            dropped, forced = (jnp.where(lost > 0, label, 0.0) for label in (dropped, forced))
        truncate = (
            self._truncate_with_lost_references if self.reference_may_be_lost else self._truncate_with_known_reference
        )
        return self._restore_if_impossible(truncate(augmented, s, SilenceByCause(unsent, dropped, forced)), augmented)

    def _truncate_with_known_reference(self, augmented: GaussianSum, s: int, labels: SilenceByCause) -> GaussianSum:
        """Return the sum over (x, r) given silence of sender s, where its reference r is known.

        The sender sends y if |y - r| > delta. So every Gaussian is cut to each piece of |y - r| <= delta. If values may
        be lost, it is also cut to each piece of |y - r| > delta. Then the Gaussians of each piece are joined.
        """
        sender, state_and_reference = self.senders[s], np.arange(len(self.states) + self.outputs)
        inside = augmented.relabel_sender(s, labels.unsent + labels.forced if self.loses else labels.unsent)
        pieces, _ = self.region.truncate_inside(inside, inside.select_range(0, 0), sender)  # an empty sum beside it
        if self.loses:
            sent = augmented.relabel_sender(s, labels.dropped + labels.forced)
            outside = self.region.truncate_outside(sent, sender, scale=1.0)
            pieces = concatenate_sums([pieces, merge_groups(outside, self.region.count_outside_parts(sender))])
        return pieces.select_components(state_and_reference)

    def _truncate_with_lost_references(self, augmented: GaussianSum, s: int, labels: SilenceByCause) -> GaussianSum:
        """Return the sum over (x, r) given silence of sender s, where a value that was lost is the next reference.

        First the Gaussians of known reference, joined piece by piece, then at most `lost` whose reference was lost.
        `augmented`: the sum over (x, r, y), the first `known` of them with a known reference r.
        """
        n, sender = len(self.states), self.senders[s]
        state_and_reference = np.arange(n + self.outputs)
        # Not sent: the reference as it was.
        unsent = augmented.relabel_sender(s, labels.unsent)
        known, others = self.region.truncate_inside(
            unsent.select_range(0, self.known), unsent.select_range(self.known), sender
        )
        # Sent and lost: y is the new reference, outside of the region, or anywhere where a heartbeat was due.
        outside = merge_groups(
            self.region.truncate_outside(augmented.relabel_sender(s, labels.dropped), sender, 1.0),
            self.region.count_outside_parts(sender),
        )
        anywhere = merge_groups(augmented.relabel_sender(s, labels.forced))
        fresh = concatenate_sums([outside, anywhere]).select_components(self._find_new_reference(sender))
        # Of all with a lost reference the pairs nearest in r are joined.
        few = reduce_to_count(
            concatenate_sums([others.select_components(state_and_reference), fresh]),
            self.lost,
            slice(n + sender.start, n + sender.stop),
        )
        return concatenate_sums([known.select_components(state_and_reference), few])

    def _condition_on_value(
        self, augmented: GaussianSum, channel: ChannelByPattern, z: jax.Array, lost: jax.Array, s: int, begun: jax.Array
    ) -> tuple[GaussianSum, jax.Array, jax.Array]:
        """Condition on a value z: a Kalman update of each Gaussian, weighed by its density and by why it was sent.

        Returns the sum over (x, r), one Gaussian padded with others of no weight, and the mean and covariance predicted
        of a value that comes; arguments as of `_condition_on_silence`.
        """
        # Probability that this pattern of values arrives, by mode of the link: the first axis of a Gaussian's label.
        sender, arrived = self.senders[s], ~jnp.isnan(z)
        pattern = arrived if len(self.senders) == 1 else jnp.ones(self.outputs, dtype=bool)
        kind = pattern_of(channel, pattern) if len(channel.present) > 1 else 0
        chance = jnp.asarray(channel.chance)[:, kind]
        arrives = chance if len(self.senders) == 1 else 1 - self._loss_probability(channel, s)
        label = augmented.label[:, s] * arrives[:, None, None]
        if self.trigger.losses == "numbered":  # the sender's counter says how many were lost before
            number = jnp.clip(jnp.where(jnp.isnan(lost), 0.0, lost).astype(int), 0, COUNTED - 1)
            label = label * (jnp.isnan(lost) | (jnp.arange(COUNTED) == number))
        # For each mode the Gaussians before the value and updated by it; for all modes at once where their law is one.
        updated, before, links = [], [], []
        for j in range(1 if self.alike else label.shape[1]):
            label_of_mode = label if self.alike else jnp.zeros_like(label).at[:, j].set(label[:, j])
            mode = jnp.argmax(chance > 0) if self.alike else j
            moments = channel.mean, channel.gain_spread, channel.noise
            link = LinkMoments(*jax.tree.map(lambda part, at=(mode, kind): jnp.asarray(part)[at], moments))
            prior = augmented.relabel_sender(s, label_of_mode)
            links.append(link)
            before.append(prior)
            updated.append(condition_parts_on_received(prior, z, arrived, link, sender, self.outputs, self.delivers))
        # Restricted to where the sender had to send. The result holds several such blocks [updated, before] one after
        # the other, each in blocks of `size` by mode: they are sorted by mode again.
        count, size = len(links), len(label)
        sent = self._restrict_to_sent(concatenate_sums([*updated, *before]), s, begun)
        pieces = [sent.select_range(start, start + size) for start in range(0, len(sent.log_weight), size)]
        by_part = [concatenate_sums(pieces[j :: 2 * count]) for j in range(2 * count)]  # all blocks' piece j together
        sent_updated, sent_before = by_part[:count], by_part[count:]
        # One Gaussian again, with a new reference.
        merged = merge_groups(concatenate_sums(sent_updated).select_components(self._find_new_reference(sender)))
        merged = merged.relabel_sender(s, status_after_sending(merged.label[:, s], is_lost=False))
        signal = self._predict_sent_value(sent_before, links, sender)
        return self._pad_sum(merged), signal.mean[0], signal.covariance[0]

    def _predict_sent_value(self, sent: Sequence[GaussianSum], links: Sequence[LinkMoments], sender: slice) -> Gaussian:
        """Return the Gaussian (1, ...) of a value that arrives, from the sums over (x, r, y) given that it is sent.

        `sent` and `links` hold for each mode of the link the sum over (x, r, y), and the link's moments.
        """
        received_by_mode = []
        for sum_of_mode, link in zip(map(merge_groups, sent), links, strict=True):
            received = predict_received(sum_of_mode.gaussian, link, sender, self.outputs)
            received_by_mode.append(GaussianSum(sum_of_mode.log_weight, received, jnp.zeros((1, 1))))
        return merge_groups(concatenate_sums(received_by_mode)).gaussian

    def _restrict_to_sent(self, used: GaussianSum, s: int, has_sent: jax.Array) -> GaussianSum:
        """Restrict each Gaussian to where sender s sends: |y - r| > delta, or anywhere at a heartbeat.

        Returns one sum: the pieces of |y - r| > delta, a floor where these have no mass, and those at a heartbeat.
        """
        waiting, due = self._split_label_by_sending(used.label[:, s], has_sent)
        before_event = used.relabel_sender(s, waiting)
        outside = self.region.truncate_outside(before_event, self.senders[s], scale=1 - RIM)  # RIM: for rounding
        log_mass_outside = jnp.max(
            outside.log_weight.reshape(self.region.count_outside_parts(self.senders[s]), -1), axis=0
        )
        lowest = before_event.log_weight + np.log(FLOOR)  # FLOOR: least probability of sending, 1e-6
        floor = before_event._replace(log_weight=jnp.where(log_mass_outside < lowest, lowest, -jnp.inf))
        return concatenate_sums([outside, floor, used.relabel_sender(s, due)])

    def _split_label_by_sending(self, label: jax.Array, has_sent: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Split a sender's label (K, M, A, C) into parts: where |y - r| > delta decides, and where it must send."""
        heartbeat = self.trigger.heartbeat
        # The axis A counts steps since it sent. It must send if it never has, and at a heartbeat if there is one.
        is_heartbeat = (jnp.arange(self.ages) == (-1 if heartbeat is None else heartbeat))[:, None]
        due = jnp.where(~has_sent | is_heartbeat, label, 0.0)
        return label - due, due

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

    def _restore_if_impossible(self, mixture: GaussianSum, before: GaussianSum) -> GaussianSum:
        """Return the updated sum, or the sum `before` with the likelihood FLOOR (1e-6) if all updated weights are 0."""
        unchanged = before.select_components(np.arange(mixture.gaussian.mean.shape[1]))
        unchanged = unchanged._replace(log_weight=unchanged.log_weight + np.log(FLOOR))
        is_impossible = ~jnp.isfinite(log_total_weight(mixture.log_weight))
        restored: GaussianSum = jax.tree.map(lambda old, new: jnp.where(is_impossible, old, new), unchanged, mixture)
        return restored

    @estimates
    def estimate(self, state: EventBelief) -> Estimate:
        """Return the mean and covariance of the whole sum."""
        merged = self._merge_state(state)
        return Estimate(merged.mean, merged.covariance, self.claim)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step of one Gaussian with the moments of each sum around the update."""
        return smoother_step_by_transform(self, step.map_states(self._merge_state), first(self.plant))

    def _merge_state(self, state: EventBelief) -> Gaussian:
        """Merge the sum into one Gaussian of the plant's state, the first components of (x, r)."""
        stack_of_one = take_leading(merge_groups(state.parts).gaussian, len(self.states))
        x: Gaussian = jax.tree.map(lambda leaf: leaf[0], stack_of_one)
        return x


def _append_losses(value: jax.Array, blocks: list[jax.Array], losses: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Append reported losses to an innovation: known numbers have value and covariance 0, missing ones NaN."""
    loss_values = jnp.where(jnp.isnan(losses), jnp.nan, 0.0)
    value = jnp.concatenate([value, loss_values])
    arrived = ~jnp.isnan(value)
    covariance = jax.scipy.linalg.block_diag(
        *(jnp.nan_to_num(block) for block in blocks), jnp.zeros((len(losses),) * 2)
    )
    return value, jnp.where(arrived[:, None] & arrived, covariance, jnp.nan)
