"""Silence of senders that decide: steps that are silent, steps that are not final, and senders that are dead."""

from typing import NamedTuple

import numpy as np

from heliograph.model.over_time import first
from heliograph.model.trigger import AbstractTrigger
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.erasure import outcomes
from heliograph.random_affine.modes import joint_modes
from heliograph.simulation.node import Node

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


def sender_status(node: Node, last: int | None, final: int, now: int) -> SenderStatus:
    """The status where the newest value is of step `last`, the newest final step `final` and the present one `now`."""
    begun = -1 if last is None else last
    silent, provisional = max(final - begun, 0), max(now - max(final, begun), 0)
    missed = 0
    if node.trigger is not None:
        missed = missed_heartbeats(node.trigger, last, silent, final)
    chance = lost_in_a_row(first(node.channel), node.trigger.heartbeat or 1, missed) if node.trigger else 1.0
    return SenderStatus(last, silent, provisional, missed, chance)


def missed_heartbeats(trigger: AbstractTrigger, last: int | None, silent: int, final: int) -> int:
    """Transmissions that were due in the silent steps; the first value is due at once.

    Between two heartbeats the sender may have transmitted on an event that was lost too: then the next one is due
    later. So of the silent steps at least every `heartbeat` steps one transmission was.
    """
    period = getattr(trigger, "period", None)
    if period is not None:
        begun = final - silent + 1
        return sum(1 for k in range(begun, final + 1) if k % period == getattr(trigger, "phase", 0))
    first_due = int(last is None and silent > 0 and trigger.needs_reference)
    if trigger.heartbeat is None:
        return first_due
    return first_due + (silent - first_due) // trigger.heartbeat


def lost_in_a_row(channel: AbstractRandomAffine, apart: int, count: int) -> float:
    """The probability that `count` transmissions, so many steps apart, are all lost."""
    if not count:
        return 1.0
    modes = joint_modes(channel)
    loss = np.array([sum(float(o.probability) for o in outcomes(m) if not o.arrived.any()) for m in modes.maps])
    moved = np.linalg.matrix_power(np.asarray(modes.transition), apart)
    law = np.asarray(modes.initial) * loss
    for _ in range(count - 1):
        law = (law @ moved) * loss
    return float(law.sum())
