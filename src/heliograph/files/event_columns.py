"""Events of a recording as arrays, and the verdicts on them that a timeline gives to one event after another."""

from array import array
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from heliograph.files.sources.message_reading import Unread
from heliograph.live.event import VERDICTS, Verdict
from heliograph.live.health.link_counts import GAP
from heliograph.model.checks.refusal_reasons import Reason, RefusedError
from heliograph.numerics.check import fail
from heliograph.numerics.times.timestamp_order import SECOND, YEAR, find_unset_stamps
from heliograph.numerics.types import Bool, Float, Int
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

USED, DUPLICATE, CONFLICT, LATE, FUTURE = map(VERDICTS.index, ("used", "duplicate", "conflict", "late", "future"))
FEWEST_FALLS = 3  # of a count from one number, before that is taken for its largest


class UnsetStampNotes(NamedTuple):
    """What is said of stamps that were not set."""

    note: str = ""  # on the clock
    reason: str = ""  # why events were removed
    removed: int = 0  # how many


@dataclass
class NodeEvents:
    """Events of one node: times and arrivals in nanoseconds, steps or numbers, counts (-1: none), `size` values each.

    Attributes:
        size: numbers of each event.
        numbers: whether times are floats.
        period: after how many messages the count begins at 0 again; 0 if it does not.
        unread: of the messages that came and are no events, since they could not be read or their stamps were not set:
            moments near which they came, and their counts.
        refused: how many messages were refused for their flag or counter.
    """

    size: int
    numbers: bool = False
    period: int = 0
    time: "array[Any]" = field(init=False)  # of int or float
    arrival: "array[Any]" = field(init=False)
    sequence: "array[int]" = field(default_factory=lambda: array("q"))
    values: "array[float]" = field(default_factory=lambda: array("d"))
    unread: list[tuple[float, int]] = field(default_factory=list)
    refused: "Counter[Reason]" = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.time, self.arrival = (array("d" if self.numbers else "q") for _ in range(2))

    def arrays(self) -> tuple[np.ndarray, np.ndarray, Int[np.ndarray, " events"]]:
        """Return times, arrivals and counts of the events, (events,) each."""
        return np.array(self.time), np.array(self.arrival), np.array(self.sequence, dtype=np.int64)

    def keep_events(self, which: np.ndarray) -> None:
        """Keep only the events of the mask `which`, (events,)."""
        time_arrival_sequence, kept_values = self.arrays(), self.value_matrix()[which]
        # NumPy's name of 64-bit integers is "l" on some systems, that of `array` is "q".
        kept_columns = [column[which] for column in time_arrival_sequence]
        self.time, self.arrival, self.sequence = (array(c.dtype.char.replace("l", "q"), c) for c in kept_columns)
        self.values = array("d", kept_values.ravel())

    def value_matrix(self) -> Float[np.ndarray, "events size"]:
        """Return the values, a row for each event."""
        return np.array(self.values).reshape(len(self.time), self.size)

    def note_unread(self, unread: Unread, arrival: float | None) -> None:
        """Note an unread message: why, and its count at its time, else its arrival, else the newest event's time."""
        if isinstance(unread.error, RefusedError):
            self.refused[unread.error.reason] += 1
        reading = unread.counted
        if reading is None:
            return
        candidates = (reading.time, arrival, self.time[-1] if self.time else None)
        moment = next((candidate for candidate in candidates if candidate is not None), None)
        if moment is not None and reading.sequence is not None:
            self.unread.append((moment, reading.sequence))
            self.period = reading.period

    def count_lost(self) -> int | None:
        """Return how many messages are missing by the node's running count, or None if messages have no count (-1).

        `self.unread` holds (time, count) of messages that came but are no events; they were not lost.
        """
        time, _, sequence = self.arrays()
        if not len(time) or sequence.min() < 0:
            return None
        moments = np.array([moment for moment, _ in self.unread], dtype=time.dtype)
        counts = np.array([count for _, count in self.unread], dtype=np.int64)
        return count_missing_messages(np.concatenate([time, moments]), np.concatenate([sequence, counts]), self.period)

    def write_losses_before_events(
        self, table: Float[np.ndarray, "rows received"], rows: np.ndarray, counts: Int[np.ndarray, " events"]
    ) -> None:
        """Write into the last column of `table` how many messages were lost before each event.

        Only NaN is replaced, where the message did not say it. `counts` are the running counts of the events in `rows`.
        """
        lost = np.diff(counts, prepend=counts[:1]) - 1.0
        lost[lost < 0] = np.nan  # not known of the first message, nor after a restart
        has_count = min(self.sequence, default=-1) >= 0
        to_fill = np.isnan(table[rows, -1]) & has_count
        table[rows[to_fill], -1] = lost[to_fill]

    def describe_doubtful_count(self, name: str) -> list[str]:
        """Return a line if a count begins at 0 again sooner than its bits say, and one if it stands still.

        It begins sooner than its `period` if it fell three times or more, each time from 2^b - 1. `name`: of the node.
        """
        if not self.period or not len(self.time):
            return []
        lines = list[str]()
        # Counts in order of time, and the difference of each to the next.
        time, _, sequence = self.arrays()
        order = np.lexsort((sequence, time))
        counts, differences = sequence[order], np.diff(sequence[order])
        # Whether the largest number is all ones in fewer bits than were said, and each fall is from it.
        largest, before_falls = int(counts.max()), counts[:-1][differences < 0]
        bits = largest.bit_length()
        is_all_ones = largest + 1 == 1 << bits and largest + 1 < self.period
        if is_all_ones and len(before_falls) >= FEWEST_FALLS and np.all(before_falls == largest):
            lines.append(
                f"{name}: the count begins at 0 again after {largest}, not after {self.period - 1}: bits={bits}; until "
                "then what is lost is counted wrongly"
            )
        repeated = int(np.sum((differences == 0) & (np.diff(time[order]) > 0)))
        if repeated:
            lines.append(
                f"{name}: the count of {repeated} messages is that of the one before: repeated, not measured anew"
            )
        return lines

    def list_lost_digits(self, name: str) -> list[str]:
        """Return a line if most events share their stamp with others, as if stamps had lost digits; else nothing."""
        count, distinct = len(self.time), len(np.unique(np.array(self.time)))
        return [f"{name}: {count} events have {distinct} stamps"] if count > 3 and 2 * distinct <= count else []

    def drop_unset_stamps_in_place(self, name: str) -> UnsetStampNotes:
        """Remove the events whose stamps were not set; return what is to be said of that. `name`: name of the node.

        A stamp (time of measuring) that is more than a year before its arrival was not set. Where most are, stamps and
        arrivals are of two clocks: nothing is removed, and each event arrives when it was measured. Where no arrivals
        are known, a stamp was not set if it is more than a year away from both neighbours, which are near each other.
        """
        time, arrival, _ = self.arrays()
        delays, year = arrival - time, YEAR / SECOND if self.numbers else YEAR  # numbers are seconds
        if not len(time):
            return UnsetStampNotes()
        if np.median(delays) > year:
            self.arrival = array(self.time.typecode, self.time)
            two_clocks = "stamps and arrivals are of two clocks: each event arrives when it was measured"
            return UnsetStampNotes(note=f"{name}: {two_clocks}")
        are_arrivals_known = bool(delays.any())  # else each arrival is the event's own time
        unset = delays > year if are_arrivals_known else find_unset_stamps(time, year)
        count = int(np.count_nonzero(unset))
        if not count:
            return UnsetStampNotes()
        self._note_unset(unset, are_arrivals_known)
        first = time[np.argmax(unset)]
        moment = f"{first:.10g}" if self.numbers else str(np.datetime64(int(first), "ns"))
        near = "that of arrival" if are_arrivals_known else "the others in order"
        why = fail(name, f"a time that was set, near {near}", f"{moment} in {count} of {len(time)} messages")
        self.keep_events(~unset)
        return UnsetStampNotes(reason=str(why), removed=count)

    def _note_unset(self, unset: Bool[np.ndarray, " events"], are_arrivals_known: bool) -> None:
        """Note events whose stamps are not set as unread messages, with their counts and the moments they came.

        If arrivals are not known, the moment is the time of the last earlier event with a stamp, or else of the first.
        """
        time, moments, sequence = self.arrays()
        if not are_arrivals_known:
            last_set = np.maximum.accumulate(np.where(unset, -1, np.arange(len(time))))
            first_set = np.argmin(unset)
            moments = time[np.where(last_set < 0, first_set, last_set)]
        self.unread += zip(moments[unset].tolist(), sequence[unset].tolist(), strict=True)


