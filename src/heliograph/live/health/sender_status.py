"""Silence of senders: what of it is final, what is not, and which senders are dead, and why."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.checks.refusal_reasons import Reason
from heliograph.model.over_time import first
from heliograph.model.readings.timeouts import describe_silence
from heliograph.model.trigger import AbstractTrigger, Periodic
from heliograph.random_affine.modes import joint_modes
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

NONE = dict[Reason, int]()
DEAD = 1e-3  # probability below which heartbeats are not lost one after another by chance


class SenderStatus(NamedTuple):
    """A sender by now.

    last: the step of the newest value, or its time where time is continuous; None before the first. silent: steps since
    then that are final and at which nothing came, or the time. provisional: later ones at which nothing came yet: a
    value may still be under way, and estimates that take it for silence are made anew if one comes. missed: heartbeats
    that were due in the silent steps and did not come; chance: the probability that the link lost them all. timeout:
    for how long nothing need come, None for any time. refused: how many of its readings its node refused, by reason,
    and messages for their flag or counter. unit: of all these times, "" where that of the plant has none. A sender is
    dead where that chance is below 1 in 1,000, or where nothing came for longer than the timeout: its value is unknown,
    not constant.
    """

    last: float | None
    silent: float
    provisional: float
    missed: int
    chance: float
    timeout: float | None = None
    refused: Mapping[Reason, int] = NONE
    unit: str = "steps"

    @property
    def dead(self) -> bool:
        """Return whether it misses its heartbeats, and not by chance, or is silent for longer than its timeout."""
        return bool(self.reason)

    @property
    def reason(self) -> str:
        """Return in words why the sender is dead, or "" if it is not.

        `missed` heartbeats did not come, and `chance` is the probability that as many messages are all lost. If it is
        below DEAD, the sender is dead. It is also dead if it is silent for longer than `timeout` (None: no limit).
        """
        if self.missed > 0 and self.chance < DEAD:
            chance = f"by chance once in {1 / self.chance:,.0f}" if self.chance else "never by chance"
            return f"{self.missed} heartbeats did not come, {chance}"
        quiet = self.silent + self.provisional
        if self.timeout is not None and quiet > self.timeout:
            return describe_silence(quiet, self.timeout, self.unit)
        return ""


class LossChain(NamedTuple):
    """Losses of a link by mode: their probability (M,), the modes' transition (M, M) and first law (M,)."""

    loss: np.ndarray
    transition: np.ndarray
    initial: np.ndarray

    @staticmethod
    def of_channel(channel: Channel) -> "LossChain":
        """Return the losses of a link: for each mode of the channel the probability that nothing arrives.

        Of a channel that varies over time its first step counts.
        """
        modes = joint_modes(first(channel))
        loss_probabilities = [
            sum(float(outcome.probability) for outcome in mode.list_outcomes() if not outcome.arrived.any())
            for mode in modes.maps
        ]
        return LossChain(np.array(loss_probabilities), np.asarray(modes.transition), np.asarray(modes.initial))

    def probability_all_lost(self, apart: int, count: int) -> float:
        """Return the probability that `count` transmissions, `apart` steps from one to the next, are all lost.

        It is p diag(l) (T^apart diag(l))^(count - 1) 1 with the initial probabilities p of the channel's modes, the
        loss probability l of each mode, and the modes' transition matrix T.
        """
        if not count:
            return 1.0
        transition_between = np.linalg.matrix_power(self.transition, apart)  # T^apart
        first_is_lost = self.initial * self.loss  # p diag(l)
        all_others_are_lost = np.linalg.matrix_power(transition_between * self.loss, count - 1)
        return float((first_is_lost @ all_others_are_lost).sum())


class SilenceRule(NamedTuple):
    """Rule on how long a node may be silent.

    Args:
        trigger: when its sender transmits, if that decides; None of one that sends whatever it measures.
        losses: of its link; None where there is no trigger.
        timeout: for how long nothing need come; None for any time.
    """

    trigger: AbstractTrigger | None
    losses: LossChain | None
    timeout: float | None

    @staticmethod
    def of_node(node: Node) -> "SilenceRule | None":
        """Return the rule for the silence of a node's sender, or None if it may be silent for any time."""
        if node.trigger is None:
            return None if node.timeout is None else SilenceRule(trigger=None, losses=None, timeout=node.timeout)
        return SilenceRule(node.trigger, losses=LossChain.of_channel(node.channel), timeout=node.timeout)

    def find_status(self, last: float | None, begun: float, final: float, now: float) -> SenderStatus:
        """Return a sender's status: for how long it is silent, how many heartbeats are missing, and by what chance.

        With a trigger, by which it decides when to send, all times are whole steps.

        Args:
            last: time of its newest value; None before the first.
            begun: since when it may be silent if no value came yet.
            final: the newest time for which no late value is taken any more. Silence up to then is `silent`, and
                silence from then on `provisional`, since a late value may still fill it.
            now: the present time.
        """
        silence_begin = begun if last is None else last
        silent = max(final - silence_begin, 0)
        provisional = max(now - max(final, silence_begin), 0)
        if self.trigger is None or self.losses is None:
            return SenderStatus(last, silent, provisional, missed=0, chance=1.0, timeout=self.timeout)
        # Heartbeats: the longest time after which it sends in any case. `chance`: P(all that are missing were lost).
        last_step = None if last is None else int(last)
        missed = count_missed_heartbeats(self.trigger, last_step, int(silent), int(final))
        steps_between = 1 if self.trigger.heartbeat is None else int(self.trigger.heartbeat)
        chance = self.losses.probability_all_lost(steps_between, missed)
        return SenderStatus(last, silent, provisional, missed=missed, chance=chance, timeout=self.timeout)


def count_missed_heartbeats(trigger: AbstractTrigger, last: int | None, silent: int, final: int) -> int:
    """Return how many transmissions were at least due in the `silent` steps up to step `final`.

    The first value (`last` is None) is due at once. A heartbeat is due `heartbeat` steps after the last transmission.
    A lost transmission on an event only delays the next heartbeat, so that each `heartbeat` steps have at least one.
    """
    if isinstance(trigger, Periodic):
        # They are due in the steps phase, phase + period, ...; count those up to `final` less those before the silence.
        period, phase = int(trigger.period), int(trigger.phase)
        return (final - phase) // period - (final - silent - phase) // period
    first_due = int(last is None and silent > 0 and trigger.needs_reference)
    if trigger.heartbeat is None:
        return first_due
    return first_due + (silent - first_due) // int(trigger.heartbeat)


def find_silence_rules(network: Network) -> dict[str, SilenceRule]:
    """Return {name of a node: its rule of silence} of the nodes that may not be silent for any time."""
    rules = {name: SilenceRule.of_node(node) for name, node in network.nodes.items() if isinstance(node, Node)}
    return {name: rule for name, rule in rules.items() if rule is not None}


def count_values_before_losses(network: Network, deciding: Mapping[str, AbstractTrigger]) -> dict[int, int]:
    """Return {index of a node: how many of the numbers that it receives are measured values}.

    The nodes are those whose trigger decides when to send and whose messages are numbered. They receive [values,
    numbers of lost messages]: how many messages were lost before this one, for all values or for each.

    Args:
        network: the network.
        deciding: {name of a node whose sender decides when to send: its trigger}.
    """
    return {
        network.names.index(name): node.received - trigger.side_information(len(node.outputs))
        for name, trigger in deciding.items()
        if trigger.losses == "numbered" and isinstance(node := network.nodes[name], Node)
    }
