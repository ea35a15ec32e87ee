"""Events of one node in columns: times, arrivals, running counts and values, and what is doubtful about them.

An event is a message with measurements. Its running count numbers the sender's messages, so that gaps show losses.
"""

from array import array
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from heliograph.files.sources.message_reading import Unread
from heliograph.live.health.link_counts import GAP
from heliograph.model.checks.refusal_reasons import Reason, RefusedError
from heliograph.numerics.check import fail
from heliograph.numerics.times.timestamp_order import SECOND, YEAR, find_unset_stamps
from heliograph.numerics.types import Bool, Float, Int
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

FEWEST_FALLS = 3  # of a count from one number, before that is taken for its largest


class UnsetStampNotes(NamedTuple):
    """What the user is told of events whose time stamp was not set; all empty if there are none."""

    note: str = ""  # a line on the clock
    reason: str = ""  # why events were removed
    removed: int = 0  # how many


@dataclass
class NodeEvents:
    """Events of one node in columns that grow as messages are read.

    Times of measuring and of arrival are nanoseconds since 1970, numbers of steps, or floats in the network's unit. The
    running count is -1 where there is none.

    Attributes:
        size: how many values each event has.
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
        """Begin empty columns of times, of 64-bit floats ("d") or integers ("q")."""
        self.time, self.arrival = (array("d" if self.numbers else "q") for _ in range(2))

    def arrays(self) -> tuple[np.ndarray, np.ndarray, Int[np.ndarray, " events"]]:
        """Return times, arrivals and counts of the events, (events,) each."""
        return np.array(self.time), np.array(self.arrival), np.array(self.sequence, dtype=np.int64)

    def keep_events(self, which: np.ndarray) -> None:
        """Keep only the events of the mask `which`, (events,)."""
        kept_values = self.value_matrix()[which]
        kept_columns = [column[which] for column in self.arrays()]
        # NumPy's name of 64-bit integers is "l" on some systems, that of `array` is "q".
        self.time, self.arrival, self.sequence = (array(c.dtype.char.replace("l", "q"), c) for c in kept_columns)
        self.values = array("d", kept_values.ravel())

    def value_matrix(self) -> Float[np.ndarray, "events size"]:
        """Return the values, a row for each event."""
        return np.array(self.values).reshape(len(self.time), self.size)

    def note_unread(self, unread: Unread, arrival: float | None) -> None:
        """Note a message that came but could not be read, so that its running count is not taken for a lost one.

        Its moment is its time of measuring, else its arrival, else the newest event's time. `unread.counted` is what
        was read of it, None if not even that; `self.refused` counts by reason.
        """
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
        """Write into the last column of `table` how many messages were lost before each event, by the running counts.

        Only NaN is replaced, where the message itself did not say the number. `self.sequence`: running counts of all
        events of the node, -1 where messages have none; then nothing is written.

        Args:
            table: values by row, the last of them the number of losses.
            rows: row of each event (events,).
            counts: running count of each event.
        """
        lost = np.diff(counts, prepend=counts[:1]) - 1.0
        lost[lost < 0] = np.nan  # not known of the first message, nor after a restart
        has_count = min(self.sequence, default=-1) >= 0
        to_fill = np.isnan(table[rows, -1]) & has_count
        table[rows[to_fill], -1] = lost[to_fill]

    def describe_doubtful_count(self, name: str) -> list[str]:
        """Return a line if the running count begins at 0 again before `period`, and one if messages repeat a count.

        It begins again too early if it fell at least three times, each time from the same number 2^b - 1 below the
        period: the counter has b bits, fewer than the source says. `name`: of the node.
        """
        if not self.period or not len(self.time):
            return []
        lines = list[str]()
        # Counts in order of time, and the difference of each to the next.
        time, _, sequence = self.arrays()
        order = np.lexsort((sequence, time))
        counts, differences = sequence[order], np.diff(sequence[order])
        # Whether the largest number is all ones in fewer bits than were said, and each fall is from it.
        largest = int(counts.max())
        before_falls = counts[:-1][differences < 0]
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
        """Return a line if stamps seem to have lost digits, so that two events or more share each on average; else [].

        Fewer than four events are not judged.
        """
        count, distinct = len(self.time), len(np.unique(np.array(self.time)))
        return [f"{name}: {count} events have {distinct} stamps"] if count > 3 and 2 * distinct <= count else []

    def drop_unset_stamps_in_place(self, name: str) -> UnsetStampNotes:
        """Remove the events whose stamps were not set; return what the user is told. `name`: name of the node.

        A stamp (time of measuring) that is more than a year before its arrival was not set. If most are, stamps and
        arrivals are of two clocks: nothing is removed, and arrivals are replaced by the times of measuring. If no
        arrivals are known, a stamp was not set if it is more than a year away from both neighbours, which are near each
        other. `_note_unset` keeps their moments and counts, so that they do not count as lost.
        """
        time, arrival, _sequence = self.arrays()
        if not len(time):
            return UnsetStampNotes()
        delays = arrival - time
        year = YEAR / SECOND if self.numbers else YEAR  # numbers are seconds, other times nanoseconds
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
        """Note events whose stamps are not set (mask `unset`) in `self.unread`: the moments they came, their counts.

        If arrivals are not known, the moment is the time of the last earlier event with a stamp, or else of the first.
        `self.arrays()` are times, arrivals and counts; without known arrivals each arrival is the event's own time.
        """
        time, moments, sequence = self.arrays()
        if not are_arrivals_known:
            # Index of the last event up to each one whose stamp was set; -1 if there is none.
            last_set = np.maximum.accumulate(np.where(unset, -1, np.arange(len(time))))
            first_set = np.argmin(unset)
            moments = time[np.where(last_set < 0, first_set, last_set)]
        self.unread += zip(moments[unset].tolist(), sequence[unset].tolist(), strict=True)


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


def node_counts_losses(network: Network, name: str) -> bool:
    """Return whether a node also receives a number on losses: how many transmissions were lost before its values.

    Such a sender has a trigger that numbers its transmissions.
    """
    node = network.nodes[name]
    if not isinstance(node, Node) or node.trigger is None or node.trigger.losses != "numbered":
        return False
    # How many numbers on losses a message has behind its values.
    return node.trigger.side_information(len(node.outputs)) == 1