class EventsByArrival(NamedTuple):
    """Events in order of arrival, (events,) each: node (-1: inputs), time, arrival, count, index among its node's."""

    node: np.ndarray
    time: np.ndarray
    arrival: np.ndarray
    sequence: np.ndarray
    event_index: np.ndarray

    def select(self, which: np.ndarray) -> "EventsByArrival":
        """Return some of the events, by number or by mask."""
        return EventsByArrival(*(column[which] for column in self))


def judge_events(
    events: EventsByArrival,
    values: Callable[[int], np.ndarray],
    joint: bool,
    window: float,
    ahead: float,
) -> Int[np.ndarray, " events"]:
    """Return the number of the verdict on each event, among `VERDICTS`: the first that holds.

    An event is a node's message, with time, arrival and running count; all events of a time, or one alone, make a row.
    It is in the future if its time is later than its arrival by more than `ahead`. It is late if its row was final
    before it came: at each arrival the rows older than that by more than the window become final. Of events of one
    node, count and time the first is used; if rows are joint, so are the first values of a node at a time.

    Args:
        events: the events, in order of arrival.
        values: a function that returns the values of an event from its number in that order.
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
    # Rival events are of one node in one row. Most are alone there, and stay used.
    row_and_node = _rank_rows(some.time, some.node) if joint else identity
    has_rivals: Bool[np.ndarray, " rows_and_nodes"] = np.bincount(row_and_node, minlength=1) > 1
    contenders = np.flatnonzero(has_rivals[row_and_node] & (row >= newest_final))
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
        numbers: numbers of the events to judge, in order of arrival.
        identities: for each, a number for its node, time and count; later events of one identity are repetitions.
        rows_and_nodes: for each, a number that stands for its row and node if rows are joint, else its identity.
        values: the values of the event with a number.
        joint: whether all events of one time are one row.
    """
    first_of_identity = dict[int, int]()  # the number of the first event of each identity, which stays
    filled = dict[int, np.ndarray]()  # by row and node the mask of the components that have a value
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


