"""Events of a recording in columns: a few numbers each, whatever the messages weighed that they were read from."""

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from heliograph.files.recording import Recording
from heliograph.files.sources import Reading
from heliograph.learning.losses.delays import Delays, learn_delays
from heliograph.live.event import INPUTS, Event
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import fail, instance, scalar
from heliograph.numerics.module import readable
from heliograph.numerics.types import Float, Int
from heliograph.simulation.network import Network

SECOND = 10**9  # nanoseconds
MOST_STEPS = 10_000_000  # rows of a network that counts steps


@dataclass
class Columns:
    """Events of one node: times and arrivals in nanoseconds or steps, counts, and `size` values of each."""

    size: int
    time: "array[int]" = field(default_factory=lambda: array("q"))
    arrival: "array[int]" = field(default_factory=lambda: array("q"))
    sequence: "array[int]" = field(default_factory=lambda: array("q"))
    values: "array[float]" = field(default_factory=lambda: array("d"))

    def arrays(self) -> tuple[Int[np.ndarray, " events"], ...]:
        """Return times, arrivals and counts."""
        return tuple(np.array(column, dtype=np.int64) for column in (self.time, self.arrival, self.sequence))

    def matrix(self) -> Float[np.ndarray, "events size"]:
        """Return the values, a row for each event."""
        return np.array(self.values).reshape(len(self.time), self.size)


