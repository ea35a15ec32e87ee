"""Arrivals of one received number over a recording: when it was due, how often it came, how often it was lost."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import ndtri

from heliograph.model.over_time import OverTime, first
from heliograph.model.trigger import Periodic
from heliograph.numerics.check import InputError
from heliograph.numerics.shares import count_independent
from heliograph.numerics.types import Bool, Float, Int
from heliograph.report.pattern import Pattern, find_pattern
from heliograph.report.rate import Rate, find_rate
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
        may_be_lost: whether the network says that it may be lost, or is not always sent.
        declared_period: rows between messages of a sender that says so (`Periodic`); None of others.
        stated_share: probability of arrival by the network; None where it is not one number, as in bursts.
        of_messages: whether each row is there because some node's message is, so that others are not due in it.
        refuses: whether the node refuses values, beyond limits or stuck, which then are missing here.
        watched: whether it refuses those that are stuck.
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
    def rate(self) -> Rate | None:
        """The mean rate of a sender whose clock is not that of the rows; None where a pattern of rows explains as much.

        None too where its period is declared, and where rows are messages.
        """
        if self.declared_period is not None or self.of_messages:
            return None
        rate, pattern = find_rate(self.arrived), find_pattern(self.arrived)
        # At this rate some len / period messages are due: it tells more where a pattern has more due rows than that.
        finer = pattern is None or rate is None or rate.period * pattern.rows.sum() > len(self.arrived) + rate.period
        return rate if finer else None

    @cached_property
    def period(self) -> float | None:
        """Time between messages of a sender that is slower than the rows, in seconds or the unit of `time`; else None.

        Declared, or found: it has a rate of its own, or nearly all intervals between arrivals are whole multiples of
        their median. Losses of a sender that is due in each row leave intervals of all lengths, and no such period.
        """
        clock = _read_clock(self.time)
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
        apart = np.abs(intervals / period - np.maximum(np.round(intervals / period), 1))
        return period if np.mean(apart <= NEAR) >= REGULAR else None

    @cached_property
    def slots(self) -> Bool[np.ndarray, " slots"] | None:
        """Whether a message came in each slot that it may have: the rows, or one a period from the first arrival.

        None where rows are messages of other nodes and this one has no period: then nobody knows.
        """
        if self.period is None:
            return None if self.of_messages and not self.arrived.all() else self.arrived
        clock = _read_clock(self.time)
        came = clock[self.arrived]
        if not len(came):
            return np.zeros(max(int((clock[-1] - clock[0]) / self.period), 1), dtype=bool)
        # Whole periods from each to the next; then those that are late by more than is usual.
        if self.rate is not None:
            apart = np.diff(self.rate.slots)
        else:
            apart = np.maximum(np.round(np.diff(came) / self.period), 1).astype(np.int64)
        since = max(int((clock[-1] - came[-1]) / self.period - NEAR), 0)
        slots = np.zeros(1 + int(apart.sum()) + since, dtype=bool)
        slots[np.concatenate([[0], np.cumsum(apart)])] = True
        return slots

    @cached_property
    def pattern(self) -> Pattern | None:
        """The slots in which it is due, where these return as a pattern, such as 3 of each 4; None if it is in each.

        A sender that says when it is due has none.
        """
        return None if self.slots is None or self.declared_period is not None else find_pattern(self.slots)

    @property
    def due_slots(self) -> Bool[np.ndarray, " due"] | None:
        """Whether a message came in each slot in which one was due; None where nobody knows."""
        return self.slots if self.slots is None or self.pattern is None else self.slots[self.pattern.rows]

    @property
    def due_in(self) -> str:
        """The rows or times in which it is due, in words."""
        if self.slots is None:
            return "not known"
        some = "" if self.pattern is None else f"{self.pattern.due} of {self.pattern.length}"
        if self.period is None:
            return f"{some} rows" if some else "each row"
        return f"{some}, each {self.period:.4g}" if some else f"each {self.period:.4g}"

    @property
    def lost_times(self) -> np.ndarray:
        """Times at which it was due and did not come; of a sender that is slower than the rows between its arrivals."""
        if self.slots is None or not self.arrived.any():
            return self.time[:0] if self.slots is None else self.time
        due = np.ones(len(self.slots), dtype=bool) if self.pattern is None else self.pattern.rows
        lost = np.flatnonzero(~self.slots & due)
        if self.period is None:
            return self.time[lost]
        clock, came = _read_clock(self.time), np.flatnonzero(self.slots)
        times = clock[self.arrived]
        if len(came) != len(times):  # several that came in one slot
            times = np.interp(came, [came[0], max(came[-1], came[0] + 1)], [times[0], times[-1]])
        at = np.interp(lost, came, times) + np.maximum(lost - came[-1], 0) * self.period
        return np.asarray(self.time[0] + at * np.timedelta64(10**9, "ns") if self.time.dtype.kind == "M" else at)

    @property
    def due(self) -> int | None:
        """Number of messages that were due; None where nobody knows."""
        return None if self.due_slots is None else len(self.due_slots)

    @property
    def numbers(self) -> Int[np.ndarray, " arrivals"]:
        """Running number of each message that arrived, from 0, among those that were due; of rows if nobody knows."""
        there = np.flatnonzero(self.arrived if self.due_slots is None else self.due_slots)
        return there - there[:1]

    @property
    def share(self) -> float:
        """Share of the messages that were due which arrived; NaN where nobody knows how many were."""
        return np.nan if self.due is None else min(float(self.arrived.sum()) / self.due, 1.0)

    def contradicts(self, level: float) -> bool:
        """Test at a level whether the share that arrived is another than the stated one, and by more than a hundredth.

        Arrivals that come in bursts say as much as fewer independent ones, N (1 - a) / (1 + a).
        """
        p = self.stated_share
        if p is None or self.due_slots is None or not 0 < p < 1:
            return False
        came = self.due_slots.astype(float)
        independent = len(came) if self.period is not None else count_independent(came)
        deviation = np.sqrt(p * (1 - p) / independent)
        return bool(abs(self.share - p) > max(-ndtri(level / 2) * deviation, LEAST_SHARE))

    @property
    def longest_gap(self) -> int | None:
        """Greatest number of messages in a row that were due and did not arrive; None where nobody knows."""
        if self.due_slots is None:
            return None
        ends = np.flatnonzero(np.concatenate([[True], self.due_slots, [True]]))
        return int(np.max(np.diff(ends)) - 1)


def rows_are_messages(arrived: Mapping[str, Bool[np.ndarray, " time"]]) -> bool:
    """Test whether rows are there because messages are: something arrived at each time, mostly of one node alone.

    Args:
        arrived: by node, whether anything of it arrived at each time.
    """
    together = np.sum(list(arrived.values()), axis=0)
    return len(arrived) > 1 and bool(np.all(together > 0) and np.median(together) <= 1)


def _read_clock(time: np.ndarray) -> Float[np.ndarray, " time"]:
    """Return the times as numbers: dates in seconds after the first."""
    if time.dtype.kind == "M":
        return np.asarray((time - time[0]) / np.timedelta64(1, "s"), dtype=float)
    return np.asarray(time, dtype=float)


def list_arrivals(network: Network, times: np.ndarray, received: Mapping[str, np.ndarray]) -> list[Arrivals]:
    """Return when each component arrived, by distinct times: of messages at one time each may be a row.

    Args:
        network: the network.
        times: of the rows (time,).
        received: by node, (time, received), NaN where nothing arrived.
    """
    time, row = np.unique(times, return_inverse=True)

    def by_time(there: Any) -> np.ndarray:
        came = np.zeros(len(time), dtype=bool)
        came[row[there]] = True
        return came

    messages = rows_are_messages({node: by_time(np.any(~np.isnan(z), axis=1)) for node, z in received.items()})
    links = []
    for node, z in received.items():
        receiver = network.nodes[node]
        declared, may_be_lost, limits = None, not receiver.complete, receiver.limits
        shares = _find_arrival_probabilities(receiver) if isinstance(receiver, Node) else None
        if isinstance(receiver, Node) and isinstance(receiver.trigger, Periodic):
            declared, may_be_lost = int(receiver.trigger.period), first(receiver.channel).erases
        for i, name in enumerate(receiver.received_names):
            there = ~np.isnan(z[:, i])
            stated = None if shares is None or i >= len(shares) else float(shares[i])
            refuses, watched = limits is not None, limits is not None and limits.stuck is not None
            values = time, by_time(there), z[there, i]
            links.append(Arrivals(node, name, *values, may_be_lost, declared, stated, messages, refuses, watched))
    return links


def _find_arrival_probabilities(receiver: Node) -> Float[np.ndarray, " received"] | None:
    """Return the probability of arrival of each received number; None of a link whose losses remember or change."""
    sends_always = receiver.trigger is None or isinstance(receiver.trigger, Periodic)
    if not sends_always or isinstance(receiver.channel, OverTime):
        return None
    if receiver.channel.remembers or not receiver.channel.erases:
        return None
    try:
        sets = receiver.channel.list_outcomes()
    except InputError:  # more sets of losses than are listed
        return None
    return np.asarray(np.sum([float(o.probability) * o.arrived for o in sets], axis=0))
