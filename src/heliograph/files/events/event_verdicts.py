"""Verdicts on events (used, a copy, late, in the future), for all events of a recording at once, as arrays.

They equal those of `live.Timeline`, which judges one event after another as they arrive.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from heliograph.files.events.event_columns import NodeEvents
from heliograph.live.event import VERDICTS, Verdict
from heliograph.numerics.check import fail
from heliograph.numerics.types import Bool, Int

USED, DUPLICATE, CONFLICT, LATE, FUTURE = map(VERDICTS.index, ("used", "duplicate", "conflict", "late", "future"))


class EventsByArrival(NamedTuple):
    """Events in order of arrival, as columns (events,)."""

    node: np.ndarray  # index of the node; -1 for events of the plant's inputs
    time: np.ndarray  # of measuring
    arrival: np.ndarray
    sequence: np.ndarray  # running count of the node's messages
    event_index: np.ndarray  # index of the event among those of its node, as they were read

    def select(self, which: np.ndarray) -> "EventsByArrival":
        """Return some of the events; `which` holds their indices, or is a mask (events,)."""
        return EventsByArrival(*(column[which] for column in self))

    def convert_to_steps(self, first: int, step: int) -> "EventsByArrival":
        """Return the events with times and arrivals as numbers of the nearest steps, rounded up in the middle.

        `first` is the moment of step 0 and `step` the length of a step, both in the unit of the times.
        """
        time, arrival = ((moments - first + step // 2) // step for moments in (self.time, self.arrival))
        return self._replace(time=time, arrival=arrival)


def sort_by_arrival(columns: Mapping[str, NodeEvents]) -> EventsByArrival:
    """Return the events of all nodes in order of arrival.

    Events without a running count get one: how many events of the same node and time arrived before.

    `lexsort` sorts by the last key first: by arrival, then in the order in which a node's events came. `event_index`
    numbers the events of one node.

    Args:
        columns: the events of the inputs, whose node number is -1, and then of each node, numbered from 0.

    Raises:
        ValueError: no events.
    """
    parts = []
    for node, events_of_node in enumerate(columns.values(), -1):
        time, arrival, sequence = events_of_node.arrays()
        parts.append(EventsByArrival(np.full(len(time), node), time, arrival, sequence, np.arange(len(time))))
    events = EventsByArrival(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    if not len(events.time):
        raise fail("events", "at least one", "none")
    events = events.select(np.lexsort((events.event_index, events.arrival)))
    uncounted = events.sequence < 0
    events.sequence[uncounted] = _count_equal_rows_before(events.node[uncounted], events.time[uncounted])
    return events


def judge_events(
    events: EventsByArrival,
    values_by_node: Sequence[np.ndarray],
    joint: bool,
    window: float,
    ahead: float,
) -> Int[np.ndarray, " events"]:
    """Return the verdict on each event as its index in `VERDICTS`.

    An event is a node's message, with time, arrival and running count; all events of a time, or one alone, make a row.
    It is in the future if its time is later than its arrival by more than `ahead`. It is late if its row was final
    before it came: at each arrival the rows older than that by more than the window become final. Of events of one
    node, count and time the first is used; if rows are joint, so are the first values of a node at a time. USED, LATE,
    FUTURE, DUPLICATE and CONFLICT are such indices.

    Args:
        events: the events, in order of arrival.
        values_by_node: values of each node's events, (events, values), last those of the inputs.
        joint: whether all events of one time are one row.
        window: how late an event may be, in the unit of the times.
        ahead: how much later than its arrival the time of an event may be.
    """
    verdicts = np.full(len(events.time), USED)
    verdicts[events.time > events.arrival + ahead] = FUTURE
    # The events that are not in the future, and a number for each node, time and count that occurs among them: its
    # identity. Identities are in order of time; of one time inputs come first, as node -1, then nodes and counts.
    candidates = np.flatnonzero(verdicts != FUTURE)
    some = events.select(candidates)
    identity = _rank_rows(some.time, some.node, some.sequence)
    # The number of the row that each belongs to, in order of time: that of its time, or one of its own.
    row = _rank_rows(some.time) if joint else identity
    # Late: the row was final before the event came. If that is the newest final row and not joint, an event of the
    # same identity made it: this one is a copy, and judged as such.
    newest_final = _find_newest_final_row(some, row, window)
    is_late = row <= newest_final if joint else row < newest_final
    verdicts[candidates[is_late]] = LATE
    # Rival events are of one node in one row, as copies are; they come in order of arrival, and the first one stays.
    # Most are alone there, and stay used.
    row_and_node = _rank_rows(some.time, some.node) if joint else identity
    has_rivals: Bool[np.ndarray, " rows_and_nodes"] = np.bincount(row_and_node, minlength=1) > 1
    contenders = np.flatnonzero(has_rivals[row_and_node] & (row >= newest_final))

    def values(i: int) -> np.ndarray:
        """Return the values of the event with index i in `events`."""
        return np.asarray(values_by_node[events.node[i]][events.event_index[i]])

    _judge_repeated_events(
        verdicts, candidates[contenders], identity[contenders], row_and_node[contenders], values, joint
    )
    return verdicts


def _judge_repeated_events(
    verdicts: Int[np.ndarray, " events"],
    numbers: np.ndarray,
    identities: np.ndarray,
    rows_and_nodes: np.ndarray,
    values: Callable[[int], np.ndarray],
    joint: bool,
) -> None:
    """Write the verdicts on copies, and on second values of a node in a joint row: the first event stays.

    Args:
        verdicts: verdicts on all events, such as USED, changed here to DUPLICATE (same values) or CONFLICT (others).
        numbers: indices of the events to judge, in order of arrival.
        identities: for each, a number for its node, time and count; later events of one identity are repetitions.
        rows_and_nodes: for each, a number that stands for its row and node if rows are joint, else its identity.
        values: function from an event's index to its values.
        joint: whether all events of one time are one row.
    """
    first_of_identity = dict[int, int]()  # {identity: index of its first event, which stays}
    filled = dict[int, np.ndarray]()  # {row and node: mask of the components that have a value}
    for event, identity, row_and_node in zip(
        numbers.tolist(), identities.tolist(), rows_and_nodes.tolist(), strict=True
    ):
        if identity in first_of_identity:
            is_same = np.array_equal(values(event), values(first_of_identity[identity]), equal_nan=True)
            verdicts[event] = DUPLICATE if is_same else CONFLICT
        elif verdicts[event] == USED:
            present = ~np.isnan(values(event))
            filled_before = filled.get(row_and_node, np.zeros_like(present))
            if joint and np.any(present & filled_before):  # a second value of a component in its row
                verdicts[event] = CONFLICT
            else:
                first_of_identity[identity] = event
                filled[row_and_node] = present | filled_before


def count_verdicts(
    node: Int[np.ndarray, " events"], verdicts: Int[np.ndarray, " events"]
) -> dict[int, dict[Verdict, int]]:
    """Return {node: {verdict: count of its events}}; `verdicts` holds for each event an index into VERDICTS."""
    return {
        int(number): {verdict: int(np.sum(verdicts[node == number] == i)) for i, verdict in enumerate(VERDICTS)}
        for number in np.unique(node)
    }


def _count_equal_rows_before(*columns: np.ndarray) -> Int[np.ndarray, " events"]:
    """Return for each row how many equal rows come before it; row i consists of entry i of each column."""
    ranks = _rank_rows(*columns)
    order = np.argsort(ranks, kind="stable")
    first_of_equals = np.searchsorted(ranks[order], ranks[order])  # index of the first equal row in this order
    counts = np.empty(len(order), dtype=np.int64)
    counts[order] = np.arange(len(order)) - first_of_equals
    return counts


def _rank_rows(*columns: np.ndarray) -> Int[np.ndarray, " events"]:
    """Return the rank of each row, sorted by the first column and then by the others; equal rows share a rank."""
    order = np.lexsort(columns[::-1])  # lexsort takes the most important column last
    differs_from_row_before = np.zeros(len(order), dtype=bool)
    for column in columns:
        differs_from_row_before[1:] |= column[order][1:] != column[order][:-1]
    ranks = np.empty(len(order), dtype=np.int64)
    ranks[order] = np.cumsum(differs_from_row_before)
    return ranks


def _find_newest_final_row(
    events: EventsByArrival, rank: Int[np.ndarray, " events"], window: float
) -> Int[np.ndarray, " events"]:
    """Return for each event the rank of the newest row that is final when the event arrives, -1 if there is none.

    A row of time t is final once some event arrives later than t + window. Rows are ranked by time. `watermark` is how
    far time has certainly got at each arrival.

    Args:
        events: the events, in order of arrival.
        rank: rank of each event's row.
        window: how late an event may be.
    """
    count = len(rank)
    if not np.isfinite(window):
        return np.full(count, -1)
    # `final_from[i]`: index of the first event after i with arrival - window > time[i]; i's row is final from then on.
    watermark = events.arrival - window
    final_from = np.maximum(np.arange(count) + 1, np.searchsorted(watermark, events.time, side="right"))
    # The greatest rank that becomes final at each event; the last entry is for those that never do.
    newest_at_event = np.full(count + 1, -1)
    np.maximum.at(newest_at_event, final_from, rank)
    return np.maximum.accumulate(newest_at_event[:count])