@readable
class EventTable:
    """Events of a network, read from messages of a recording, each with the time when it was measured and when logged.

    Where the network counts steps, times are steps and events arrive at once; with the seconds of a `step` times are
    moments, each of the step that is nearest, counted from the first.

    Args:
        network: the network.
        step: seconds of a step of a network that counts steps; None where times are steps, or seconds.
        start: nanoseconds since 1970 of step 0; the first event's unless given.

    Attributes:
        columns: events by node, and of "inputs".
        notes: lines on what was read and what was left out.
        broken: where and why reading ended early; "" if it did not.
    """

    def __init__(self, network: Network, step: float | None = None, start: int | None = None):
        instance("network", network, Network, "a Network")
        self.network, self.steps = network, TIME_STEP not in network.inputs
        self.step = None if step is None else round(scalar("step", step, 1 / SECOND) * SECOND)  # in nanoseconds
        self.start = start
        given = len(network.inputs) - (not self.steps)
        self.columns = {INPUTS: Columns(given)}
        self.columns |= {name: Columns(network.nodes[name].received) for name in network.names}
        self.notes: list[str] = []
        self.broken = ""

    def __len__(self) -> int:
        return sum(len(columns.time) for columns in self.columns.values())

    def add(self, reading: Reading, arrival: int) -> None:
        """Append a reading that arrived at a moment, in nanoseconds since 1970.

        Without a time it is of that moment; without a count it is counted here, or, where the time names it, is 0.
        """
        columns = self.columns[reading.node]
        time = arrival if reading.time is None else reading.time
        counted = len(columns.time) if reading.time is None else 0
        columns.time.append(time)
        columns.arrival.append(time if self._at_once else arrival)
        columns.sequence.append(counted if reading.sequence is None else reading.sequence)
        columns.values.extend(reading.values.tolist())

    def add_many(
        self,
        node: str,
        arrival: Int[np.ndarray, " events"],
        time: Int[np.ndarray, " events"],
        sequence: Int[np.ndarray, " events"],
        values: Float[np.ndarray, "events size"],
    ) -> None:
        """Append readings of a node as `add` does one after another; a time or count of -1 is one that is not there."""
        columns, counted = self.columns[node], len(self.columns[node].time) + np.arange(len(time))
        sequence = np.where(sequence >= 0, sequence, np.where(time < 0, counted, 0))
        time = np.where(time < 0, arrival, time)
        for column, numbers in ((columns.time, time), (columns.arrival, time if self._at_once else arrival)):
            column.frombytes(numbers.tobytes())
        columns.sequence.frombytes(sequence.tobytes())
        columns.values.frombytes(values.tobytes())

    @property
    def origin(self) -> int:
        """Nanoseconds since 1970 from which the times of the events count; 0 where these are steps.

        Raises:
            ValueError: no events.
        """
        first = self._first()
        return 0 if self.steps else first

    def _first(self) -> int:
        if self.start is not None:
            return self.start
        times = [min(columns.time) for columns in self.columns.values() if columns.time]
        if not times:
            raise fail("events", "at least one", "none")
        return min(times)

    @property
    def _at_once(self) -> bool:
        """Return whether times are steps, which say nothing of the moment of arrival."""
        return self.steps and self.step is None

    def _arrays(self, name: str) -> tuple[Int[np.ndarray, " events"], ...]:
        """Return times, arrivals and counts of a node, in steps or nanoseconds."""
        time, arrival, sequence = self.columns[name].arrays()
        if self.step is not None and len(time):
            first, half = self._first(), self.step // 2
            time, arrival = ((moments - first + half) // self.step for moments in (time, arrival))
        return time, arrival, sequence

    @property
    def date(self) -> np.datetime64:
        """Return the date from which the times of the events count."""
        return np.datetime64(0 if self._at_once else self._first(), "ns")

    def in_order(self) -> Iterator[Event]:
        """Yield the events in order of arrival, with times in seconds from the origin or in steps."""
        origin, unit = self.origin, 1 if self.steps else SECOND
        names = list(self.columns)
        parts = [self._arrays(name) for name in names]
        values = [columns.matrix() for columns in self.columns.values()]
        node = np.repeat(np.arange(len(names)), [len(arrays[0]) for arrays in parts])
        row = np.concatenate([np.arange(len(arrays[0])) for arrays in parts])
        arrivals = np.concatenate([arrays[1] for arrays in parts])
        # Exact differences of whole nanoseconds before they are floats.
        for i in np.lexsort((row, arrivals)).tolist():
            n, k = int(node[i]), int(row[i])
            time, arrival, sequence = (int(column[k]) for column in parts[n])
            yield Event(names[n], sequence, (time - origin) / unit, values[n][k], (arrival - origin) / unit)

    def lateness(self) -> dict[str, Float[np.ndarray, " events"]]:
        """Return by node the seconds from measuring to logging of its events; inputs and nodes without any are absent.

        The events are in order of their times.
        """
        results = {}
        for name in () if self._at_once else self.network.names:
            time, arrival, _ = self.columns[name].arrays()
            if len(time):
                results[name] = ((arrival - time) / SECOND)[np.argsort(time, kind="stable")]
        return results

    def delays(self, step: float | None = None) -> dict[str, Delays]:
        """Return by node the law of its delays in steps, with intervals; nodes without any are absent.

        Args:
            step: seconds of a step; that of the table, else the median time between a node's measurements.

        Raises:
            ValueError: a step that is not positive.
        """
        results = {}
        for name, late in self.lateness().items():
            apart = np.diff(np.unique(self.columns[name].arrays()[0]))
            between = float(np.median(apart)) / SECOND if len(apart) else 1.0
            size = step if step is not None else between if self.step is None else self.step / SECOND
            if np.any(late > -size / 2):
                results[name] = learn_delays(late, size)
        return results

    def recording(self) -> Recording:
        """Return the events as rows in order of their times, as if none had been late; a repeated event counts once.

        Where time counts steps, and where nodes share a channel, all events of a time are one row, else each is. An
        input holds from its event to the next, so a row has the inputs that were there after the row before; where time
        counts steps it leads to its own step. Before the first event an input is 0.
        """
        origin, network = self.origin, self.network
        names, key = [INPUTS, *network.names], self._keys()
        # Rows: one for each time, or for each event; in steps also those of which nothing arrived.
        new = np.ones(key.shape[1], dtype=bool)
        new[1:] = key[0, 1:] != key[0, :-1] if self.steps or network.common is not None else True
        row, times = np.cumsum(new) - 1, key[0, new]
        if self.steps:
            if key[0, -1] >= MOST_STEPS:
                raise fail("time of an event", f"a step below {MOST_STEPS:,}", int(key[0, -1]))
            row, times = key[0], np.arange(int(key[0, -1]) + 1)
        # Values of each node; what came first at a time stays, and later events of the time fill what it had not.
        tables = []
        for node, name in enumerate(names):
            events = key[1] == node
            table = np.full((len(times), self.columns[name].size), np.nan)
            values, rows = self.columns[name].matrix()[key[3, events]], row[events]
            for i in range(table.shape[1]):
                there = np.flatnonzero(~np.isnan(values[:, i]))[::-1]
                table[rows[there], i] = values[there, i]
            tables.append(table)
        inputs = self._inputs(_held(tables[0]), times)
        time = times.astype(np.float64) if self.steps else (times - origin) / SECOND
        return Recording(dict(zip(network.names, tables[1:], strict=True)), inputs, time)

    def _keys(self) -> Int[np.ndarray, "4 events"]:
        """Return time, node, count and place of each event in the order of a timeline: inputs first at each time.

        Of events of the same time, node and count the first stays.
        """
        parts = []
        for node, name in enumerate([INPUTS, *self.network.names]):
            time, _, sequence = self._arrays(name)
            parts.append(np.stack([time, np.full(len(time), node), sequence, np.arange(len(time))]))
        key = np.concatenate(parts, axis=1)
        key = key[:, np.lexsort(key[::-1])]
        first = np.ones(key.shape[1], dtype=bool)
        first[1:] = np.any(key[:3, 1:] != key[:3, :-1], axis=0)
        return key[:, first]

    def _inputs(self, held: Float[np.ndarray, "rows given"], times: Int[np.ndarray, " rows"]) -> np.ndarray:
        """Return the plant's inputs of each row, from those that are held after it, and the time since the row before.

        Shapes: (rows, inputs).
        """
        if self.steps:
            return held
        before = np.vstack([np.zeros((1, held.shape[1])), held[:-1]])
        return np.insert(before, self.network.inputs.index(TIME_STEP), np.diff(times, prepend=times[:1]) / SECOND, 1)


def _held(values: Float[np.ndarray, "rows given"]) -> Float[np.ndarray, "rows given"]:
    """Fill what is missing with the value before it, 0 before the first."""
    rows = np.where(np.isnan(values), -1, np.arange(len(values))[:, None])
    last = np.maximum.accumulate(rows, axis=0) if len(values) else rows
    return np.where(last < 0, 0.0, np.take_along_axis(values, np.maximum(last, 0), axis=0))