def count_missing_messages(time: np.ndarray, sequence: Int[np.ndarray, " events"], period: int) -> int:
    """Return how many running counts are missing between a node's messages, which are sorted by their times.

    The count begins again at 0 after `period` messages; 0 means that it never does. A count that falls has gone around
    if this makes at most GAP (2^14) messages in between. Otherwise the node was restarted.
    """
    if not len(time):
        return 0
    differences = np.diff(sequence[np.lexsort((sequence, time))])
    # A count that fell either went around its period, or the node was restarted; then nothing is missing (1).
    counted_around = np.mod(differences, period) if period else differences
    advances = np.where(differences > 0, differences, np.where(counted_around <= GAP, counted_around, 1))
    return int(np.sum(np.maximum(advances - 1, 0)))


def count_equal_rows_before(*columns: np.ndarray) -> Int[np.ndarray, " events"]:
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
    """Return for each event the rank of the newest row that is final when it comes, -1 if there is none.

    `rank`: number of each event's row. An event of time t is final once another one arrives later than t + window.
    """
    count = len(rank)
    if not np.isfinite(window):
        return np.full(count, -1)
    # Each event is final from this event on: the first after it whose watermark, arrival - window, is past its time.
    watermark = events.arrival - window
    final_from = np.maximum(np.arange(count) + 1, np.searchsorted(watermark, events.time, side="right"))
    newest_final = np.full(count + 1, -1)  # of the events that become final at each one, and then of all so far
    np.maximum.at(newest_final, final_from, rank)
    return np.maximum.accumulate(newest_final[:count])


def node_counts_losses(network: Network, name: str) -> bool:
    """Return whether a node also receives a number on losses: how many transmissions were lost before its values."""
    node = network.nodes[name]
    if not isinstance(node, Node) or node.trigger is None or node.trigger.losses != "numbered":
        return False
    return node.trigger.side_information(len(node.outputs)) == 1  # numbers on losses that come after the values


def number_rows(time: np.ndarray, steps: bool, joint: bool) -> tuple[Int[np.ndarray, " events"], np.ndarray]:
    """Return the number of the row of each event, from 0, and the times of the rows.

    Args:
        time: times of the events, in order, at least one.
        steps: whether times are numbers of steps; every step is then a row, even without an event.
        joint: whether all events of one time are one row.
    """
    if steps:
        return time.astype(np.int64), np.arange(int(time[-1]) + 1)
    begins_row = np.ones(len(time), dtype=bool)
    begins_row[1:] = time[1:] != time[:-1] if joint else True
    return np.cumsum(begins_row) - 1, time[begins_row]


def put_values_in_rows(
    values: Float[np.ndarray, "events size"], row: Int[np.ndarray, " events"], count: int
) -> Float[np.ndarray, "rows size"]:
    """Return a table (count, size) with the values of events in their rows, and NaN where no value arrived.

    If a row has several events, each component takes its last value that is not NaN.
    """
    table = np.full((count, values.shape[1]), np.nan)
    for i in range(values.shape[1]):
        present = ~np.isnan(values[:, i])
        table[row[present], i] = values[present, i]
    return table


def fill_forward(values: Float[np.ndarray, "rows given"]) -> Float[np.ndarray, "rows given"]:
    """Return each column with every NaN replaced by the last value before it, or by 0 if there is none."""
    own_row = np.where(np.isnan(values), -1, np.arange(len(values))[:, None])  # -1: no value in this row
    last_row = np.maximum.accumulate(own_row, axis=0) if len(values) else own_row
    return np.asarray(np.where(last_row < 0, 0.0, np.take_along_axis(values, np.maximum(last_row, 0), axis=0)))


def make_inputs_leading_to_rows(
    held: Float[np.ndarray, "rows given"], times: np.ndarray, unit: int, time_index: int
) -> Float[np.ndarray, "rows inputs"]:
    """Return the inputs that lead to each row in continuous time: the previous row's inputs, and the time since it.

    Args:
        held: inputs that were set last, at each row; before the first row they are 0.
        times: times of the rows, in whole parts of the unit of time, such as nanoseconds.
        unit: how many of these parts are one unit of time.
        time_index: index among the inputs of dt, the time since the previous row.
    """
    inputs_of_row_before = np.vstack([np.zeros((1, held.shape[1])), held[:-1]])
    dt = np.diff(times, prepend=times[:1]) / unit
    return np.insert(inputs_of_row_before, time_index, dt, axis=1)
