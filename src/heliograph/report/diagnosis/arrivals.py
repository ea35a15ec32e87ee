"""Arrivals of one received number over a recording: when it was due, how often it came, how often it was lost.

A message is due in a row if its sender would send one then. A slot is a time at which one may come: a row, or of a
sender with a period of its own one in each period.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtri

from heliograph.model.over_time import OverTime, first
from heliograph.model.trigger import Periodic
from heliograph.numerics.check import InputError
from heliograph.numerics.confidence_intervals import count_independent
from heliograph.numerics.types import Bool, Float, Int
from heliograph.report.diagnosis.sending_pattern import SendingPattern, find_pattern
from heliograph.report.diagnosis.sending_rate import SendingRate, find_rate
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

FEW = 8  # arrivals from which a rate of its own can be told
NEAR = 0.25  # of a period: how far an interval may be from whole periods
REGULAR = 0.95  # least share of intervals that are whole periods
LEAST_SHARE = 0.01  # difference from the stated share below which none is worth a warning
SLOWER = 1.5  # rows between messages from which a sender is slower than the table


@dataclass(frozen=True)
class Arrivals:
    """When one component of a node's measurement arrived, and the values that did.

    Args:
        node: name of the node.
        component: name of the component.
        time: times of the rows (time,), numbers or dates, each once.
        arrived: whether it arrived at each of them (time,).
        values: those that arrived.
        may_be_lost: whether the network's model says that it may be lost, or is not always sent.
        declared_period: rows between messages, if the model has a `Periodic` sender; None for others.
        stated_share: probability of arrival by the model; None where it is not one number, as in bursts.
        of_messages: whether each row exists because one node's message came, so that others are not due in it.
        refuses: whether the node refuses values, beyond limits or stuck, which then are missing here.
        watched: whether it refuses values that are stuck.
    """

    node: str
    component: str
    time: np.ndarray
    arrived: np.ndarray
    values: np.ndarray
    may_be_lost: bool
    declared_period: int | None = None
    stated_share: float | None = None
    of_messages: bool = False
    refuses: bool = False
    watched: bool = False

    @cached_property
    def rate(self) -> SendingRate | None:
        """Return the rate of a sender whose clock is not that of the rows, or None if no such rate is needed.

        It is not if the sender's period is declared, or if rows exist because of messages (`of_messages`). A periodic
        pattern of rows, such as 3 of each 4, may also explain the arrivals: of the two, the one with fewer messages due
        is taken, since fewer were then lost. `find_rate` returns None if losses at random explain the empty rows;
        `pattern.rows` marks the rows in which the pattern has a message due.
        """
        if self.declared_period is not None or self.of_messages:
            return None
        rate = find_rate(self.arrived)
        pattern = None if rate is None else find_pattern(self.arrived)
        if rate is None or pattern is None:
            return rate
        # By the rate, N / period messages are due in N rows. The pattern's number D of due rows is worse if it is more
        # than one above this: D > N / period + 1, or period * D > N + period.
        is_pattern_worse = rate.period * pattern.rows.sum() > len(self.arrived) + rate.period
        return rate if is_pattern_worse else None

    @cached_property
    def period(self) -> float | None:
        """Time between messages of a sender that is slower than the rows, in seconds or the unit of `time`; else None.

        It is declared, or that of the sender's own clock (`rate`), or the median interval between arrivals, if a share
        REGULAR of all intervals are whole multiples of it to NEAR periods. (Losses of a sender that is due in each row
        leave intervals of all lengths.) A median of less than SLOWER rows is no period, unless rows exist because of
        messages (`of_messages`). `clock` has the times as numbers; `declared_period` and `rate.period` count rows,
        which are `spacing` apart. Fewer than FEW (8) arrivals tell no period.
        """
        clock = _convert_times_to_numbers(self.time)
        spacing = float(np.median(np.diff(clock))) if len(clock) > 1 else 0.0
        if self.declared_period is not None:
            return self.declared_period * spacing if self.declared_period > 1 else None
        if self.rate is not None:
            return self.rate.period * spacing
        intervals = np.diff(clock[self.arrived])
        if len(intervals) < FEW - 1 or self.arrived.all():
            return None
        period = float(np.median(intervals))
        if not self.of_messages and period < SLOWER * spacing:
            return None
        # Distance of each interval from a whole number of periods, at least one, in periods.
        distance = np.abs(intervals / period - np.maximum(np.round(intervals / period), 1))
        return period if np.mean(distance <= NEAR) >= REGULAR else None

    @cached_property
    def slots(self) -> Bool[np.ndarray, " slots"] | None:
        """Whether a message came in each slot: each row, or of a slow sender each period from its first arrival on.

        None if rows are there because of other nodes' messages and this sender has no period: its slots are unknown.
        `self.rate.slots` numbers the arrivals among the slots, if the sender has a rate of its own.
        """
        if self.period is None:
            return None if self.of_messages and not self.arrived.all() else self.arrived
        clock = _convert_times_to_numbers(self.time)
        arrivals = clock[self.arrived]
        if not len(arrivals):
            return np.zeros(max(int((clock[-1] - clock[0]) / self.period), 1), dtype=bool)
        # Whole periods from each arrival to the next; then those from the last arrival to the end of the recording. A
        # message may be late by NEAR periods, and is missing only after that.
        if self.rate is not None:
            steps = np.diff(self.rate.slots)
        else:
            steps = np.maximum(np.round(np.diff(arrivals) / self.period), 1).astype(np.int64)
        missing_at_end = max(int((clock[-1] - arrivals[-1]) / self.period - NEAR), 0)
        slots = np.zeros(1 + int(steps.sum()) + missing_at_end, dtype=bool)
        slots[np.concatenate([[0], np.cumsum(steps)])] = True
        return slots

    @cached_property
    def pattern(self) -> SendingPattern | None:
        """Periodic pattern of slots (rows, or periods of a slow sender) with a message due, such as 3 of each 4.

        None if a message is due in each slot, if nothing is known of slots, or if the sender's period is declared.
        """
        return None if self.slots is None or self.declared_period is not None else find_pattern(self.slots)

    @property
    def due_slots(self) -> Bool[np.ndarray, " due"] | None:
        """Whether a message came in each slot in which one was due; None if it is not known when messages were due."""
        return self.slots if self.slots is None or self.pattern is None else self.slots[self.pattern.rows]

    @property
    def due_in(self) -> str:
        """Return in words when a message is due: "each row", "3 of 4 rows", "each 0.1", "3 of 4, each 0.1".

        `self.slots` are the rows, or the periods of a slow sender, in which a message may be due; None if unknown.
        `self.pattern` says in which of them one is due, None for all.
        """
        if self.slots is None:
            return "not known"
        pattern = None if self.pattern is None else f"{self.pattern.due} of {self.pattern.length}"
        if self.period is None:
            return "each row" if pattern is None else f"{pattern} rows"
        return f"each {self.period:.4g}" if pattern is None else f"{pattern}, each {self.period:.4g}"

    @property
    def lost_times(self) -> np.ndarray:
        """Times at which a message was due and did not come: times of rows, or between them for a slower sender.

        `slots`: whether a message came in each row, or, of a sender slower than the rows, in each `period`.
        `self.arrived` (rows,) and `self.time` are those of the rows; `self.pattern` marks the slots in which a message
        is due, None for all.
        """
        if self.slots is None:  # nobody knows when a message is due
            return self.time[:0]
        if not self.arrived.any():
            return self.time
        # Slots in which a message was due and none came.
        due = np.ones(len(self.slots), dtype=bool) if self.pattern is None else self.pattern.rows
        lost = np.flatnonzero(~self.slots & due)
        if self.period is None:
            return self.time[lost]
        # Of a sender slower than the rows: times of the filled slots, those of the arrivals.
        clock = _convert_times_to_numbers(self.time)
        filled = np.flatnonzero(self.slots)
        times = clock[self.arrived]
        if len(filled) != len(times):  # several came in one slot: slots evenly from the first arrival to the last
            times = np.interp(filled, [filled[0], max(filled[-1], filled[0] + 1)], [times[0], times[-1]])
        # Lost slots between arrivals are interpolated; those after the last filled slot follow it by a period each.
        lost_clock = np.interp(lost, filled, times) + np.maximum(lost - filled[-1], 0) * self.period
        if self.time.dtype.kind == "M":
            return np.asarray(self.time[0] + lost_clock * np.timedelta64(10**9, "ns"))
        return np.asarray(lost_clock)

    @property
    def due(self) -> int | None:
        """Number of messages that were due; None if it is not known when messages were due."""
        return None if self.due_slots is None else len(self.due_slots)

    @property
    def numbers(self) -> Int[np.ndarray, " arrivals"]:
        """Number of each message that arrived among the messages that were due, from 0 at the first arrival.

        If it is not known when messages were due, each row counts as one.
        """
        numbers = np.flatnonzero(self.arrived if self.due_slots is None else self.due_slots)
        return numbers - numbers[:1]

    @property
    def share(self) -> float:
        """Share of the messages that were due which arrived; NaN if it is not known how many were due."""
        return np.nan if self.due is None else min(float(self.arrived.sum()) / self.due, 1.0)

    def contradicts(self, level: float) -> bool:
        """Return whether the share that arrived contradicts the stated share p, by a test at `level`.

        The shares must also differ by more than a hundredth (LEAST_SHARE). Arrivals in bursts count as fewer
        independent ones: N (1 - a) / (1 + a), with the correlation a of each arrival with the next. `self.due_slots`
        says for each slot in which a message was due whether one came; `self.share` is their share.
        """
        p = self.stated_share  # probability of arrival by the model
        if p is None or self.due_slots is None or not 0 < p < 1:
            return False
        arrived = self.due_slots.astype(float)
        independent = len(arrived) if self.period is not None else count_independent(arrived)
        deviation = np.sqrt(p * (1 - p) / independent)
        return bool(abs(self.share - p) > max(-ndtri(level / 2) * deviation, LEAST_SHARE))

    @property
    def longest_gap(self) -> int | None:
        """Return the largest number of due messages in a row that did not arrive, or None if that is unknown."""
        if self.due_slots is None:
            return None
        # Distances between arrivals, as if one had come before the first slot and one after the last.
        arrivals = np.flatnonzero(np.concatenate([[True], self.due_slots, [True]]))
        return int(np.max(np.diff(arrivals)) - 1)


def rows_are_messages(arrived: Mapping[str, Bool[np.ndarray, " time"]]) -> bool:
    """Return whether each row is there because of a message: something arrived at each time, mostly from one node.

    Args:
        arrived: for each node whether anything of it arrived at each time.
    """
    nodes_at_time = np.sum(list(arrived.values()), axis=0)
    return len(arrived) > 1 and bool(np.all(nodes_at_time > 0) and np.median(nodes_at_time) <= 1)


def _convert_times_to_numbers(time: np.ndarray) -> Float[np.ndarray, " time"]:
    """Return the times as numbers (time,): dates as seconds after the first, others in their own unit."""
    if time.dtype.kind == "M":
        return np.asarray((time - time[0]) / np.timedelta64(1, "s"), dtype=float)
    return np.asarray(time, dtype=float)


def list_arrivals(network: Network, times: np.ndarray, received: Mapping[str, np.ndarray]) -> list[Arrivals]:
    """Return when each component of each node arrived, at distinct times: rows of one time count as one.

    The diagnosis compares arrivals with what the network declares: losses, periods of sending. Rows of one time count
    as one, since each node's message may have a row of its own.

    `declared`: what the network says of the node's messages: their period in rows, whether they may be lost, and the
    probability with which each number arrives.

    Args:
        network: the network.
        times: times of the rows (time,).
        received: {node: what it received (time, received)}, NaN where nothing arrived.
    """
    time, time_of_row = np.unique(times, return_inverse=True)

    def by_time(in_row: np.ndarray) -> np.ndarray:
        """Return for each distinct time of `time` whether `in_row` is true in any row of it (`time_of_row`)."""
        at_time = np.zeros(len(time), dtype=bool)
        at_time[time_of_row[in_row]] = True
        return at_time

    # If each row exists because one node's message came, nothing is missing of the others in it.
    anything_of_node = {node: by_time(np.any(~np.isnan(z), axis=1)) for node, z in received.items()}
    of_messages = rows_are_messages(anything_of_node)
    links = []
    for node, z in received.items():
        receiver = network.nodes[node]
        limits = receiver.limits
        refuses_values = limits is not None
        refuses_stuck_values = limits is not None and limits.stuck is not None
        declared = _read_declared_sending(receiver)
        for i, name in enumerate(receiver.received_names):
            arrived_in_row = ~np.isnan(z[:, i])
            links.append(
                Arrivals(
                    node=node,
                    component=name,
                    time=time,
                    arrived=by_time(arrived_in_row),
                    values=z[arrived_in_row, i],
                    may_be_lost=declared.may_be_lost,
                    declared_period=declared.period,
                    stated_share=declared.find_share(i),
                    of_messages=of_messages,
                    refuses=refuses_values,
                    watched=refuses_stuck_values,
                )
            )
    return links


class _DeclaredSending(NamedTuple):
    """What the network says of a node's messages.

    period: rows between two, if it has a `Periodic` sender; None for others. may_be_lost: whether some may not arrive.
    shares: probability of arrival of each received number (received,); None where these are not constant.
    """

    period: int | None
    may_be_lost: bool
    shares: Float[np.ndarray, " received"] | None

    def find_share(self, i: int) -> float | None:
        """Return the probability that received number i arrives; None if it is not constant.

        Numbers that come with the values, such as a mode, stand behind them and have none.
        """
        return None if self.shares is None or i >= len(self.shares) else float(self.shares[i])


def _read_declared_sending(receiver: Any) -> _DeclaredSending:
    """Return what the network says of a node's messages: their period, if they may be lost, and which shares arrive.

    The period is in steps, None if none is declared. There is a share for each received number, None if they are not
    constant. `receiver`: a `Node` behind a channel, or a relay, which says only whether it is `complete`, that is loses
    nothing.
    """
    if not isinstance(receiver, Node):
        return _DeclaredSending(period=None, may_be_lost=not receiver.complete, shares=None)
    shares = _find_arrival_probabilities(receiver)
    # A node with a periodic sender is never complete. Then only the channel says whether messages may be lost.
    if isinstance(receiver.trigger, Periodic):
        may_be_lost = first(receiver.channel).erases
        return _DeclaredSending(period=int(receiver.trigger.period), may_be_lost=may_be_lost, shares=shares)
    return _DeclaredSending(period=None, may_be_lost=not receiver.complete, shares=shares)


def _find_arrival_probabilities(receiver: Node) -> Float[np.ndarray, " received"] | None:
    """Return the probability of arrival of each received number, or None if it is not constant.

    It is also None if the link loses nothing, or if the sender decides when to send. `erases` says whether the channel
    loses components, `remembers` whether losses depend on earlier ones. An outcome has a probability and the mask
    `arrived` of components. `receiver`: the node, with its channel, and its trigger if its sender does not send in each
    step.
    """
    sends_always = receiver.trigger is None or isinstance(receiver.trigger, Periodic)
    if not sends_always or isinstance(receiver.channel, OverTime):
        return None
    if receiver.channel.remembers or not receiver.channel.erases:
        return None
    try:
        outcomes = receiver.channel.list_outcomes()  # each set of components that may arrive together
    except InputError:  # more sets than are listed
        return None
    return np.asarray(np.sum([float(outcome.probability) * outcome.arrived for outcome in outcomes], axis=0))
