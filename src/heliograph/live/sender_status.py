"""Status of senders that decide when to send: which steps are silent, which not final, and which senders are dead."""

from typing import NamedTuple

import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.over_time import first
from heliograph.model.trigger import AbstractTrigger, Periodic
from heliograph.random_affine.modes import joint_modes

DEAD = 1e-3  # probability below which heartbeats are not lost one after another by chance


class SenderStatus(NamedTuple):
    """A sender by now.

    last: the step of the newest value, None before the first. silent: steps since then that are final and at which
    nothing came. provisional: later steps at which nothing came yet: a value may still be under way, and estimates
    that take it for silence are made anew if one comes. missed: heartbeats that were due in the silent steps and did
    not come; chance: the probability that the link lost them all. A sender is dead where that is below 1 in 1,000: its
    value is unknown, not constant.
    """

    last: int | None
    silent: int
    provisional: int
    missed: int
    chance: float

    @property
    def dead(self) -> bool:
        """True if it misses its heartbeats, and not by chance."""
        return self.missed > 0 and self.chance < DEAD


class LossChain(NamedTuple):
    """Losses of a link by mode: their probability (M,), the modes' transition (M, M) and first law (M,)."""

    loss: np.ndarray
    transition: np.ndarray
    initial: np.ndarray

    @staticmethod
    def of_channel(channel: Channel) -> "LossChain":
        """Return the losses of a link: in each mode the probability of the outcomes of which nothing arrives."""
        modes = joint_modes(first(channel))
        loss = [sum(float(o.probability) for o in m.list_outcomes() if not o.arrived.any()) for m in modes.maps]
        return LossChain(np.array(loss), np.asarray(modes.transition), np.asarray(modes.initial))

    def probability_all_lost(self, apart: int, count: int) -> float:
        """Return the probability that `count` transmissions, `apart` steps from one to the next, are all lost.

        p diag(l) (T^apart diag(l))^(count - 1) 1, with initial law p, loss probabilities l and transition T.
        """
        if not count:
            return 1.0
        moved = np.linalg.matrix_power(self.transition, apart)
        return float((self.initial * self.loss @ np.linalg.matrix_power(moved * self.loss, count - 1)).sum())


def make_sender_status(
    trigger: AbstractTrigger, losses: LossChain, last: int | None, final: int, now: int
) -> SenderStatus:
    """Return a sender's status at the step `now`.

    Args:
        trigger: its rule.
        losses: losses of its link.
        last: step of its newest value, None before the first.
        final: the newest final step.
        now: the present step.
    """
    heard = -1 if last is None else last
    silent, provisional = max(final - heard, 0), max(now - max(final, heard), 0)
    missed = count_missed_heartbeats(trigger, last, silent, final)
    interval = 1 if trigger.heartbeat is None else int(trigger.heartbeat)
    chance = losses.probability_all_lost(interval, missed)
    return SenderStatus(last=last, silent=silent, provisional=provisional, missed=missed, chance=chance)


def count_missed_heartbeats(trigger: AbstractTrigger, last: int | None, silent: int, final: int) -> int:
    """Return how many transmissions, at least, were due in the `silent` final steps up to step `final`.

    The first value (`last` is None) is due at once. A heartbeat is due `heartbeat` steps after the last transmission;
    one on an event that was lost too only delays the next, so that at least one falls into each `heartbeat` steps.
    """
    if isinstance(trigger, Periodic):
        period, phase = int(trigger.period), int(trigger.phase)
        return (final - phase) // period - (final - silent - phase) // period
    first_due = int(last is None and silent > 0 and trigger.needs_reference)
    if trigger.heartbeat is None:
        return first_due
    return first_due + (silent - first_due) // int(trigger.heartbeat)
